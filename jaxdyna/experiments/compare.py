"""``python -m jaxdyna.experiments.compare DIR DIR...``: runs in several folders."""

import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import tyro
from rich.console import Console

from jaxdyna import fields
from jaxdyna.experiments.engine import Curves, Experiment, Record, Results, cli, folders, storage
from jaxdyna.experiments.engine.experiment import Entry
from jaxdyna.experiments.engine.loaded import load
from jaxdyna.experiments.engine.record import write_report
from jaxdyna.experiments.report import sections, tables
from jaxdyna.experiments.report.rows import counted
from jaxdyna.experiments.report.summaries import hardly_solved, restricted, verdict
from jaxdyna.experiments.report.tables import figure_at, markdown_table, number, paragraphs
from jaxdyna.fields import setting
from jaxdyna.statistics import SolveRule, brunner_munzel, holm, ratio_of_means, sooner

PROG = "python -m jaxdyna.experiments.compare"
WHOSE = {"experiment": "compare", "part": "compare"}
BUDGET, RULE = "episodes", "solve rule"
UNEVEN = "unsolved runs stopped at different steps"
UNSOLVED = "fewer than half of either solved"
SAID = (
    "Ratios are of restricted means: an unsolved run counts with what it played; there is none "
    "where fewer than half of the runs of either have solved. Intervals are of the log ratio "
    "(delta method, Student's t), p is of a permutation test of the same statistic, Holm's p "
    "takes in all rows. *Sooner*: the share of pairs of runs in which the first needs less, equal "
    "ones half and unsolved ones last, and Brunner and Munzel's p. Paired are the same seeds of "
    "one arm in settings of one preset. Told apart: Holm's p is at most 0.05; the same within a "
    "tenth: the ratio's 90% interval lies within 0.9 to 1.1."
)


@dataclass(frozen=True)
class Call:
    """Puts the runs of several folders into one table and one figure, and tests them."""

    folders: tyro.conf.Positional[tuple[Path, ...]] = setting(help="that --out named")
    arms: tuple[str, ...] = setting((), "which; all without")
    measure: Literal[
        "episodes_to_solve", "real_steps_to_solve", "first_solved", "frozen.real_steps_to_solve"
    ] = setting("episodes_to_solve", "what is compared, by its path in results.json")
    out: Path = setting(Path("runs/compare"), "folder for the report")


class Side(NamedTuple):
    """An entry of one folder, as that is called."""

    folder: str
    entry: Entry
    rule: SolveRule
    #: what ``results.json`` says of it
    arm: Results
    curves: Curves
    #: what runs have in common that belong together seed by seed: those of one arm of one preset
    whose: list[Any]
    #: by dotted path, and what else tells two of them apart
    settings: dict[str, Any]

    def differs(self, first: "Side", *paths: str) -> str:
        """In which settings, of these paths, it is not as the first, in words."""
        return ", ".join(
            f"{path} {self.settings.get(path)}, not {first.settings.get(path)}"
            for path in {**self.settings, **first.settings}
            if path.startswith(paths) and self.settings.get(path) != first.settings.get(path)
        )


@cli.command(Call, PROG, "DIR DIR... [--arms ARM...] [--measure FIGURE] [--out DIR]")
def main(call: Call, argv: Sequence[str]) -> int:
    """Writes the report and prints its tables; `ValueError` where not all can be compared."""
    sides = chosen(call)
    first = next(iter(sides.values()))
    listed = [side.whose[-1] for side in sides.values()]
    runs: Results = {"seeds": max(listed, key=len)}
    if any(seeds != runs["seeds"][: len(seeds)] for seeds in listed):
        runs = {"seeds": [*range(1, len(runs["seeds"]) + 1)], "by": "number"}
    results = WHOSE | {
        "command": f"{PROG} {shlex.join(argv)}",
        "config": {"episodes": first.settings[BUDGET], "measure": call.measure},
        "runs": runs,
        "arms": {name: side.arm for name, side in sides.items()},
        "comparisons": compared(sides, call.measure),
    }
    curves = {name: side.curves for name, side in sides.items()}
    overlaid = sections.learning_curves(lambda _: first.rule, arms=[*sides], begins=False)
    report = Experiment("compare", "Comparison", {}, lambda _: {}, rule=lambda _: first.rule,
                        sections=(table, overlaid, differences))  # fmt: skip
    with folders.held(call.out):
        folders.claim(call.out, WHOSE, fresh=False)
        storage.write_json(call.out / "results.json", results)
        text = write_report(report, Record(first.entry.options, results, curves, call.out))
    width = None if sys.stdout.isatty() else 100
    Console(highlight=False, width=width).print(cli.spoken(text))
    print(f"Report: {call.out / 'report.md'}")
    return 0


