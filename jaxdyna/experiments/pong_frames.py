"""Learning Pong's dynamics from pixels (§4.3, Fig. 9): the paper's models beside one that does not
blur.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from jaxdyna.experiments import cli, frame_session, pong_ale, pong_report, pong_scores
from jaxdyna.experiments.frame_study import FrameExperiment
from jaxdyna.experiments.pong_model import make_study
from jaxdyna.experiments.pong_options import POLICIES, PRESETS, QUICK, training_of

PROG = "python -m jaxdyna.experiments.pong"
EXPERIMENT = FrameExperiment(
    name="pong_model",
    prog=PROG,
    out=Path("runs") / "pong-model",
    make_study=make_study,
    updates_at=lambda options, arm, stage: training_of(options, arm).updates,
    number=POLICIES.index,
    note=lambda stage: f"{stage} policy",
    describe=pong_scores.describe,
    figures=pong_report.figures,
    markdown=pong_report.markdown,
    summary=pong_report.summary,
)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the experiment from the command line; returns the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    options = cli.parse(QUICK if "--quick" in arguments else PRESETS, arguments, PROG)
    try:
        return frame_session.run(EXPERIMENT, options, arguments)
    except (ImportError, pong_ale.GameOver) as error:
        cli.fail(str(error), PROG)
