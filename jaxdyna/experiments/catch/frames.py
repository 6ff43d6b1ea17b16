"""Predicting the frames of Catch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from jaxdyna.envs import Catch, CatchParams, FrameStack
from jaxdyna.experiments.engine import Experiment
from jaxdyna.experiments.frames import grids
from jaxdyna.experiments.frames.options import Training
from jaxdyna.experiments.frames.report import FrameReport

STEPS = 9


@dataclass(frozen=True, kw_only=True)
class CatchFrames(grids.GridOptions):
    """Frame models of Catch, trained on a random policy's episodes."""

    channels: ClassVar = (0, 2)
    own_head: ClassVar = "signed"
    dream_from: ClassVar = 0
    kinds: ClassVar = 3
    steps: ClassVar = STEPS

    def world(self) -> tuple[FrameStack, CatchParams]:
        """The game as a picture."""
        return FrameStack(Catch(frames=True)), CatchParams()


TUNED = CatchFrames(
    horizon=STEPS, kernels=(3, 2, 2), widths=(8, 8, 8), dense=128, lean_widths=(16, 16),
    paper=Training(1000, 0, 32, 3e-3, 0.2, None), lean=Training(1000, 0, 32, 1e-2),
)  # fmt: skip
REPORT = FrameReport(
    about=lambda record: "A random policy plays; F1 of lit pixels in new episodes of it.",
    said=grids.SAID, classes=("ball", "paddle"), kinds=("missed", "caught", "neither"),
    prefer=grids.near, rules=grids.RULES,
)  # fmt: skip
FRAMES = Experiment(
    name="frames", title="Catch: predicting frames", presets={"tuned": TUNED}, arms=grids.arms,
    quick={"tuned": {"seeds": 2, "stages": (10, 100)}}, describe=(REPORT.describe,),
    sections=REPORT.sections, summary=REPORT.summary,
)  # fmt: skip
