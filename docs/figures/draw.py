"""Draws the pages' diagrams into this folder: ``python docs/figures/draw.py``."""

from pathlib import Path

import jax
import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

from jaxdyna.envs import Maze, MazeParams
from jaxdyna.envs.maze import MOVES
from jaxdyna.experiments.report.plots import BLUE, GREEN, ORANGE, VERMILION, WIDTH, save, subplots

HERE = Path(__file__).parent
POINTER = {"arrowstyle": "-|>", "color": VERMILION, "linewidth": 1.5}


def canvas(height, width=100.0):
    """A figure of a page's width without axes, ``width`` units across, y pointing up."""
    figure, panel = subplots(figsize=(WIDTH, height))
    panel.set(xlim=(-1, width + 1), ylim=(-1, width * height / WIDTH), aspect="equal")
    panel.axis("off")
    return figure, panel


def box(panel, x, y, width, height, text, color):
    """A box with its lower left corner at ``(x, y)``; returns its middle."""
    panel.add_patch(FancyBboxPatch(
        (x, y), width, height, boxstyle="round,pad=0,rounding_size=1.2", linewidth=1.6,
        edgecolor=color, facecolor=np.array(to_rgb(color)) * 0.15 + 0.85,
    ))  # fmt: skip
    panel.text(x + width / 2, y + height / 2, text, ha="center", va="center", fontsize=10)
    return x + width / 2, y + height / 2


def arrow(panel, start, end, text="", at=(0.0, 0.0), **style):
    """An arrow, and what it says, so far from its middle."""
    panel.add_patch(FancyArrowPatch(
        start, end, arrowstyle="-|>", mutation_scale=14, linewidth=1.5,
        **{"color": "black", "shrinkA": 0, "shrinkB": 0} | style,
    ))  # fmt: skip
    middle = (np.array(start) + end) / 2 + at
    panel.text(*middle, text, ha="center", va="center", fontsize=10)


def maze():
    """Fig. 1: the Maze at the start of an episode, and where its obstacles are about to go."""
    world = Maze()
    _, state = world.reset(jax.random.key(4), MazeParams())
    figure, panel = subplots(figsize=(WIDTH, 4.2))
    panel.imshow(np.asarray(world.frame(state)), interpolation="nearest")
    lines = np.arange(world.size + 1) - 0.5
    panel.hlines(lines, lines[0], lines[-1], color="#555555", linewidth=0.6)
    panel.vlines(lines, lines[0], lines[-1], color="#555555", linewidth=0.6)
    obstacles = np.asarray(state.obstacles)
    for (row, column), (down, right) in zip(obstacles, MOVES[state.directions], strict=True):
        ahead = column + 1.3 * right, row + 1.3 * down
        panel.annotate("", ahead, (column, row), arrowprops=POINTER | {"color": "white"})
    spots = {"agent": state.agent, "goal": state.goal,
             "an obstacle": obstacles[obstacles[:, 1].argmax()]}  # fmt: skip
    places = {"agent": (-6, 13), "goal": (18, 2.5), "an obstacle": (18, 9)}
    for name, (row, column) in spots.items():
        panel.annotate(name, (column, row), places[name], fontsize=11, va="center",
                       arrowprops=POINTER)  # fmt: skip
    panel.set(xlim=(-6.5, 23.5), ylim=(15.6, -0.6))
    panel.axis("off")
    save(figure, HERE / "maze.png")


def loop():
    """Fig. 3: the two phases."""
    figure, panel = canvas(4.6)
    box(panel, 2, 38, 30, 12, "real environment", BLUE)
    box(panel, 68, 38, 30, 12, "policy", GREEN)
    box(panel, 2, 6, 30, 12, "memory of\nreal steps", BLUE)
    box(panel, 68, 6, 30, 12, "learned model,\nplayed like an environment", ORANGE)
    arrow(panel, (32, 46), (68, 46), "1  a real episode:\nobservations, rewards", (0, 4.5))
    arrow(panel, (68, 42), (32, 42), "actions", (0, -2.3))
    arrow(panel, (17, 38), (17, 18), "its steps\nare kept", (8, 0))
    arrow(panel, (32, 14), (68, 14), "2  the model learns", (0, 2.3))
    arrow(panel, (32, 10), (68, 10), "dreams begin at states seen", (0, -2.3), linestyle="--")
    arrow(panel, (80, 18), (80, 38), "3  fake episodes,\nfrom episode N on", (-12.5, 0))
    arrow(panel, (86, 38), (86, 18), "actions", (6.5, 0))
    panel.text(50, 0.5, "Up to episode N nobody dreams; from then on 1, 2 and 3 take turns.",
               ha="center", fontsize=10)  # fmt: skip
    save(figure, HERE / "loop.png")


def networks():
    """Figs. 2 and 4: the paper's models."""
    figure, panel = canvas(6.2)
    panel.text(0, 72, "Fig. 2: CartPole, a perceptron (Eq. 1)", fontsize=11)
    box(panel, 0, 55, 17, 12, "state (4)\nand action", BLUE)
    box(panel, 26, 55, 15, 12, "dense 256\nReLU", ORANGE)
    box(panel, 50, 55, 15, 12, "dense 256\nReLU", ORANGE)
    heads = {"next state (4)": 65.5, "reward": 58.5, "end: probability": 51.5}
    for name, y in heads.items():
        box(panel, 76, y, 24, 5.5, name, GREEN)
        arrow(panel, (65, 61), (76, y + 2.7))
    arrow(panel, (17, 61), (26, 61))
    arrow(panel, (41, 61), (50, 61))

    panel.text(
        0, 44, "Fig. 4: the Maze, an encoder and a decoder (after Oh et al. 2015)", fontsize=11
    )
    row = 27
    box(panel, 0, row, 15, 13, "4 frames\n16x16x12", BLUE)
    box(panel, 20, row, 25, 13, "3 convolutions\n5x5, 4x4, 4x4\nto 6x6x32", ORANGE)
    box(panel, 50, row, 15, 13, "dense 256", ORANGE)
    box(panel, 74, row + 2.5, 8, 8, "times", "#666666")
    arrow(panel, (15, row + 6.5), (20, row + 6.5))
    arrow(panel, (45, row + 6.5), (50, row + 6.5))
    arrow(panel, (65, row + 6.5), (74, row + 6.5))
    box(panel, 0, 8, 15, 13, "action\none of 5", BLUE)
    box(panel, 50, 14.5, 15, 6.5, "dense 256", ORANGE)
    arrow(panel, (15, 18), (50, 18))
    arrow(panel, (65, 18), (77, row + 2.5))
    panel.text(84, row + 6.5, "element by\nelement", fontsize=10, va="center")
    box(panel, 72, 3, 13, 9, "dense\nto 6x6x32", ORANGE)
    arrow(panel, (79.5, row + 2.5), (79.5, 12))
    box(panel, 37, 0, 30, 11, "3 transposed convolutions\n4x4, 4x4, 5x5", ORANGE)
    arrow(panel, (72, 7), (67, 7))
    box(panel, 15.5, 0, 17, 7, "next frame\n16x16x3", GREEN)
    arrow(panel, (37, 3.5), (32.5, 3.5))
    save(figure, HERE / "networks.png")


if __name__ == "__main__":
    maze()
    loop()
    networks()
