"""Dynamics models, and the environment made of one."""

from jaxdyna.models.environment import (
    LearnedEnvironment,
    LearnedParams,
    LearnedState,
    sample_rule,
    threshold_rule,
    uniform_start,
)
from jaxdyna.models.pixels import (
    PixelConfig,
    PixelHParams,
    PixelState,
    frame_probability,
    pixels,
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
    "PixelConfig",
    "PixelHParams",
    "PixelState",
    "SupervisedConfig",
    "SupervisedHParams",
    "SupervisedParams",
    "SupervisedState",
    "frame_probability",
    "pixels",
    "sample_rule",
    "supervised",
    "threshold_rule",
    "uniform_start",
]
