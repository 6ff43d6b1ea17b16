"""Dynamics models, and the environment made of one."""

from jaxdyna.models.environment import (
    LearnedEnvironment,
    LearnedParams,
    LearnedState,
    sample_rule,
    threshold_rule,
    uniform_start,
)
from jaxdyna.models.supervised import (
    SupervisedConfig,
    SupervisedHParams,
    SupervisedParams,
    SupervisedState,
    supervised,
)

__all__ = [
    "LearnedEnvironment",
    "LearnedParams",
    "LearnedState",
    "SupervisedConfig",
    "SupervisedHParams",
    "SupervisedParams",
    "SupervisedState",
    "sample_rule",
    "supervised",
    "threshold_rule",
    "uniform_start",
]
