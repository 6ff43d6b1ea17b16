"""Dynamics models, and the environment made of one."""

from jaxdyna.models.adversarial import (
    AdversarialHParams,
    Adversary,
    AdversaryConfig,
    discriminator,
    gan_adam,
)
from jaxdyna.models.environment import (
    DreamHParams,
    LearnedEnvironment,
    LearnedParams,
    LearnedState,
    never,
    probability_rule,
    threshold_rule,
    uncertain,
    uniform_start,
)
from jaxdyna.models.objects import RectangleConfig, rectangle_probability, rectangles
from jaxdyna.models.pixels import PixelConfig, PixelHParams, PixelState, frame_probability, pixels
from jaxdyna.models.supervised import (
    SupervisedConfig,
    SupervisedHParams,
    SupervisedParams,
    supervised,
)

__all__ = [
    "AdversarialHParams", "Adversary", "AdversaryConfig", "DreamHParams", "LearnedEnvironment",
    "LearnedParams", "LearnedState", "PixelConfig", "PixelHParams", "PixelState", "RectangleConfig",
    "SupervisedConfig", "SupervisedHParams", "SupervisedParams",
    "discriminator", "frame_probability", "gan_adam", "never", "pixels",
    "probability_rule", "rectangle_probability", "rectangles", "supervised",
    "threshold_rule", "uncertain", "uniform_start"]  # fmt: skip
