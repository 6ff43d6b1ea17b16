"""From the command line to the report: the same for every experiment."""

from __future__ import annotations

import gc
import importlib
import itertools
import json
import re
import shlex
import shutil
import signal
import sys
import time
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console
from rich.markdown import Markdown

from jaxdyna import fields
from jaxdyna.experiments.engine import cli, folders, storage
from jaxdyna.experiments.engine.checkpoint import InputError, Store
from jaxdyna.experiments.engine.experiment import (
    Entry,
    Experiment,
    Record,
    Results,
    Study,
    chosen,
    entries,
)
from jaxdyna.experiments.engine.progress import Bars
from jaxdyna.experiments.engine.work import (
    Arm,
    Curves,
    Engine,
    Interrupted,
    Over,
    Runs,
    joined,
    runs_of,
)
from jaxdyna.experiments.report.summaries import compare, describe_arm
from jaxdyna.experiments.report.tables import label, paragraphs
from jaxdyna.fields import SettingError
from jaxdyna.statistics import episodes_to_solve

NOT_SETTINGS = ("arms",)


def main(
    *parts: Experiment | Study, argv: Sequence[str] | None = None, prog: str | None = None
) -> int:
    """Runs an experiment from the command line.

    Args:
        parts: what ``--part`` chooses from by name; the first is the default.
        argv: the arguments, by default the process's.
        prog: the command as the user types it.

    Returns:
        The exit code: 0, 130 after Ctrl-C.

    Raises:
        SystemExit: with code 2 and one line on bad input, with 0 after ``--help``.
    """
    cli.spell_out()
    if argv is None:  # a process of its own: tracing need not search what was imported for garbage
        gc.freeze()
        argv = sys.argv[1:]
    argv = list(argv)
    prog = prog or _prog()
    with ExitStack() as stack:
        try:
            session = prepared(parts, argv, prog)
            session.begin(stack)
        except SettingError as error:
            cli.fail(f"{cli.flag_of(error, argv)} {error.said}", prog)
        except (ValueError, ImportError) as error:
            cli.fail(str(error), prog)
        try:
            return session.run()
        except InputError as error:
            cli.fail(str(error), prog)


def prepared(parts: Sequence[Experiment | Study], argv: Sequence[str], prog: str) -> Session:
    """The session that a command line asks for; nothing is played yet."""
    asked = [word for word in argv if word not in ("--help", "-h", "--help-all")]
    if "--out=" in asked or ("--out", "") in itertools.pairwise(asked):
        cli.fail("--out is empty: name a folder, . for this one", prog)
    call, rest = cli.read(cli.Call, asked, prog, return_unknown_args=True)
    part = cli.by_name({part.name: part for part in parts}, "part", call.part, prog)
    experiment = part.experiment() if isinstance(part, Study) else part
    default = cli.by_name(experiment.presets, "preset", call.preset, prog)
    preset = call.preset or next(iter(experiment.presets))
    if len(asked) < len(argv):
        names = [part.name for part in parts]
        arms = dict.fromkeys(name.partition("@")[0] for name in experiment.arms(default.resolved()))
        hidden = () if experiment.quick.get(preset) else ("quick",)
        everything = "--help-all" in argv
        print(cli.help_text(
            prog, names, [*experiment.presets], [*arms], default, everything, hidden
        ))  # fmt: skip
        raise SystemExit(0)
    if call.quick:
        if not experiment.quick.get(preset):
            cli.fail(f"--quick: {experiment.name} has none: lower --seeds and --episodes", prog)
        default = fields.changed(default, {**experiment.quick[preset], "quick": True})
    asked_for = cli.parse(default, rest, prog)
    options = asked_for.resolved()
    if "--arms" in rest and not options.arms:
        cli.fail("--arms is empty: name arms, or leave it out for all", prog)
    sweep = cli.swept(options, call.sweep)
    every = entries(experiment, asked_for, sweep)
    command = f"{prog} {shlex.join(word for word in argv if word != '--resume')}".strip()
    first = call.part is None or call.part == parts[0].name
    name = parts[0].name if first else f"{parts[0].name}-{experiment.name}"
    out, (number, of) = Path("runs") / (f"{name}-{preset}" if first else name), call.shards
    if of > 1:
        out = out / "parts" / f"{number}-of-{of}"
    return Session(
        experiment, options, every, call.out or out, command, call.resume, call.fresh, call.shards,
        sweep, family=parts[0].name,
    )  # fmt: skip


def _prog() -> str:
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    name = (spec.name if spec else Path(sys.argv[0]).name).removesuffix(".__main__")
    return f"python -m {name}" if spec else f"python {name}"


