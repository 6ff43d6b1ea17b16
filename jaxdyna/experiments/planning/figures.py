"""Figures of planners: what a decision earns against what it costs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxdyna.experiments.report.plots import COLOURS, save, subplots

SHADES = {
    "policy": "#0f7b6c",
    "MPC": "#c77700",
    "MPC, its own models": "#8c1d40",
    "MPC, learned values": "#c77700",
    "MPC to the goal": "#8c6d31",
    "CEM": "#d1495b",
    "CEM, learned values": "#d1495b",
    "MCTS": "#6a4c93",
    "MCTS, learned values": "#2f6db5",
    "MCTS, Gumbel": "#00798c",
    "MCTS, Gumbel, learned values": "#00798c",
}


def decisions(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Share of the return that could be had against milliseconds a decision, a panel an
    environment, a line a planner, a dot a budget.

    Args:
        path: the PNG.
        rows: of `jaxdyna.experiments.planning.budgets.measure`.
    """
    names = list(dict.fromkeys(row["environment"] for row in rows))
    figure, panels = subplots(1, len(names), figsize=(5.6 * len(names), 4.6), squeeze=False)
    for panel, name in zip(panels[0], names, strict=True):
        here = [row for row in rows if row["environment"] == name]
        for who, world in dict.fromkeys((row["who"], row["world"]) for row in here):
            own = [row for row in here if (row["who"], row["world"]) == (who, world)]
            label = who if who == "policy" else f"{who} ({world} world)"
            _line(panel, own, label, SHADES.get(who, "#444444"), world)
        panel.set_xscale("log")
        panel.set_xlabel("milliseconds a decision, one environment (logarithmic)")
        panel.set_title(name, loc="left", fontsize=10)
        panel.axhline(1, color="#888888", linewidth=0.8, linestyle=":")
        panel.spines[["top", "right"]].set_visible(False)
        panel.legend(fontsize=7, frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.2))
    panels[0, 0].set_ylabel("share of what could be had (bar: 95%)")
    save(figure, path)


def _line(panel: Any, rows: Sequence[Mapping[str, Any]], label: str, shade: str, world: str):
    rows = sorted(rows, key=lambda row: row["steps"])
    share = np.array([row["share"] for row in rows])
    ends = np.array([[share[n] if end is None else end for end in row["share_ci95"]]
                     for n, row in enumerate(rows)])  # fmt: skip
    panel.errorbar(
        [row["ms"] for row in rows],
        share,
        yerr=np.abs(ends.T - share),
        marker="*" if label == "policy" else "o",
        markersize=11 if label == "policy" else 4,
        markerfacecolor="white" if world == "true" else shade,
        linestyle="--" if world == "true" else "-",
        linewidth=1.3,
        elinewidth=0.8,
        color=shade,
        label=label,
    )


def solved_shares(
    path: Path, first_solved: Mapping[str, np.ndarray], known: Mapping[str, int]
) -> None:
    """The share of the runs whose solving window has begun, against real episodes. An arm with a
    poorer model has the colour of the same arm with a good one, and a broken line.

    Args:
        path: the PNG.
        first_solved: by arm, number of the window's first episode ``[seeds]``, infinity where
            unsolved.
        known: by arm the last episode at which it is known, where its line ends.
    """
    figure, panel = subplots(figsize=(7.4, 4.0))
    styles = ("-", "--", ":", "-.")
    seen: dict[str, int] = {}
    for name, values in first_solved.items():
        kind = name.split(",")[0]
        style = styles[seen.get(kind, 0) % len(styles)]
        seen[kind] = seen.get(kind, 0) + 1
        numbers = np.sort(values[np.isfinite(values)])
        steps = np.concatenate([[1], numbers, [max(known[name], 1)]])
        share = np.concatenate([[0], np.arange(1, len(numbers) + 1), [len(numbers)]]) / len(values)
        shade = COLOURS.get(kind, "#444444")
        panel.step(steps, share, where="post", color=shade, linestyle=style, label=name)
    panel.set_xscale("log")
    panel.set_xlabel("first real episode of the solving window (logarithmic)")
    panel.set_ylabel("share of the runs")
    panel.set_ylim(-0.02, 1.02)
    panel.legend(fontsize=7, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    panel.spines[["top", "right"]].set_visible(False)
    save(figure, path)
