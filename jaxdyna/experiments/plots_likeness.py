"""The figure of two games that should be one."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from jaxdyna.experiments.report.plots import save, subplots

COLOURS = ("#c0392b", "#0f7b6c")


def beside(path: Path, found: Mapping[str, Mapping[str, np.ndarray]], paddle: int) -> None:
    """Rally lengths, the ball's speed, bounce angles and random players' points of both games.

    Args:
        path: the PNG.
        found: by the game's name, what `pong_likeness` counts.
        paddle: its height in pixels.
    """
    figure, panels = subplots(2, 3, figsize=(12.5, 7))
    (rally, speed, own), (gap, score, opponent) = panels
    for number, (name, values) in enumerate(found.items()):
        look = {"color": COLOURS[number], "label": name}
        _shares(rally, values["rally"], look)
        _shares(gap, values["gap"], look)
        _shares(score, values["score"], look)
        speeds = np.array([1, 2, 3])
        shares = [(values["across"] == at).mean() for at in speeds]
        speed.bar(speeds + 0.38 * (number - 0.5), shares, 0.36, **look)
        for panel, side in ((own, "own"), (opponent, "opponent")):
            shift = np.random.default_rng(0).uniform(-0.3, 0.3, len(values[f"{side}_place"]))
            places = values[f"{side}_place"] + shift + 0.5 * (number - 0.5)
            panel.plot(places, values[f"{side}_angle"], ".", alpha=0.35, markersize=4, **look)
    rally.set_xscale("log")
    said = {
        rally: ("rallies of the shaky player", "frames from a serve to its point", "share"),
        speed: ("the ball's speed across", "pixels a frame", "share of the flight"),
        own: ("bounces off the own paddle", "", "degrees below the horizontal"),
        gap: ("random players", "steps from point to point", "share"),
        score: ("random players", "score of a game", "share"),
        opponent: ("bounces off the opponent's", "", "degrees below the horizontal"),
    }
    for panel, (title, across, up) in said.items():
        panel.set_title(title, fontsize=10, loc="left")
        panel.set_xlabel(across or "pixels from the paddle's top down to the ball's")
        panel.set_ylabel(up)
        panel.grid(alpha=0.3)
        panel.spines[["top", "right"]].set_visible(False)
    for panel in (own, opponent):
        panel.set_xlim(-8, paddle + 4)
    speed.set_xticks([1, 2, 3])
    for mark in rally.legend(fontsize=9, frameon=False).legend_handles:
        mark.set_alpha(1)
    save(figure, path)


def _shares(panel: Axes, values: np.ndarray, look: dict[str, Any]) -> None:
    """The share of the values up to each."""
    ordered = np.sort(values)
    panel.step(ordered, np.arange(1, len(ordered) + 1) / len(ordered), where="post", **look)
