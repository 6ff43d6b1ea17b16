"""What an experiment leaves on disk and says in the terminal: numbers, tables and their words."""

from __future__ import annotations

import os
import platform
import sys
import warnings
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from types import ModuleType
from typing import Any

import jax
import numpy as np
from rich.console import Console
from rich.table import Table

import jaxdyna
from jaxdyna.statistics import (
    SolveRule,
    Summary,
    episodes_to_solve,
    steps_before,
    summarise,
)

resource: ModuleType | None
try:
    import resource
except ImportError:  # Windows
    resource = None

Curves = Mapping[str, np.ndarray]
Results = dict[str, Any]

FIRST_DREAMS = 100
HELD_EPISODES = 50
QUANTILES = (5, 25, 50, 75, 95, 99)
PACKAGES = ("jax", "jaxlib", "flax", "optax", "numpy", "gymnasium")


def describe_arm(curves: Curves, rule: SolveRule) -> Results:
    """The Contract's figures of one arm.

    Args:
        curves: ``real_return`` and ``real_length``, ``[seeds, episodes]``, and others.
        rule: when a run counts as solved.
    """
    score = rule.score(curves)
    solved_at = episodes_to_solve(score, rule)
    first = solved_at - rule.window + 1
    solved = np.isfinite(solved_at)
    last = curves["real_return"][:, -rule.window :].mean(-1)
    held = score[:, -HELD_EPISODES:].mean(-1)
    steps = steps_before(curves["real_length"], first)
    # An unsolved run solves with its next episode at the earliest.
    episodes = curves["real_return"].shape[1]
    first_possible = max(episodes - rule.window + 2, 1)
    steps_at_least = curves["real_length"][:, : first_possible - 1].sum(-1)
    return {
        "episodes_to_solve": summarise(solved_at, at_least=episodes + 1),
        "first_solved": summarise(first, at_least=first_possible),
        "real_steps_to_solve": summarise(steps, at_least=steps_at_least),
        "first_at_threshold": summarise(_first_at(score, rule.level)),
        "final_return": summarise(last, solved),
        "solved_and_held": int((solved & (held >= rule.level)).sum()),
        "episodes_played": int(episodes),
        "solve_rule": str(rule),
    }


def _first_at(returns: np.ndarray, threshold: float) -> np.ndarray:
    """Number of the first single episode at or above the threshold, infinity without one."""
    reached = returns >= threshold
    return np.where(reached.any(1), reached.argmax(1) + 1.0, np.inf)


def whole(value: float) -> str:
    """A return in a table: without decimals; in powers of ten where a model has run away."""
    return f"{value:,.0f}" if abs(value) < 1e6 else f"{value:.0e}"


def first_dreams(curves: Curves, real_first: int) -> Results:
    """Medians of fake and real return and length over seeds and the `FIRST_DREAMS` episodes from
    real episode ``real_first``; empty for an arm without dreams, NaN where none took place.
    """
    if "fake_length" not in curves:
        return {}
    start = max(real_first - 1, 0)
    after = slice(start, start + FIRST_DREAMS)
    with warnings.catch_warnings(action="ignore"):
        return {
            name: float(np.nanmedian(curves[name][:, after]))
            for name in ("fake_return", "real_return", "fake_length", "real_length")
        }


def cores() -> int:
    """CPU cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def environment(earlier: Results | None = None) -> Results:
    """Versions and device, for ``results.json``; of memory the most that this process or, where it
    goes on with an ``earlier`` run, that one has taken.
    """
    device = jax.devices()[0]
    peaks = [peak_memory_gib(), ((earlier or {}).get("device") or {}).get("peak_memory_gib")]
    return {
        "versions": {"jaxdyna": jaxdyna.__version__, "python": platform.python_version()}
        | {name: version(name) for name in PACKAGES},
        "device": {
            "platform": device.platform,
            "kind": device.device_kind,
            "count": jax.device_count(),
            "cpu_cores": cores(),
            "peak_memory_gib": max((peak for peak in peaks if peak is not None), default=None),
        },
    }


def peak_memory_gib() -> float | None:
    """The most of the machine's own memory that this process has taken so far, None where the
    system does not say.
    """
    if resource is None:
        return None
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**30


def number(summary: Summary, statistic: str = "mean", digits: int = 0) -> str:
    """A statistic in words; where unsolved seeds leave a mean undefined, its lower bound."""
    value = summary[statistic]
    if value is None and statistic == "mean" and "mean_at_least" in summary:
        return f"≥ {summary['mean_at_least']:,.{digits}f}"
    return "-" if value is None else f"{value:,.{digits}f}"


def runs(count: int) -> str:
    """So many runs, in words."""
    return f"{count} run" if count == 1 else f"{count} runs"


def interval(ends: Sequence[float | None], digits: int = 0) -> str:
    """``low to high``, with ∞ for an open end; a dash where nothing is known."""
    if all(end is None for end in ends):
        return "-"
    low, high = ("∞" if end is None else f"{end:,.{digits}f}" for end in ends)
    return f"{low} to {high}"


def arm_table(
    results: Results, paper: Mapping[str, float], window: int = 100
) -> tuple[list[str], list[list[str]]]:
    """Header and rows of the table of arms, the paper's figure beside ours; ``window`` is the solve
    rule's.
    """
    header = [
        "arm", "paper", "episodes to solve: mean", "95% interval", "median", "IQM", "solved",
        "held", "first solved: median", "real steps before it: median",
        f"return of the last {window} played: mean",
    ]  # fmt: skip
    rows = []
    for name, arm in results["arms"].items():
        solve = arm["episodes_to_solve"]
        rows.append(
            [
                name,
                f"{paper[name]:g}" if name in paper else "-",
                number(solve),
                interval(solve["ci95"]),
                number(solve, "median"),
                number(solve, "iqm"),
                f"{solve['solved']}/{solve['seeds']}",
                f"{arm['solved_and_held']}/{solve['seeds']}",
                number(arm["first_solved"], "median"),
                number(arm["real_steps_to_solve"], "median"),
                number(arm["final_return"], digits=1),
            ]
        )
    return header, rows


def quantile_table(results: Results, figure: str) -> tuple[list[str], list[list[str]]]:
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


def short_table(
    results: Results, paper: Mapping[str, float], window: int = 100
) -> tuple[list[str], list[list[str]]]:
    """The same for the terminal: what fits 80 columns."""
    _, rows = arm_table(results, paper)
    header = ["arm", "paper", "episodes to solve", "median", "first", "solved", f"last {window}"]
    return header, [
        [row[0], row[1], f"{row[2]} ({row[3]})", row[4], row[8], row[6], row[10]] for row in rows
    ]


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def print_table(console: Console, title: str, header: Sequence[str], rows: Sequence[Sequence[str]]):
    """The same table for the terminal."""
    table = Table(title=title, title_justify="left")
    for position, name in enumerate(header):
        table.add_column(name, justify="left" if position == 0 else "right")
    for row in rows:
        table.add_row(*row)
    console.print(table)
