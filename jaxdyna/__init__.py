"""jaxdyna: does a learned model of the environment make reinforcement learning sample-efficient?

Importing it registers ``jaxdyna/CartPole-v0``, ``-v1`` and ``jaxdyna/Maze-v0`` with Gymnasium.
"""

from jaxdyna import envs as envs
from jaxdyna.rollout import rollout as rollout
from jaxdyna.sweep import sweep as sweep

__version__ = "0.1.0"
