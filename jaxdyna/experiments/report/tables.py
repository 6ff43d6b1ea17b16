"""Numbers in words, and tables of them for Markdown."""

import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxdyna.statistics import Summary

Results = dict[str, Any]
Table = tuple[list[str], list[list[str]]]


def number(summary: Summary, statistic: str = "mean", digits: int = 0, sign: str = "") -> str:
    """A statistic in words; where unsolved runs leave a mean undefined, its lower bound."""
    value = summary[statistic]
    if value is None and statistic == "mean" and summary.get("restricted_mean") is not None:
        return f"≥ {summary['restricted_mean']:{sign},.{digits}f}"
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
    """``mean (low to high)``; the mean alone where there is no interval."""
    said, ends = number(summary, digits=digits, sign=sign), interval(summary["ci95"], digits)
    return said if ends == "-" else f"{said} ({ends})"


def per_seed(summary: Summary, unsolved: float = np.inf) -> np.ndarray:
    """A figure of each run ``[seeds]``."""
    return np.array([unsolved if one is None else one for one in summary["per_seed"]], float)


def label(name: str) -> str:
    """An entry's name with the last word of what was swept: ``dyna@learning_rate=0.01``; whole
    where two of these would be called the same.
    """
    words = re.findall(r"(\w+)=", name)
    alike = len(set(words)) < len(words)
    return name if alike else re.sub(r"(?<=[@,])[\w.]+\.(\w+=)", r"\1", name)


def solve_table(results: Results, figure: str = "episodes_to_solve") -> Table:
    """A row an arm: ``episodes_to_solve`` or ``first_solved``."""
    said, budget = figure.replace("_", " "), results["config"]["episodes"]
    header = ["arm", f"{said} (of {budget:,}): mean (95% interval)", "median", "solved"]
    return header, [
        [name, with_interval(arm[figure]), number(arm[figure], "median"),
         f"{arm[figure]['solved']}/{arm[figure]['seeds']}"]
        for name, arm in results["arms"].items()
    ]  # fmt: skip


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def paragraphs(*parts: str) -> str:
    """Put below each other; empty ones are left out."""
    return "\n\n".join(part.strip("\n") for part in parts if part)
