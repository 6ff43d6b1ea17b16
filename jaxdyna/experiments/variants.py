"""Experiments that play many variants of one setup beside each other: ablations, sensitivities."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console

from jaxdyna.experiments import cli, plots_studies, report
from jaxdyna.experiments.report import Results, interval, markdown_table, number
from jaxdyna.experiments.run import Arm, ArmRun
from jaxdyna.experiments.session import Session
from jaxdyna.statistics import SolveRule, bootstrap_interval, episodes_to_solve

Curves = dict[str, np.ndarray]


@dataclass(frozen=True)
class VariantOptions:
    """Many variants of one setup, each beside the setup itself."""

    preset: str = "paper"
    """The setup that is varied."""
    seeds: int = 10
    """Runs of every variant."""
    seed: int = 0
    """Base seed of all runs; every variant gets the same."""
    episodes: int = 600
    """Real episodes of a run at the most."""
    arms: tuple[str, ...] = ()
    """Names of the variants to play, as the table has them; all by default."""
    out: Path | None = None
    """Folder for the results; runs/EXPERIMENT by default."""
    resume: bool = False
    """Go on with the run in that folder."""
    stop_after_solved: int | None = 0
    """Episodes a variant plays on once all its seeds have solved; None plays all of them."""

    def __post_init__(self) -> None:
        cli.check_common(self)


@dataclass(frozen=True)
class Variants:
    """One experiment.

    Attributes:
        experiment: its name.
        title: of its report and figure.
        default: its options.
        make: from options to arms, the setup itself first.
        rule: when a run counts as solved.
        real_first: N, where dreams begin.
        column: which of the Contract's solve figures the table shows.
        block: see `jaxdyna.sweep.sweep`.
        piece: see `jaxdyna.experiments.run.Runner`.
        report: made of the experiment and its options.
    """

    experiment: str
    title: str
    default: VariantOptions
    make: Callable[[Any], dict[str, Arm]]
    rule: SolveRule
    real_first: int
    column: str = "episodes_to_solve"
    block: int | None = None
    piece: int | None = None
    report: Callable[[Variants, VariantOptions], VariantsReport] | None = None

    @property
    def prog(self) -> str:
        """The command as the user types it."""
        return f"python -m jaxdyna.experiments.{self.experiment}"

    def main(self, argv: Sequence[str] | None = None) -> int:
        """Runs the experiment from the command line; returns the exit code."""
        options = cli.parse({self.default.preset: self.default}, argv, self.prog)
        if options.preset != self.default.preset:
            cli.fail(f"--preset is {options.preset}: there is {self.default.preset}", self.prog)
        try:
            arms = self.make(options)
        except ValueError as error:
            cli.fail(str(error), self.prog)
        unknown = sorted(set(options.arms) - set(arms))
        if unknown:
            there_are = "; ".join(arms)
            cli.fail(f"--arms: there is no {'; '.join(unknown)}; there are: {there_are}", self.prog)
        session = Session(
            experiment=self.experiment,
            prog=self.prog,
            argv=sys.argv[1:] if argv is None else argv,
            options=options,
            out=options.out or Path("runs") / self.experiment,
            rule=self.rule,
            keys=jax.random.split(jax.random.key(options.seed), options.seeds),
            report=(self.report or VariantsReport)(self, options),
            block=self.block,
            piece=self.piece,
            slim_above=0,
        )
        return session.run({name: arms[name] for name in options.arms or arms})


DIFFERENCE_SAID = (
    "where runs of the row are unsolved it is a lower bound (≥), where runs of the first are it is "
    "left out."
)


@dataclass(frozen=True)
class VariantsReport:
    """A row and a strip of dots for each variant; see `jaxdyna.experiments.session.Report`."""

    variants: Variants
    options: VariantOptions

    @property
    def limit(self) -> int:
        """What an unsolved run counts as at the least."""
        offset = 0 if self.variants.column == "episodes_to_solve" else self.variants.rule.window - 1
        return self.options.episodes + 1 - offset

    def analyse(self, arm: Arm, run: ArmRun, key: jax.Array) -> Curves:
        """Nothing beyond the curves."""
        return {}

    def solved_at(self, curves: Curves) -> np.ndarray:
        """The table's solve figure of each seed, infinity where unsolved."""
        rule = self.variants.rule
        ends = episodes_to_solve(rule.score(curves), rule)
        return (
            ends
            if self.variants.column == "episodes_to_solve"
            else ends + self.limit - (self.options.episodes + 1)
        )

    def describe(self, curves: Curves) -> Results:
        """What the first dreams were like."""
        return {"first_dreams": report.first_dreams(curves, self.variants.real_first)}

    def figures(self, out: Path, curves: Mapping[str, Curves], results: Results) -> None:
        """``variants.png``."""
        solved_at = {name: self.solved_at(values) for name, values in curves.items()}
        axis = self.variants.column.replace("_", " ")
        plots_studies.solve_bars(
            out / "variants.png", solved_at, self.limit, self.variants.title, axis
        )

    def markdown(self, results: Results) -> str:
        """The report."""
        first = next(iter(results["arms"]))
        parts = [
            f"# {self.variants.title}",
            f"`{results['command']}`",
            f"{report.runs(self.options.seeds)} of each row. The first row is the "
            f"`{self.options.preset}` preset; every other one changes what it says. "
            f"{str(self.variants.rule).capitalize()}. At most {self.options.episodes} episodes; "
            "a mean with an unsolved run in it is shown as its lower bound (≥). The seeds are "
            f"the same in every row, so that the difference to «{first}» is paired; "
            f"{DIFFERENCE_SAID} Fake and real return: medians over the first "
            f"{report.FIRST_DREAMS} episodes with dreams.",
            markdown_table(*self._long_table(results)).rstrip(),
            "![every seed of every variant](variants.png)",
        ]
        return "\n\n".join(parts) + "\n"

    def summary(self, console: Console, results: Results) -> None:
        """The table in the terminal."""
        report.print_table(console, self.variants.title, *self._table(results))

    def _table(self, results: Results) -> tuple[list[str], list[list[str]]]:
        header = ["variant", self.variants.column.replace("_", " "), "95% interval", "median"]
        rows = []
        for name, arm in results["arms"].items():
            solve = arm[self.variants.column]
            solved = f"{solve['solved']}/{solve['seeds']}"
            rows.append(
                [name, number(solve), interval(solve["ci95"]), number(solve, "median"), solved]
            )
        return [*header, "solved"], rows

    def _long_table(self, results: Results) -> tuple[list[str], list[list[str]]]:
        """With the difference to the first row, and the first dreams beside the truth."""
        header, rows = self._table(results)
        arms = list(results["arms"].values())
        for row, arm in zip(rows, arms, strict=True):
            row.append("-" if arm is arms[0] else self._difference(arm, arms[0]))
            dreams = arm["first_dreams"]
            row.append(
                f"{report.whole(dreams['fake_return'])} / {report.whole(dreams['real_return'])}"
                if dreams
                else "-"
            )
        return [*header, "difference to the first row", "fake / real return"], rows

    def _difference(self, arm: Results, first: Results) -> str:
        """How much later than the first, in words; see `DIFFERENCE_SAID`."""
        if _unsolved(first[self.variants.column]):
            return "-"
        difference = self.bounded(arm) - self.bounded(first)
        if _unsolved(arm[self.variants.column]):
            return f"≥ {difference.mean():+.0f}"
        ends = bootstrap_interval(difference, lambda values: values.mean(-1))
        return f"{difference.mean():+.0f} ({interval(ends)})"

    def bounded(self, arm: Any) -> np.ndarray:
        """The table's solve figure of each seed out of ``results.json``, `limit` where unsolved."""
        values = arm[self.variants.column]["per_seed"]
        return np.array([self.limit if value is None else value for value in values], float)


def _unsolved(solve: Results) -> bool:
    return solve["solved"] < solve["seeds"]
