"""``python -m jaxdyna.experiments.compare DIR DIR...``: runs in several folders."""

import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import tyro
from rich.console import Console
from rich.markdown import Markdown

from jaxdyna import fields
from jaxdyna.experiments.engine import Experiment, Record, Results, cli, folders, storage
from jaxdyna.experiments.engine.experiment import Entry
from jaxdyna.experiments.engine.loaded import Loaded, load
from jaxdyna.experiments.engine.record import recorded, write_report
from jaxdyna.experiments.report import sections
from jaxdyna.experiments.report.rows import counted
from jaxdyna.experiments.report.summaries import restricted
from jaxdyna.experiments.report.tables import (
    figure_at,
    markdown_table,
    number,
    paragraphs,
    solve_table,
    with_interval,
)
from jaxdyna.fields import setting
from jaxdyna.statistics import SolveRule, brunner_munzel, holm, ratio_of_means

PROG = "python -m jaxdyna.experiments.compare"
WHOSE = {"experiment": "compare", "part": "compare"}
WORLD, BUDGET, RULE = "experiment", "episodes", "solve rule"
SAID = (
    "Ratios are of restricted means: an unsolved run counts with what it played. Intervals are of "
    "the log ratio (delta method, Student's t), p is of a permutation test of the same statistic, "
    "Holm's p takes in all rows. *Sooner*: the share of pairs of runs in which the first needs "
    "less, equal ones half, and Brunner and Munzel's p. Paired are the same seeds of one arm in "
    "settings of one preset. Told apart: Holm's p is at most 0.05; alike: the ratio's 90% interval "
    "lies within 0.9 to 1.1."
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
    """An entry of one folder."""

    #: as it is called
    folder: str
    #: what is in it
    left: Loaded
    entry: Entry
    #: when a run counts as solved
    rule: SolveRule
    #: as JSON by dotted path, and what else tells two of them apart
    settings: dict[str, Any]

    @property
    def arm(self) -> Results:
        """What ``results.json`` says of it."""
        return self.left.results["arms"][self.entry.name]

    @property
    def whose(self) -> list[Any]:
        """What runs have in common that belong together seed by seed: of one arm of one preset."""
        results, options = self.left.results, self.left.options
        return [self.entry.arm, results["preset"], options.seed, results["runs"]["seeds"]]

    def differs(self, first: "Side", *paths: str) -> str:
        """In which settings, of these paths, it is not as the first, in words."""
        return ", ".join(
            f"{path} {value}, not {first.settings.get(path)}"
            for path, value in self.settings.items()
            if path.startswith(paths) and value != first.settings.get(path)
        )


def main(argv: Sequence[str] | None = None) -> int:
    """Compares, by the arguments or the process's, and returns the exit code: see `cli.command`."""
    words = sys.argv[1:] if argv is None else argv
    usage = f"DIR DIR... [--arms ARM...] [--measure FIGURE] [--out DIR]\n\n{Call.__doc__}"
    return cli.command(Call, usage, PROG, words or ["--help"], compare)


def compare(call: Call, argv: Sequence[str]) -> int:
    """Writes the report and prints its tables.

    Raises:
        ValueError: where a folder has no result, or not all can be compared.
    """
    sides = chosen(call)
    first = next(iter(sides.values()))
    runs = [side.left.results["runs"] for side in sides.values()]
    results = WHOSE | {
        "command": f"{PROG} {shlex.join(argv)}",
        "config": {"episodes": first.left.options.episodes, "measure": call.measure},
        "runs": max(runs, key=lambda one: len(one["seeds"])),
        "arms": {name: side.arm for name, side in sides.items()},
        "comparisons": compared(sides, call.measure),
    }
    curves = {name: side.left.curves[side.entry.name] for name, side in sides.items()}
    overlaid = sections.learning_curves(lambda _: first.rule, arms=[*sides], begins=False)
    report = Experiment("compare", "Comparison", {}, lambda _: {},
                        sections=(table, overlaid, differences))  # fmt: skip
    with folders.held(call.out):
        folders.claim(call.out, WHOSE, fresh=False)
        storage.write_json(call.out / "results.json", results)
        text = write_report(report, Record(first.entry.options, results, curves, call.out))
    width = None if sys.stdout.isatty() else 100
    Console(highlight=False, width=width).print(Markdown(text.partition("\n![")[0]))
    print(f"Report: {call.out / 'report.md'}")
    return 0


def chosen(call: Call) -> dict[str, Side]:
    """What is compared, by its name, and its folder's where several have that name.

    Raises:
        ValueError: where it cannot be.
    """
    if len({folder.resolve() for folder in call.folders}) < max(len(call.folders), 2):
        raise ValueError("give two folders or more, each of them once")
    sides = [side for folder, name in _short(call.folders).items() for side in _sides(folder, name)]
    known = {name for side in sides for name in side.entry.names}
    if unknown := [arm for arm in call.arms if arm not in known]:
        raise ValueError(f"--arms {unknown[0]}: there are {', '.join(sorted(known))}")
    sides = [side for side in sides if not call.arms or {*call.arms} & {*side.entry.names}]
    first, names = sides[0], [side.entry.name for side in sides]
    world = first.entry.options.world_settings
    same = {WORLD: (WORLD,), "world": world, "budget": (BUDGET,), RULE: (RULE,)}
    for side in sides:
        for what, paths in same.items():
            if said := side.differs(first, *paths):
                raise ValueError(f"{side.folder} has another {what} than {first.folder}: {said}")
        if not figure_at(side.arm, call.measure):
            raise ValueError(f"--measure {call.measure}: {side.folder} has evaluated no policies")
    return {
        f"{name}, {side.folder}" if names.count(name) > 1 else name: side
        for name, side in zip(names, sides, strict=True)
    }


def _sides(folder: Path, name: str) -> list[Side]:
    """All that a folder has to compare.

    Raises:
        ValueError: where it has nothing.
    """
    left = load(folder)
    rule = recorded(left.results)[0].rule
    if left.results["runs"]["shard"] != [1, 1]:
        raise ValueError(f"{folder} is a shard: merge it with the others first")
    versions = {f"version of {name}": said for name, said in left.results["versions"].items()}
    about = {WORLD: left.results["experiment"], BUDGET: left.options.episodes,
             "code": left.results["source"], **versions}  # fmt: skip
    sides = []
    for entry in (left.entries[arm] for arm in left.results["arms"] if arm in left.curves):
        solves = rule and rule(entry.options)
        if solves is None:
            raise ValueError(f"{folder} has no rule by which a run has solved: nothing to compare")
        own = {leaf.path: fields.plain(leaf.value) for leaf in fields.leaves(entry.options)
               if leaf.path != "arms"}  # fmt: skip
        sides.append(Side(name, left, entry, solves, own | about | {RULE: fields.plain(solves)}))
    return sides


def _short(paths: Sequence[Path]) -> dict[Path, str]:
    """The ends of paths, as long as it takes to tell them apart."""
    parts = [path.resolve().parts for path in paths]
    ends = (["/".join(each[-many:]) for each in parts] for many in range(1, 100))
    return dict(zip(paths, next(end for end in ends if len({*end}) == len(end)), strict=True))


def compared(sides: Mapping[str, Side], measure: str) -> list[Results]:
    """Each but the first beside the first before it of its name, or else of its arm, or of all."""
    said: list[Results] = []
    for place, (name, side) in enumerate(sides.items()):
        before = list(sides.items())[:place]
        same = [one for one in before if one[1].entry.name == side.entry.name]
        same += [one for one in before if one[1].entry.arm == side.entry.arm]
        for other, first in (same + before)[:1]:
            mine, theirs = (restricted(figure_at(one.arm, measure)) for one in (side, first))
            paired = side.whose == first.whose
            about = {"arms": [name, other], "differs": side.differs(first, ""), "paired": paired}
            ratio = ratio_of_means(mine, theirs, paired)
            said.append(
                about | ratio | {"sooner_p": None if paired else brunner_munzel(mine, theirs)}
            )
    known = [one for one in said if one["p"] is not None]
    for one, p in zip(known, holm([one["p"] for one in known]), strict=True):
        one["holm_p"] = float(p)
    return said


def table(record: Any) -> str:
    """What each needs, and the tests between them."""
    results = record.results
    rows = [
        [" : ".join(one["arms"]) + " (paired)" * one["paired"],
         with_interval({"mean": one["ratio"], "ci95": one["ci95"]}, 2), _p(one["p"]),
         _p(one.get("holm_p")), f"{number(one['sooner'], 2)} ({_p(one['sooner_p'])})",
         _verdict(one)]
        for one in results["comparisons"]
    ]  # fmt: skip
    header = ["compared", "ratio (95% interval)", "p", "Holm's p", "sooner (p)", "they are"]
    first, measure = next(iter(results["arms"].values())), results["config"]["measure"]
    solved = markdown_table(*solve_table(results, measure))
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


def _verdict(one: Results) -> str:
    if one["p"] is None:
        return "-"
    if one["holm_p"] <= 0.05:
        return "told apart"
    low, high = one["ci90"]
    return "alike" if low >= 0.9 and high <= 1.1 else "not told apart"


if __name__ == "__main__":
    sys.exit(main())
