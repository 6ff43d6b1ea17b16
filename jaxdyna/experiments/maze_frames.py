"""Learning the Maze's dynamics from pixels (§3.2, Figs. 4 and 7): frame models trained on a random
policy's episodes, the paper's F1 table beside ours.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from jaxdyna.experiments import cli, frame_session, maze_report, maze_scores
from jaxdyna.experiments.frame_study import FrameExperiment
from jaxdyna.experiments.maze_model import make_study
from jaxdyna.experiments.maze_options import PRESETS, QUICK, training_of

PROG = "python -m jaxdyna.experiments.maze"
EXPERIMENT = FrameExperiment(
    name="maze_model",
    prog=PROG,
    out=Path("runs") / "maze-model",
    make_study=make_study,
    updates_at=lambda options, arm, stage: training_of(options, arm).updates_at(stage),
    number=int,
    note=lambda stage: f"{stage} episodes",
    describe=maze_scores.describe,
    figures=maze_report.figures,
    markdown=maze_report.markdown,
    summary=maze_report.summary,
)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the experiment from the command line; returns the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    options = cli.parse(QUICK if "--quick" in arguments else PRESETS, arguments, PROG)
    return frame_session.run(EXPERIMENT, options, arguments)
