"""A record is a pure function of curves, settings and what is said about how they came about: its
``results.json``, its report, and the way back from there to the experiment.
"""

import importlib
import re
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxdyna import fields
from jaxdyna.experiments.engine import folders, storage
from jaxdyna.experiments.engine.experiment import Entry, Experiment, Record, Results, Study, entries
from jaxdyna.experiments.engine.trained import EPISODES, RETURN
from jaxdyna.experiments.engine.work import Curves
from jaxdyna.experiments.report.page import page
from jaxdyna.experiments.report.sections import kept_policies
from jaxdyna.experiments.report.summaries import compare, describe_arm, diverged
from jaxdyna.experiments.report.tables import label, paragraphs
from jaxdyna.statistics import mean_of_runs

#: of ``results.json`` and what lies beside it: what is read here and was not there before raises
#: it. Settings that are added do not: they take their defaults where they are not named.
FORMAT = 1


def command_of(module: str, *flags: str) -> tuple[Sequence[Experiment | Study], list[str], str]:
    """What a command of so many flags plays, flags that are left, and the command without these:
    the module's ``PARTS``, or what its function ``command_parts`` makes of the flags, or else its
    own experiments. `ImportError` where there is no such module, `ValueError` on wrong flags.
    """
    found = importlib.import_module(module)
    if hasattr(found, "command_parts"):
        return found.command_parts(flags)
    own = [each for each in vars(found).values() if isinstance(each, Experiment | Study)]
    return getattr(found, "PARTS", own), list(flags), f"python -m {module}"


def results_of(
    experiment: Experiment, options: Any, every: Sequence[Entry], curves: Mapping[str, Curves],
    about: Results,
) -> Results:  # fmt: skip
    """What is in ``results.json``, from the experiment's settings, every entry that there can be,
    curves ``[runs, ...]``, and what says ``about`` these how they came about, ``timing`` with it.
    """
    rule = experiment.rule(options)
    setups = {entry.name: entry.options for entry in every}
    arms: Results = {}
    for name, values in curves.items():
        arm, _, where = name.partition("@")
        said: Results = {"arm": arm, "setting": where} if where else {}
        said |= diverged(values, about["runs"]["seeds"])
        if rule is not None and "real_return" in values:
            said |= describe_arm(values, rule, options.episodes)
        if RETURN in values:
            said |= {RETURN: mean_of_runs(values[RETURN]) | {"episodes": EPISODES}}
        for describe in experiment.describe:
            said |= describe(setups.get(name, options), values)
        arms[name] = said
    spent = about["timing"]["arms"].values()
    total = {part: sum(one.get(part, 0.0) for one in spent) for part in ("compile_s", "run_s")}
    timing = total | {"shards": 1} | about["timing"]
    config = fields.plain(options) | {"arms": list(curves)}
    said = {"preset": options.preset, "config": config, "timing": timing, "arms": arms}
    results = about | {"format": FORMAT} | said
    if rule is not None:
        results["ratio_to_model_free"] = compare(arms, "model_free")
    return results


def home_of(part: Experiment | Study | None) -> Results:
    """The ``module`` an experiment is in, as it can be imported; nothing where it is in none."""
    main = sys.modules["__main__"]  # which may have several names
    script = Path(getattr(main, "__file__", None) or "").stem
    for name, module in sorted(sys.modules.items(), key=lambda one: one[1] is main):
        if any(each is part for each in [*getattr(module, "__dict__", {}).values()]):
            return {"module": script if module is main else name}
    return {}


def parts_of(results: Results) -> Sequence[Experiment | Study]:
    """The experiments of a ``results.json``'s module; `ValueError` where it cannot be imported."""
    words = [word for word in shlex.split(results["command"]) if word != "-m"]
    name = results.get("module") or words[1]
    try:
        return command_of(name, *words[2:])[0]
    except ImportError as error:
        raise ValueError(
            f"the experiment {results['part']} is in the module {name}, which cannot be imported "
            f"({error}): put its folder on PYTHONPATH, or give the experiment to jaxdyna.load"
        ) from None


def recorded(
    results: Results, parts: Sequence[Experiment | Study] = ()
) -> tuple[Experiment, Any, list[Entry]]:
    """What a record's ``results.json`` says that was played: the experiment, one of ``parts`` or by
    default of `parts_of`, its settings, and every entry that there can be. `ValueError` where there
    is no such experiment, or it does not read the settings.
    """
    try:
        part = {part.name: part for part in parts or parts_of(results)}[results["part"]]
        experiment = part.experiment() if isinstance(part, Study) else part
        default = experiment.presets[results["preset"]]
    except LookupError:
        raise ValueError(f"there is no such experiment: {results['command']}") from None
    options = fields.restored(default, results["config"])
    return experiment, options, entries(experiment, options, read_back(options, results["sweep"]))


def read_back(options: Any, sweep: Mapping[str, Sequence[Any]]) -> dict[str, list[Any]]:
    """The values that were swept, by dotted path, as ``results.json`` has them."""
    return {
        path: [fields.value_at(fields.restored(options, {path: value}), path) for value in values]
        for path, values in sweep.items()
    }


def write_report(experiment: Experiment, record: Record) -> str:
    """Writes ``report.md``, figures, ``report.html`` into the record's folder; returns the text."""
    head = [f"# {experiment.title}", f"`{record.results['command']}`"]
    if missing := record.results.get("unfinished"):
        head.append(f"**Interrupted: {', '.join(missing)} not finished; --resume goes on.**")
    if others := record.results.get("made_otherwise"):
        said = "were played before, by other code or versions than the rest"
        head.append(f"**{', '.join(others)} {said}** (results.json says which).")
    head.append(_diverged(record))
    text = paragraphs(*(section(record) for section in (*experiment.sections, kept_policies)))
    for name in record.results["arms"]:
        text = re.sub(rf"(?<!\w){re.escape(name)}", label(name), text)  # not the names of files
    text = paragraphs(*head, text) + "\n"
    storage.write_text(record.out / "report.md", text)
    whole = page(record, text, experiment.rule(record.options))
    storage.write_text(record.out / folders.PAGE, whole)
    return text


def _diverged(record: Record) -> str:
    """Which runs' numbers stopped being finite, where, and whose they were."""
    said = []
    for name, arm in record.results["arms"].items():
        runs = arm.get("diverged", {})
        unit = "episode" if "real_return" in record.curves[name] else "update"
        each = [f"seed {seed} in {unit} {at['unit']} ({at['part']})" for seed, at in runs.items()]
        more = [f"{len(each) - 3} more runs"] if len(each) > 3 else []
        said += [f"{name}: {', '.join(each[:3] + more)}"] if each else []
    if not said:
        return ""
    return (
        f"**Numbers stopped being finite in {'; '.join(said)}.** These runs ended there, unsolved "
        "unless they had solved before. A model that breaks may show in the agent that dreams in "
        "it. Lower learning rates first."
    )


def different(before: Results, now: Results, prefix: str = "") -> list[str]:
    """Paths of the settings that differ; ones that did not exist then are as they were."""
    paths = []
    for name, value in now.items():
        path, then = f"{prefix}{name}", before.get(name, value)
        if isinstance(value, dict) and isinstance(then, dict):
            paths += different(then, value, f"{path}.")
        elif then != value:
            paths.append(path)
    return paths
