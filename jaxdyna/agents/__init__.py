"""Learners of behaviour."""

from jaxdyna.agents.dqn import DQNState, dqn
from jaxdyna.agents.dqn_settings import DQNConfig, DQNHParams
from jaxdyna.agents.reinforce import ReinforceConfig, ReinforceHParams, ReinforceState, reinforce

__all__ = [
    "DQNConfig",
    "DQNHParams",
    "DQNState",
    "ReinforceConfig",
    "ReinforceHParams",
    "ReinforceState",
    "dqn",
    "reinforce",
]
