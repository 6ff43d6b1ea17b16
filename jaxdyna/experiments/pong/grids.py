"""The grids in which Pong's ``dyna`` and its baseline are tuned."""

from jaxdyna.experiments.pong.learning import PONG
from jaxdyna.experiments.study.grids import baselines, dreams, grid

BASELINES = grid(
    "baselines", "The strongest agent without a model in Pong", PONG, "model_free",
    lambda options: baselines(
        "agent", "hparams.agent", ratios=(0.5, 1, 2.25, 5), rates=(3e-4, 1e-3), between=10_000,
        said=lambda ratio: {"agent.updates": round(ratio * options.steps)},
    ),
)  # fmt: skip
DYNA_GRID = grid(
    "dyna_grid", "Dyna in Pong, with as many settings", PONG, "dyna",
    lambda options: dreams((50, 100, 200, 400), (0.5, 0.75), (3e-4, 1e-3), kept=200),
)  # fmt: skip
