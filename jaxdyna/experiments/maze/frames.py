"""Predicting the Maze's frames (§3.2, Figs. 4 and 7): the paper's F1 table beside ours."""

from dataclasses import dataclass
from typing import ClassVar

from jaxdyna.envs import FrameStack, Maze, MazeParams
from jaxdyna.experiments.engine import Record
from jaxdyna.experiments.frames import grids
from jaxdyna.experiments.frames.training import Training
from jaxdyna.experiments.report.tables import runs
from jaxdyna.fields import changed, setting


@dataclass(frozen=True, kw_only=True)
class MazeFrames(grids.GridOptions):
    """Action-conditional frame prediction in the Maze: the paper's F1 table and Fig. 7."""

    channels: ClassVar = (2, 0, 1)
    dream_from: ClassVar = 10

    size: int = setting(16, "cells a side of the maze", at_least=2, at_most=1000)
    obstacles: int = setting(5, "how many there are", at_least=0)
    collision_reward: float = setting(-5.0, "earned on a step that ends on an obstacle's cell")
    goal_reward: float = setting(1.0, "earned on a step that ends on the goal")

    def world(self) -> tuple[FrameStack, MazeParams]:
        """The maze, and its params."""
        params = MazeParams(self.collision_reward, self.goal_reward, self.steps)
        return FrameStack(Maze(self.size, self.obstacles)), params


def about(record: Record) -> str:
    """What was done."""
    options = record.options
    return (
        f"{runs(options.seeds)}. In each a uniformly random policy plays {options.episodes} "
        f"episodes of {options.steps} steps. A model, four frames and the action in, the next "
        "frame out, is trained on the first so many of them, each time from scratch, and judged on "
        f"{options.held_out} new episodes of the same policy: F1 of lit pixels over all steps, the "
        "first ones included, where four equal frames do not tell which way the obstacles will go. "
        f"Spilled beliefs are those above {grids.FAINT:g}. A step on the goal with an obstacle on "
        "it is a collision; a random policy hardly ever sees the goal, in training or here. Dreams "
        f"begin at step {options.dream_from}. Mean over runs and 95% interval."
    )


TUNED = MazeFrames()
LEAN = changed(TUNED, {"preset": "lean", "arms": ("lean",)})
FEW = {
    "seeds": 2, "episodes": 100, "held_out": 5, "widths": (8, 8, 8), "dense": 128,
    "lean_widths": (32, 32), "paper": Training(300, 0, 32, 3e-3, 0.2, None),
    "lean": Training(500, 0, 32, 1e-2)}  # fmt: skip
FRAMES = grids.experiment(
    "The Maze: predicting frames",
    {"tuned": TUNED, "lean": LEAN},
    {"tuned": FEW | {"arms": ("paper", "paper_l2", "paper_l1", "lean")}, "lean": FEW},
    about=about,
    classes=("agent", "obstacles", "goal"),
    kinds=("collision", "goal", "neither", "collision in the first step"),
    paper={"10": (0.83, 0.22, 0.97), "100": (0.92, 0.83, 0.99), "300": (0.98, 0.93, 1.0)},
)
