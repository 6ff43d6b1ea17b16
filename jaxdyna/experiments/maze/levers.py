"""The ``lean`` preset, one thing changed at a time: what it needs, what a worse model costs, and
whether sample efficiency grows with the model's accuracy (§5).
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

from jaxdyna.experiments.engine import Overrides, Study
from jaxdyna.experiments.maze.acting import MAZE
from jaxdyna.experiments.maze.arms import arms
from jaxdyna.experiments.maze.options import LEAN, MazeOptions
from jaxdyna.experiments.report import sections as report
from jaxdyna.experiments.report.rows import rows, summary
from jaxdyna.experiments.report.summaries import first_dreams
from jaxdyna.experiments.study.accuracy import Measure, accuracy, describe

OTHER = "agent: "
COLUMN = "first_solved"
MEASURE = Measure(
    curve="wrong_frames",
    episodes=35,
    axis="share of frames predicted wrong (logarithmic)",
    said="The error is the share of frames that are predicted wrong anywhere, one step ahead. "
    "Every model is judged on the same new episodes: half of a uniformly random policy, half of "
    "one that drifts to the goal.",
    lines=("true environment as the model", "model-free", "model-free, as many updates"),
    hollow=OTHER,
)
WORSE: dict[str, Overrides] = {
    "model: L2 loss": {"model_loss": "l2"},
    "model: L1 loss": {"model_loss": "l1"},
    "model: rare steps as they come": {"dyna.rare_share": None},
    "model: layers of (4, 4)": {"model_widths": (4, 4)},
    "model: layers of (32,)": {"model_widths": (32,)},
    "model: 10 updates an episode": {"dyna.model_updates": 10},
    "model: 3 updates an episode": {"dyna.model_updates": 3},
}
"""What changes the model alone."""
CONTROLS: dict[str, Overrides] = {
    "untrained model (placebo)": {"arm": "placebo"},
    "true environment as the model": {"arm": "oracle"},
    "model-free": {"arm": "model_free"},
    "model-free, as many updates": {"arm": "more_updates"},
}


def levers(options: MazeOptions) -> dict[str, Overrides]:
    """Every row."""
    other = {f"{OTHER}{name}": row for name, row in other_dreams(options).items()}
    return {"dyna (lean preset)": {}} | WORSE | other | CONTROLS


def other_dreams(options: MazeOptions) -> dict[str, Overrides]:
    """What changes how dreams are used, or the agent, with the same model."""
    dreams, length = options.dyna.dream_episodes, options.dyna.dream_steps or options.steps
    steps, kept, some = dreams * length, options.agent.fake_capacity, 10 * options.steps
    changed: dict[str, Overrides] = {
        f"N = {first}": {"dyna.num_real_first": first} for first in (5, 30)
    }
    changed |= {
        f"dreams of {each} step(s), as many steps": {
            "dyna.dream_steps": each, "dyna.dream_episodes": steps // each,
        }
        for each in (1, 20)
    }  # fmt: skip
    changed |= {
        f"{count} dreams an episode, not {LEAN.dyna.dream_episodes}": {
            "dyna.dream_episodes": count, "agent.fake_capacity": kept * count // dreams,
        }
        for count in (100, 1600)
    }  # fmt: skip
    changed |= {
        f"{share:.0%} of a batch dreamed": {"hparams.agent.fake_share": share}
        for share in (0.25, 0.9)
    }
    changed |= {
        f"{updates} updates on dreams to {LEAN.agent.updates} on real steps": {
            "agent.fake_updates": updates
        }
        for updates in (100, 800)
    }
    return changed | {
        "dreams broken off where half a pixel is in doubt": {"hparams.disagreement_threshold": 0.5},
        "the agent learns from the newest 10 real episodes only": {"agent.capacity": some},
        "model and dreams know the newest 10 real episodes only": {"dyna.replay_capacity": some},
        "dreams of the newest 2 real episodes only": {"agent.fake_capacity": 2 * steps},
    }


def describe_dreams(options: MazeOptions, curves: Any) -> dict[str, Any]:
    """The first dreams beside the truth."""
    return {"first_dreams": first_dreams(curves, options.dyna.num_real_first)}


LEVERS = Study(
    name="levers",
    title="What does lean need in the Maze, and how good must its model be?",
    of=replace(MAZE, arms=partial(arms, judged=False), describe=()),
    preset="lean",
    rows=levers,
    common={
        "seeds": 4, "episodes": 100, "stop_after_solved": 0, "judged_on": "common",
        "size": 8, "obstacles": 3, "steps": 60,  # carries them all in two hours
    },
    describe=(describe_dreams, describe(MEASURE)),
    sections=(rows(COLUMN), accuracy(MEASURE, COLUMN), report.settings, report.spent),
    summary=summary(COLUMN),
)  # fmt: skip