@dataclass
class Session:
    """Plays what is not finished, keeps what is on disk, and reports.

    Attributes:
        experiment: what is played.
        options: its settings, resolved.
        every: entry of ``results["arms"]`` that there can be.
        out: the folder for the results.
        command: as typed.
        resume: whether to go on with what is there.
        fresh: whether to drop unfinished work that is there.
        shard: ``(I, N)``.
        sweep: values by dotted path.
        family: the name of the experiment whose part this is.
    """

    experiment: Experiment
    options: Any
    every: list[Entry]
    out: Path
    command: str
    resume: bool = False
    fresh: bool = False
    shard: tuple[int, int] = (1, 1)
    sweep: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    family: str = ""
    console: Console = field(
        default_factory=lambda: Console(highlight=False, width=None if sys.stdout.isatty() else 100)
    )

    def begin(self, stack: ExitStack) -> None:
        """Makes the arms, takes the folder, until the stack is closed, for this process alone, and
        takes up what is there or sets it aside.

        Raises:
            ValueError: with what to change.
        """
        self.began, self.earlier = time.perf_counter(), None
        self.curves: dict[str, Curves] = {}
        self.timing: dict[str, dict[str, float]] = {}
        self.measured: dict[str, Any] = {}
        self.earlier_s = 0.0
        if not self.seeds:
            raise ValueError("--shard has more parts than there are --seeds: give fewer")
        self.entries = chosen(self.every, self.options.arms)
        self.arms = {entry.name: entry.make() for entry in self.entries}
        if self.resume and not self.out.is_dir():
            raise ValueError(f"nothing to resume in {self.out}: run once without --resume")
        stack.enter_context(folders.held(self.out))
        if self.resume:
            self._take_up()
        else:
            whose = {"experiment": self.family, "part": self.experiment.name}
            folders.claim(self.out, whose, self.fresh)
        self.checkpoints.mkdir(exist_ok=True)
        storage.write_json(self.checkpoints / "settings.json", self._identity())

    def run(self) -> int:
        """Plays and reports; returns the exit code: 0, 130 after Ctrl-C.

        Raises:
            InputError: where something in mid-run is the user's to mend.
        """
        code, engine = 0, Engine()
        try:
            with _deferred_interrupt(engine):
                self._measure()
                self._play(engine, self.arms)
            shutil.rmtree(self.checkpoints, ignore_errors=True)
        except jax.errors.JaxRuntimeError as error:
            if "RESOURCE_EXHAUSTED" not in str(error):
                raise
            raise InputError("out of memory: lower --block, --seeds or --episodes") from None
        except KeyboardInterrupt:
            code = 130
            self.console.print(
                f"Interrupted. What is finished is in {self.out}; "
                "the same command with --resume goes on."
            )
        if self.curves or self.measured:
            try:
                self._report()
            except KeyboardInterrupt:
                code = 130
                self.console.print("Interrupted. The same command with --resume makes the report.")
        return code

    @property
    def checkpoints(self) -> Path:
        """Where they lie until all is finished."""
        return self.out / folders.CHECKPOINTS

    @property
    def seeds(self) -> list[int]:
        """The global numbers of the runs that are played."""
        number, of = self.shard
        return list(range(number - 1, self.options.seeds, of))

    def _play(self, engine: Engine, arms: Mapping[str, Arm]) -> None:
        """Plays the entries that are not finished: those of one arm that are one work together, as
        one axis of runs.
        """
        together: dict[Any, list[Entry]] = {}
        for entry in self.entries:
            if entry.name not in self.curves:
                together.setdefault((entry.arm, arms[entry.name].work), []).append(entry)
        counts = Counter(arm for arm, _ in together)
        groups = {_group_name(group, counts): group for group in together.values()}
        totals = {
            name: (max(arms[entry.name].units for entry in group), len(group) * len(self.seeds))
            for name, group in groups.items()
        }
        with Bars(self.console, totals) as bars:
            for name, group in groups.items():
                played = [arms[entry.name] for entry in group]
                runs = runs_of(played, self.seeds, self.options.seed)
                store = Store(self.checkpoints / _identifier(group, runs))
                done = engine.play(
                    played[0].work, runs, self._over(), store,
                    lambda *said, name=name: bars.tell(name, *said),
                )  # fmt: skip
                length = max((len(run.get("real_return", ())) for run in done.curves), default=0)
                bars.tell(name, "done", length or totals[name][0], len(done.curves))
                each = len(self.seeds)
                for number, entry in enumerate(group):
                    rows = slice(number * each, (number + 1) * each)
                    self.curves[entry.name] = joined(done.curves[rows])
                self.timing[name] = done.seconds._asdict()
                del done  # before the next arm's are made
                self._write()

    def _over(self) -> Over | None:
        """When a run is over: so many episodes after it has solved."""
        rule, stop = self.experiment.rule, self.options.stop_after_solved
        if rule is None or stop is None:
            return None
        solves = rule(self.options)

        def over(curves: Curves) -> np.ndarray:
            played = curves["real_return"].shape[1]
            return played >= episodes_to_solve(solves.score(curves), solves) + stop

        return over

    def _measure(self) -> None:
        """What the host measures, unless an earlier run has it."""
        path = self.checkpoints / "measured.json"
        before = (storage.read_json(path) or {}) if self.resume else {}
        self.measured |= before
        for name, measure in self.experiment.measures.items():
            if name not in self.measured:
                began = time.perf_counter()
                found = measure(self.options, self.console.print)
                seconds = {"measure_s": time.perf_counter() - began}
                self.measured[name] = json.loads(json.dumps(found))
                self.timing[name] = seconds
                storage.write_json(path, self.measured)

    def _identity(self) -> Results:
        """What a resumed run must have in common with the one that it resumes."""
        settings = fields.plain(self.options)
        return {
            "experiment": self.family,
            "part": self.experiment.name,
            "shard": list(self.shard),
            "sweep": fields.plain(dict(self.sweep)),
            "config": {name: value for name, value in settings.items() if name not in NOT_SETTINGS},
        }

    def _take_up(self) -> None:
        """Reads what an earlier run with the same settings finished.

        Raises:
            ValueError: where there is no such run.
        """
        begun = storage.read_json(self.checkpoints / "settings.json")
        results = storage.read_json(self.out / "results.json")
        finished = results and {
            **{name: results.get(name) for name in ("experiment", "part", "sweep")},
            "shard": results.get("runs", {}).get("shard"),
            "config": {k: v for k, v in results["config"].items() if k not in NOT_SETTINGS},
        }
        before, now = begun or finished, self._identity()
        if before is None:
            raise ValueError(f"nothing to resume in {self.out}: run once without --resume")
        differ = [name for name in now if name != "config" and before.get(name) != now[name]]
        differ += different(before["config"], now["config"])
        if differ:
            flags = ", ".join(f"--{name.replace('_', '-')}" for name in differ)
            raise ValueError(
                f"the run in {self.out} had other settings for {flags}: resume with the same, or "
                "choose another --out"
            )
        if not finished or different(finished["config"], now["config"]):
            return
        self.earlier = results
        self.earlier_s = results["timing"]["total_s"]
        self.timing = results["timing"]["arms"]
        self.measured = {
            name: results[name] for name in self.experiment.measures if name in results
        }
        if results["command"] != self.command:
            self.command = f"{results['command']} && {self.command} --resume"
        self.curves = storage.read_curves(self.out / "curves.npz")

    def _write(self) -> None:
        ordered = [entry.name for entry in self.entries]
        names = [name for name in (*ordered, *self.curves) if name in self.curves]
        self.curves = {name: self.curves[name] for name in dict.fromkeys(names)}
        timing = {"arms": self.timing, "total_s": self.earlier_s + time.perf_counter() - self.began}
        made = storage.provenance(self.earlier)
        if self.earlier and self.curves.keys() <= self.earlier["arms"].keys():
            made = {name: self.earlier[name] for name in made}  # drawn anew, not played
        runs = {"seeds": self.seeds, "of": self.options.seeds, "shard": list(self.shard),
                "block": self.options.block}  # fmt: skip
        about = {
            "experiment": self.family, "part": self.experiment.name, "command": self.command,
            **made, "runs": runs, "sweep": fields.plain(dict(self.sweep)), "timing": timing,
            **self.measured,
        }  # fmt: skip
        if missing := [name for name in ordered if name not in self.curves]:
            about["unfinished"] = missing
        setups = {entry.name: entry.options for entry in self.every}
        self.results = results_of(self.experiment, self.options, setups, self.curves, about)
        storage.write_json(self.out / "results.json", self.results)
        storage.write_curves(self.out / "curves.npz", self.curves)  # last: it tells what is done

    def _report(self) -> None:
        self._write()
        record = Record(self.options, self.results, self.curves, self.out)
        text = write_report(self.experiment, record)
        self.console.print(Markdown(text.partition("\n![")[0]))
        seconds = f"{self.results['timing']['total_s']:.0f} s in all"
        self.console.print(f"Report: {self.out / 'report.md'} ({seconds})")