def chosen(call: Call) -> dict[str, Side]:
    """What is compared, by name, or name and folder; `ValueError` where it cannot be."""
    if len({folder.resolve() for folder in call.folders}) < max(len(call.folders), 2):
        raise ValueError("give two folders or more, each of them once")
    ends = [folder.resolve().name for folder in call.folders]
    called = ends if len({*ends}) == len(ends) else map(str, call.folders)
    sides = list(chain(*map(_sides, call.folders, called)))
    known = {name for side in sides for name in side.entry.names}
    if unknown := [arm for arm in call.arms if arm not in known]:
        raise ValueError(f"--arms {unknown[0]}: there are {', '.join(sorted(known))}")
    sides = [side for side in sides if not call.arms or {*call.arms} & {*side.entry.names}]
    if len(sides) < 2:
        raise ValueError(f"--arms {' '.join(call.arms)}: only {sides[0].folder} has that")
    first, names = sides[0], [side.entry.name for side in sides]
    world = first.entry.options.world_settings
    same = {"experiment": ("experiment",), "world": world, "budget": (BUDGET,), RULE: (RULE,)}
    for side in sides:
        for what, paths in same.items():
            if said := side.differs(first, *paths):
                raise ValueError(f"{side.folder} has another {what} than {first.folder}: {said}; "
                                 "play one of them again with the other's")  # fmt: skip
        if not figure_at(side.arm, call.measure):
            raise ValueError(f"--measure {call.measure}: {side.folder} has evaluated no policies")
    return {
        f"{name}, {side.folder}" if names.count(name) > 1 else name: side
        for name, side in zip(names, sides, strict=True)
    }


def _sides(folder: Path, name: str) -> list[Side]:
    """All that a folder has to compare; `ValueError` where it has nothing."""
    left = load(folder)
    results = left.results
    if results["runs"]["shard"] != [1, 1]:
        raise ValueError(f"{folder} is a shard: merge it with the others first")
    if not left.curves or left.curves.keys() - left.entries.keys():
        raise ValueError(f"{folder} has no runs, or of an arm that there is no more")
    versions = {f"version of {name}": said for name, said in results["versions"].items()}
    about = {"experiment": results["experiment"], BUDGET: left.options.episodes,
             "code": results["source"], **versions}  # fmt: skip
    sides = []
    for arm, curves in left.curves.items():
        entry, own = left.entries[arm], fields.leaves(left.entries[arm].options)
        if (solves := left.experiment.rule(entry.options)) is None:
            raise ValueError(f"{folder} has no rule by which a run has solved: nothing to compare")
        told = {leaf.path: fields.plain(leaf.value) for leaf in own if leaf.path != "arms"} | about
        whose = [entry.arm, results["preset"], left.options.seed, results["runs"]["seeds"]]
        sides.append(Side(name, entry, solves, results["arms"][arm], curves, whose,
                          told | {RULE: fields.plain(solves)}))  # fmt: skip
    return sides


def compared(sides: Mapping[str, Side], measure: str) -> list[Results]:
    """Each but the first beside the first before it of its name, or else of its arm, or of all."""
    said: list[Results] = []
    for place, (name, side) in enumerate(sides.items()):
        before = list(sides.items())[:place]
        same = [one for one in before if one[1].entry.name == side.entry.name]
        same += [one for one in before if one[1].entry.arm == side.entry.arm]
        for other, first in (same + before)[:1]:
            paired = side.whose == first.whose
            about = {"arms": [name, other], "differs": side.differs(first, ""), "paired": paired}
            figures = [figure_at(one.arm, measure) for one in (side, first)]
            said.append(about | _tested(figures, paired))
    known = [one for one in said if one["p"] is not None]
    for one, p in zip(known, holm([one["p"] for one in known]), strict=True):
        one["holm_p"] = float(p)
    return said


def _tested(figures: Sequence[Results], paired: bool) -> Results:
    """By ranks, unsolved runs last; and by restricted means, but where `hardly_solved`, or where an
    unsolved run stopped earlier than another one needed or played: whoever plays less would look
    better.
    """
    needed, played = [*map(tables.per_seed, figures)], [*map(restricted, figures)]
    values, unsolved = np.concatenate(played), np.isinf(np.concatenate(needed))
    uneven = bool((unsolved & (values < values.max() * (1 - 1e-9))).any())
    reason = UNEVEN if uneven else UNSOLVED if hardly_solved(*figures) else None
    one, other = needed if reason else played
    return ratio_of_means(one, other, paired) | {
        "sooner": sooner(*needed), "sooner_p": None if paired else brunner_munzel(*needed),
        "no_ratio": reason}  # fmt: skip


def table(record: Any) -> str:
    """What each needs, and the tests between them."""
    results = record.results
    rows = [
        [" : ".join(one["arms"]) + " (paired)" * one["paired"],
         tables.with_interval({"mean": one["ratio"], "ci95": one["ci95"]}, 2), _p(one["p"]),
         _p(one.get("holm_p")), f"{number(one['sooner'], 2)} ({_p(one['sooner_p'])})",
         one["no_ratio"] or (
             "-" if one["p"] is None else verdict(one["holm_p"], one["ci90"]) or "told apart")]
        for one in results["comparisons"]
    ]  # fmt: skip
    header = ["compared", "ratio (95% interval)", "p", "Holm's p", "sooner (p)", "they are"]
    first, measure = next(iter(results["arms"].values())), results["config"]["measure"]
    solved = tables.side_by_side(tables.solving(results, measure))
    return paragraphs(counted(first, measure), solved, markdown_table(header, rows), SAID)


def differences(record: Any) -> str:
    """In which settings, code and versions those differ that are compared."""
    differ: dict[str, list[str]] = {}
    for one in record.results["comparisons"]:
        differ.setdefault(one["differs"], []).append(" : ".join(one["arms"]))
    lines = [f"- {'; '.join(names)}: {said}." for said, names in differ.items() if said]
    return paragraphs("## How they differ", "\n".join(lines)) if lines else ""


def _p(value: float | None) -> str:
    return "< 0.0001" if value is not None and value < 1e-4 else number(value, 4)


if __name__ == "__main__":
    sys.exit(main())
