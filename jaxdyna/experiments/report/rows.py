"""The report of a study: every row beside the first, in one of the arms' figures of solving."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxdyna.experiments.report import plots, tables
from jaxdyna.experiments.report.sections import paragraphs, told
from jaxdyna.experiments.report.summaries import FIRST_DREAMS
from jaxdyna.experiments.report.tables import Results, per_seed, whole
from jaxdyna.statistics import mean_of_runs


@told
def rows(record: Any, column: str = "episodes_to_solve") -> str:
    """A line and a strip of dots for each row, in ``episodes_to_solve`` or ``first_solved``."""
    results, options = record.results, record.options
    if not results["arms"]:
        return ""
    (_, *header), lines = tables.solve_table(results, column)
    first, *_ = arms = list(results["arms"].values())
    for line, arm in zip(lines, arms, strict=True):
        dreams = arm.get("first_dreams")
        line += [
            "-" if arm is first else _difference(arm[column], first[column]),
            f"{whole(dreams['fake_return'])} / {whole(dreams['real_return'])}" if dreams else "-",
        ]
    solved = {name: per_seed(arm[column]) for name, arm in results["arms"].items()}
    plots.solve_bars(record.out / "variants.png", solved, limit(results["arms"], column),
                     column.replace("_", " "))  # fmt: skip
    return paragraphs(
        f"{tables.runs(len(results['runs']['seeds']))} of each row. The first row is the "
        f"`{options.preset}` preset; every other one changes what it says. "
        f"{first['solve_rule'].capitalize()}. At most {options.episodes} episodes; a mean with "
        "an unsolved run in it is shown as its lower bound (≥). The seeds are the same in "
        f"every row, so that the difference to «{lines[0][0]}» is paired; where runs of the "
        "row are unsolved it is a lower bound (≥), where runs of the first are it is left out. "
        f"Fake and real return: medians over the first {FIRST_DREAMS} episodes with dreams.",
        tables.markdown_table(
            ["row", *header, "difference to the first row", "fake / real return"], lines
        ),
        "![every run of every row](variants.png)",
    )


def bounded(solve: Results) -> np.ndarray:
    """A figure of each run, an unsolved one at the least that it can be."""
    return per_seed(solve, solve["budget"])


def limit(arms: Mapping[str, Results], column: str) -> int:
    """What an unsolved run counts as."""
    return int(max(arm[column]["budget"] for arm in arms.values()))


def _difference(solve: Results, first: Results) -> str:
    """How much later than the first row, in words."""
    if first["solved"] < first["seeds"]:
        return "-"
    difference = bounded(solve) - bounded(first)
    if solve["solved"] < solve["seeds"]:
        return f"≥ {difference.mean():+.0f}"
    return tables.with_interval(mean_of_runs(difference), sign="+")