def results_of(
    experiment: Experiment, options: Any, setups: Mapping[str, Any], curves: Mapping[str, Curves],
    about: Results,
) -> Results:  # fmt: skip
    """What is in ``results.json``, from the experiment's settings, those of each entry and its
    curves ``[runs, ...]``, and what says ``about`` these how they came about, ``timing`` with it.
    """
    rule = experiment.rule(options) if experiment.rule else None
    arms: Results = {}
    for name, values in curves.items():
        arm, _, where = name.partition("@")
        said: Results = {"arm": arm, "setting": where} if where else {}
        if rule is not None and "real_return" in values:
            said |= describe_arm(values, rule, options.episodes)
        for describe in experiment.describe:
            said |= describe(setups.get(name, options), values)
        arms[name] = said
    spent = about["timing"]["arms"].values()
    total = {part: sum(one.get(part, 0.0) for one in spent) for part in ("compile_s", "run_s")}
    timing = total | {"shards": 1} | about["timing"]
    config = fields.plain(options) | {"arms": list(curves)}
    results = about | {"preset": options.preset, "config": config, "timing": timing, "arms": arms}
    if rule is not None:
        results["ratio_to_model_free"] = compare(arms, "model_free")
    return results


def recorded(results: Results) -> tuple[Experiment, Any, dict[str, list[Any]]]:
    """What a record's ``results.json`` says that was played: the experiment, its settings, and the
    values that were swept, by dotted path.

    Raises:
        ValueError: where there is no such experiment, or it does not read the settings.
    """
    try:
        parts = importlib.import_module(shlex.split(results["command"])[2]).PARTS
        part = {part.name: part for part in parts}[results["part"]]
        experiment = part.experiment() if isinstance(part, Study) else part
        default = experiment.presets[results["preset"]]
    except (ImportError, AttributeError, LookupError):
        raise ValueError(f"there is no such experiment: {results['command']}") from None
    options = fields.restored(default, results["config"])
    sweep = {
        path: [fields.value_at(fields.restored(options, {path: value}), path) for value in values]
        for path, values in results["sweep"].items()
    }
    return experiment, options, sweep


