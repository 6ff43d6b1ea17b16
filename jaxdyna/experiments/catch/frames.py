"""Predicting the frames of Catch."""

from dataclasses import dataclass
from typing import ClassVar

from jaxdyna.envs import Catch, CatchParams, FrameStack
from jaxdyna.experiments.frames import grids
from jaxdyna.experiments.frames.training import Training


@dataclass(frozen=True, kw_only=True)
class CatchFrames(grids.GridOptions):
    """Frame models of Catch, trained on a random policy's episodes."""

    channels: ClassVar = (0, 2)
    own_head: ClassVar = "joint"
    decided: ClassVar = grids.GridOptions.decided | {"steps": "the board"}

    def world(self) -> tuple[FrameStack, CatchParams]:
        """The game as a picture."""
        return FrameStack(Catch(frames=True)), CatchParams()


TUNED = CatchFrames(
    steps=9, horizon=9, kernels=(3, 2, 2), widths=(8, 8, 8), dense=128, lean_widths=(16, 16),
    paper=Training(1000, 0, 32, 3e-3, 0.2, None), lean=Training(1000, 0, 32, 1e-2))  # fmt: skip
FRAMES = grids.experiment(
    "Catch: predicting frames", {"tuned": TUNED}, {"tuned": {"seeds": 2, "stages": (10, 100)}},
    about=lambda record: "A random policy plays; F1 of lit pixels in new episodes of it.",
    classes=("ball", "paddle"), kinds=("missed", "caught", "neither"))  # fmt: skip
