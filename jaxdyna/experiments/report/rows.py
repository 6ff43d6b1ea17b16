"""The report of a study: every row beside the first, in one of the arms' figures of solving."""

from collections.abc import Mapping
from typing import Any

from jaxdyna.experiments.report import plots, tables
from jaxdyna.experiments.report.sections import paragraphs, told
from jaxdyna.experiments.report.summaries import FIRST_DREAMS, restricted
from jaxdyna.experiments.report.tables import Results, per_seed, whole
from jaxdyna.statistics import ratio_of_means


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
            "-" if arm is first else _ratio(arm[column], first[column]),
            f"{whole(dreams['fake_return'])} / {whole(dreams['real_return'])}" if dreams else "-",
        ]
    solved = {name: per_seed(arm[column]) for name, arm in results["arms"].items()}
    there = plots.solve_bars(record.out / "variants.png", solved, limit(results["arms"], column),
                             column.replace("_", " "))  # fmt: skip
    return paragraphs(
        f"{tables.runs(len(results['runs']['seeds']))} of each row. The first row is the "
        f"`{options.preset}` preset; every other one changes what it says. "
        f"{first['solve_rule'].capitalize()}. At most {options.episodes} episodes; an unsolved run "
        "counts as so many. The seeds are the same in "
        f"every row, so that the ratio to «{lines[0][0]}» is paired. "
        f"Fake and real return: medians over the first {FIRST_DREAMS} episodes with dreams.",
        tables.markdown_table(
            ["row", *header, "ratio to the first row", "fake / real return"], lines
        ),
        "![every run of every row](variants.png)" if there else "",
    )


def limit(arms: Mapping[str, Results], column: str) -> int:
    """What an unsolved run counts as."""
    return int(max(arm[column]["budget"] for arm in arms.values()))


def _ratio(solve: Results, first: Results) -> str:
    """To the first row's, run by run, in words."""
    ratio = ratio_of_means(restricted(solve), restricted(first), paired=True)
    said, ends = tables.number(ratio["ratio"], 2), tables.interval(ratio["ci95"], 2)
    return said if ends == "-" else f"{said} ({ends}; p {ratio['p']:.3f})"