def write_report(experiment: Experiment, record: Record) -> str:
    """Writes ``report.md`` and its figures into the record's folder; returns the text."""
    head = [f"# {experiment.title}", f"`{record.results['command']}`"]
    if missing := record.results.get("unfinished"):
        head.append(f"**Interrupted: {', '.join(missing)} not finished; --resume goes on.**")
    text = paragraphs(*(section(record) for section in experiment.sections))
    for name in record.results["arms"]:
        text = re.sub(rf"(?<!\w){re.escape(name)}", label(name), text)  # not the names of files
    text = paragraphs(*head, text) + "\n"
    storage.write_text(record.out / "report.md", text)
    return text


def _group_name(group: Sequence[Entry], counts: Mapping[str, int]) -> str:
    """What entries that are played together are called, when so many groups are of each arm."""
    first = group[0]
    if len(group) == 1:
        return first.name
    return first.arm if counts[first.arm] == 1 else f"{first.name} and {len(group) - 1} more"


def _identifier(group: Sequence[Entry], runs: Runs) -> str:
    """A folder's name for the checkpoints of just these runs."""
    names = [entry.name for entry in group]
    arrays = [names, *jax.tree.leaves((runs.seed, runs.hparams, runs.units))]
    digest = zlib.crc32(b"".join(np.ascontiguousarray(leaf).tobytes() for leaf in arrays))
    safe = "".join(letter if letter.isalnum() or letter in "-_" else "_" for letter in group[0].arm)
    return f"{safe}-{digest:08x}"


def different(before: Results, now: Results, prefix: str = "") -> list[str]:
    """Paths of the settings that differ; ones that did not exist then are as they were."""
    paths = []
    for name, value in now.items():
        if name not in before or before[name] == value:
            continue
        nested = isinstance(value, dict) and isinstance(before[name], dict)
        paths += (
            different(before[name], value, f"{prefix}{name}.") if nested else [f"{prefix}{name}"]
        )
    return paths


@contextmanager
def _deferred_interrupt(engine: Engine) -> Iterator[None]:
    """Ctrl-C and SIGTERM let the pieces in progress end and be saved; a second one interrupts at
    once. Outside the main thread they do nothing.
    """

    def receive(signum: int, frame: Any) -> None:
        if engine.interrupted.is_set():
            raise KeyboardInterrupt
        engine.interrupted.set()

    try:
        before = {one: signal.signal(one, receive) for one in (signal.SIGINT, signal.SIGTERM)}
    except ValueError:  # not the main thread
        yield
        return
    try:
        yield
        if engine.interrupted.is_set():
            raise Interrupted
    finally:
        for one, handler in before.items():
            signal.signal(one, handler)
