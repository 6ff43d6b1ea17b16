"""jaxdyna: does a learned model of the environment make reinforcement learning sample-efficient?

Importing it registers ``jaxdyna/CartPole-v0``, ``-v1`` and ``jaxdyna/Maze-v0`` with Gymnasium.
"""

from typing import Any

from jaxdyna import envs as envs
from jaxdyna.rollout import rollout as rollout
from jaxdyna.sweep import sweep as sweep


def load(folder: Any, *parts: Any) -> Any:
    """What a run left in its folder: `jaxdyna.experiments.engine.loaded.load`, imported when it is
    called, since nobody else needs experiments.
    """
    from jaxdyna.experiments.engine import loaded  # noqa: PLC0415

    return loaded.load(folder, *parts)


__version__ = "0.1.0"
