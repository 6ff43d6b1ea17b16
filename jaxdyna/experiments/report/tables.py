"""Numbers in words, and tables of them, for Markdown and the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table as Drawn

from jaxdyna.statistics import Summary

Results = dict[str, Any]
Table = tuple[list[str], list[list[str]]]
QUANTILES = (5, 25, 50, 75, 95, 99)


def number(summary: Summary, statistic: str = "mean", digits: int = 0) -> str:
    """A statistic in words; where unsolved runs leave a mean undefined, its lower bound."""
    value = summary[statistic]
    if value is None and statistic == "mean" and summary.get("restricted_mean") is not None:
        return f"≥ {summary['restricted_mean']:,.{digits}f}"
    return "-" if value is None else f"{value:,.{digits}f}"


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


def with_interval(summary: Summary, digits: int = 0) -> str:
    """``mean (low to high)``; the mean alone where there is no interval."""
    said, ends = number(summary, digits=digits), interval(summary["ci95"], digits)
    return said if ends == "-" else f"{said} ({ends})"


def arm_table(results: Results, paper: Mapping[str, float]) -> Table:
    """A row an arm, the paper's figure beside ours."""
    rows, budget = [], results["config"]["episodes"]
    for name, arm in results["arms"].items():
        solve, steps = arm["episodes_to_solve"], arm["real_steps_to_solve"]
        rows.append(
            [
                name,
                *([f"{paper[name]:g}" if name in paper else "-"] if paper else []),
                with_interval(solve),
                number(solve, "median"),
                f"{solve['solved']}/{solve['seeds']}",
                number(steps, "median"),
            ]
        )
    header = ["arm", *(["paper"] if paper else [])]
    header += [f"episodes to solve (of {budget:,}): mean (95% interval)", "median", "solved"]
    return [*header, "real steps before: median"], rows


def end_table(results: Results, window: int) -> Table:
    """How each arm ended: episodes played, last returns, and whether what was solved held."""
    rows = [
        [
            name,
            f"{arm['episodes_played']['mean']:,.0f}",
            with_interval(arm["final_return"], 1),
            f"{arm['solved_and_held']}/{arm['final_return']['seeds']}",
        ]
        for name, arm in results["arms"].items()
    ]
    return ["arm", "episodes played", f"return of a run's last {window}: mean (95% interval)",
            "solved and held"], rows  # fmt: skip


def quantile_table(results: Results, figure: str) -> Table:
    """Quantiles of an arm's figure, such as ``first_solved``, over its runs."""
    header = ["arm", *(f"{percent}%" for percent in QUANTILES), "latest"]
    rows = []
    for name, arm in results["arms"].items():
        values = arm[figure]["per_seed"]
        first = np.array([np.inf if value is None else value for value in values])
        marks = np.percentile(first, [*QUANTILES, 100], method="inverted_cdf")
        shown = ["never" if np.isinf(mark) else f"{mark:,.0f}" for mark in marks]
        rows.append([name, *shown])
    return header, rows


def time_table(results: Results) -> Table:
    """Seconds of each arm, and of all."""
    timing = results["timing"]
    rows = [
        [name, f"{one.get('compile_s', 0):,.1f}",
         f"{one.get('run_s', one.get('measure_s', 0)):,.1f}"]
        for name, one in timing["arms"].items()
    ]  # fmt: skip
    rows.append(["all, with drawing", "", f"{timing['total_s']:,.1f}"])
    cores = results["device"]["cpu_cores"]
    return [f"arm ({cores} cores)", "compiling (s)", "running and judging (s)"], rows


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def print_table(console: Console, title: str, header: Sequence[str], rows: Sequence[Sequence[str]]):
    """The same table for the terminal."""
    table = Drawn(title=title, title_justify="left")
    for position, name in enumerate(header):
        table.add_column(name, justify="left" if position == 0 else "right")
    for row in rows:
        table.add_row(*row)
    console.print(table)
