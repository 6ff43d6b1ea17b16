"""Learners of behaviour."""

from jaxdyna.agents.cloning import CloningConfig, CloningState, cloning
from jaxdyna.agents.dqn import DQNState, dqn, q_values, real_memory
from jaxdyna.agents.dqn_settings import DQNConfig, DQNHParams
from jaxdyna.agents.linear_regulator import (
    LinearRegulator,
    LinearRegulatorHParams,
    linear_regulator,
)
from jaxdyna.agents.linear_search import LinearPolicy, LinearSearchHParams, linear_search
from jaxdyna.agents.reinforce import ReinforceConfig, ReinforceHParams, policy_logits, reinforce

__all__ = [
    "CloningConfig", "CloningState", "DQNConfig", "DQNHParams", "DQNState",
    "LinearPolicy", "LinearRegulator", "LinearRegulatorHParams", "LinearSearchHParams",
    "ReinforceConfig", "ReinforceHParams", "cloning", "dqn", "linear_regulator", "linear_search",
    "policy_logits", "q_values", "real_memory", "reinforce"]  # fmt: skip
