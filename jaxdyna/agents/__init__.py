"""Learners of behaviour."""

from jaxdyna.agents.reinforce import ReinforceConfig, ReinforceHParams, ReinforceState, reinforce

__all__ = ["ReinforceConfig", "ReinforceHParams", "ReinforceState", "reinforce"]
