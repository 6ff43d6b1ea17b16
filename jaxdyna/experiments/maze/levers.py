"""The ``lean`` preset, one thing changed at a time: what it needs, what a worse model costs, and
whether sample efficiency grows with the model's accuracy (§5). And the grids in which ``tuned`` and
its baseline are tuned.
"""

from dataclasses import replace
from functools import partial

from jaxdyna.experiments.engine import Overrides, Study
from jaxdyna.experiments.maze.acting import MAZE
from jaxdyna.experiments.maze.arms import arms
from jaxdyna.experiments.maze.options import MazeOptions
from jaxdyna.experiments.report import sections as report
from jaxdyna.experiments.report.rows import rows
from jaxdyna.experiments.report.summaries import first_dreams
from jaxdyna.experiments.study.accuracy import Measure, accuracy, describe
from jaxdyna.experiments.study.grids import baselines, dreams, grid

OF = replace(MAZE, arms=partial(arms, judged=False), describe=())
OTHER = "agent: "
COLUMN = "first_solved"
MEASURE = Measure(
    curve="wrong_frames", episodes=35, hollow=OTHER,
    axis="share of frames predicted wrong (logarithmic)",
    said="The error is the share of frames that are predicted wrong anywhere, one step ahead. "
    "Every model is judged on the same new episodes: half of a uniformly random policy, half of "
    "one that drifts to the goal.",
    lines=("true environment as the model", "model-free", "model-free, as many updates"),
)  # fmt: skip
WORSE: dict[str, Overrides] = {
    "model: L2 loss": {"model_loss": "l2"},
    "model: L1 loss": {"model_loss": "l1"},
    "model: rare steps as they come": {"dyna.rare_share": None},
    "model: layers of (4, 4)": {"model_widths": (4, 4)},
    "model: layers of (32,)": {"model_widths": (32,)},
    "model: 100 updates an episode": {"dyna.model_updates": 100},
    "model: 10 updates an episode": {"dyna.model_updates": 10},
    "model: 3 updates an episode": {"dyna.model_updates": 3},
}
"""What changes the model alone."""
LEARNING: dict[str, Overrides] = {
    "N = 2": {"dyna.num_real_first": 2},
    "N = 15": {"dyna.num_real_first": 15},
    "dreams of 1 step(s), as many steps": {"dyna.dream_steps": 1, "dyna.dream_episodes": 2000},
    "dreams of 20 step(s), as many steps": {"dyna.dream_steps": 20, "dyna.dream_episodes": 100},
    "a quarter of the dreams": {"dyna.dream_episodes": 100, "agent.fake_capacity": 2000},
    "four times the dreams": {"dyna.dream_episodes": 1600, "agent.fake_capacity": 32000},
    "25% of a batch dreamed": {"hparams.agent.fake_share": 0.25},
    "90% of a batch dreamed": {"hparams.agent.fake_share": 0.9},
    "200 updates on dreams to 100 on real steps": {"agent.fake_updates": 100},
    "1600 updates on dreams to 100 on real steps": {"agent.fake_updates": 800},
    "dreams broken off where half a pixel is in doubt": {
        "hparams.dream.uncertainty_threshold": 0.5
    },
    "dreams of the newest 16 real episodes, not 2": {"agent.fake_capacity": 64000},
}
"""What changes how dreams are used and what the agent does with them, with the same model."""
CONTROLS: dict[str, Overrides] = {
    "untrained model (placebo)": {"arm": "placebo"},
    "true environment as the model": {"arm": "oracle"},
    "model-free": {"arm": "model_free"},
    "model-free, as many updates": {"arm": "more_updates"},
}


def levers(options: MazeOptions) -> dict[str, Overrides]:
    """Every row; those of `LEARNING`, and of what is kept of real episodes, are `OTHER` ones."""
    ten = 10 * options.steps
    other = LEARNING | {
        "the agent learns from the newest 10 real episodes only": {"agent.capacity": ten},
        "model and dreams know the newest 10 real episodes only": {"dyna.replay_capacity": ten},
    }
    renamed = {f"{OTHER}{name}": row for name, row in other.items()}
    return {"dyna (lean preset)": {}} | WORSE | renamed | CONTROLS


LEVERS = Study(
    name="levers",
    title="What does lean need in the Maze, and how good must its model be?",
    of=OF,
    preset="lean",
    rows=levers,
    common={
        "seeds": 4, "episodes": 100, "stop_after_solved": 0, "judged_on": "common",
        "size": 8, "obstacles": 3, "steps": 60,  # carries them all in two hours
        "dyna.eval_every": 0,
    },
    describe=(first_dreams, describe(MEASURE)),
    sections=(rows(COLUMN), accuracy(MEASURE, COLUMN), report.settings, report.spent),
)  # fmt: skip
BASELINES = grid(
    "baselines", "The strongest agent without a model in the Maze", OF, "model_free",
    lambda options: baselines(
        "agent", "hparams.agent", ratios=(0.25, 1, 2.25, 5), rates=(3e-4, 1e-3), between=20_000,
        said=lambda ratio: {"agent.updates": round(ratio * options.steps)},
    ),
)  # fmt: skip
DYNA_GRID = grid(
    "dyna_grid", "Dyna in the Maze, with as many settings", OF, "dyna",
    lambda options: dreams((100, 200, 400, 800), (0.5, 0.75), (3e-4, 1e-3), kept=160),
)  # fmt: skip
