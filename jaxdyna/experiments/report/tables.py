"""Numbers in words, and tables of them for Markdown."""

import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxdyna.statistics import Summary

Results = dict[str, Any]
Table = tuple[list[str], list[list[str]]]
Columns = dict[str, list[str]]  #: of a table, by their headings


def number(value: float | None, digits: int = 0, sign: str = "") -> str:
    """A number in words, a dash where it is not known."""
    return "-" if value is None else f"{value:{sign},.{digits}f}"


def whole(value: float) -> str:
    """A return in a table: without decimals; in powers of ten where a model has run away."""
    return f"{value:,.0f}" if abs(value) < 1e6 else f"{value:.0e}"


def runs(count: int) -> str:
    """So many runs, in words."""
    return f"{count} run" if count == 1 else f"{count} runs"


def interval(ends: Sequence[float | None] | None, digits: int = 0) -> str:
    """``low to high``, with ∞ for an open end; a dash where nothing is known."""
    if ends is None or all(end is None for end in ends):
        return "-"
    low, high = ("∞" if end is None else f"{end:,.{digits}f}" for end in ends)
    return f"{low} to {high}"


def with_interval(summary: Summary, digits: int = 0, sign: str = "") -> str:
    """``mean (low to high)``, if known the restricted one; the mean alone without an interval."""
    known = summary.get("restricted_mean") is not None
    mean, ends = (summary[f"restricted_{name}" if known else name] for name in ("mean", "ci95"))
    said, beside = number(mean, digits, sign), interval(ends, digits)
    return said if beside == "-" else f"{said} ({beside})"


def p_value(p: float) -> str:
    """A p-value in words."""
    return "p < 0.001" if p < 0.001 else f"p = {p:.3f}"


def median(summary: Summary) -> str:
    """``median (low to high)``; one that unsolved runs leave unknown is above the budget."""
    value, ends = summary["median"], summary["median_ci95"]
    said = f"> {summary['budget']:,.0f}" if value is None else f"{value:,.0f}"
    return said if ends is None else f"{said} ({interval(ends)})"


def per_seed(summary: Summary, unsolved: float = np.inf) -> np.ndarray:
    """A figure of each run ``[seeds]``."""
    return np.array([unsolved if one is None else one for one in summary["per_seed"]], float)


def figure_at(arm: Results, path: str) -> Results:
    """A figure of an arm's entry, by its dotted path; empty where it has none."""
    for name in path.split("."):
        arm = arm.get(name, {})
    return arm


def label(name: str) -> str:
    """An entry's name with the last word of what was swept: ``dyna@learning_rate=0.01``; whole
    where two of these would be called the same.
    """
    words = re.findall(r"(\w+)=", name)
    alike = len(set(words)) < len(words)
    return name if alike else re.sub(r"(?<=[@,])[\w.]+\.(\w+=)", r"\1", name)


def solving(results: Results, figure: str = "episodes_to_solve", of: str = "arm") -> Columns:
    """A row an arm, in one of the figures of solving, by its dotted path."""
    every = {name: figure_at(arm, figure) for name, arm in results["arms"].items()}
    every = {name: found for name, found in every.items() if found}
    return {
        of: [*every],
        f"solved in {results['config']['episodes']:,}": [
            f"{one['solved']}/{one['seeds']}" for one in every.values()],
        f"{spoken(figure)}: mean (95% interval)": [*map(with_interval, every.values())],
        "median (95%)": [*map(median, every.values())]}  # fmt: skip


def spoken(figure: str) -> str:
    """A figure of solving, by its dotted path, in words."""
    kind, _, name = figure.rpartition(".")
    return f"{name} ({kind})".replace("_", " ") if kind else name.replace("_", " ")


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def side_by_side(columns: Columns) -> str:
    """A Markdown table of columns."""
    return markdown_table([*columns], [*zip(*columns.values(), strict=True)])


def paragraphs(*parts: str) -> str:
    """Put below each other; empty ones are left out."""
    return "\n\n".join(part.strip("\n") for part in parts if part)
