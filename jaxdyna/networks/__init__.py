"""Flax Linen modules. The rest of the package sees only parameters and functions."""

from jaxdyna.networks.frames import (
    ClassReward,
    EncoderDecoder,
    FrameModel,
    JointReward,
    LocalDynamics,
    LocalReward,
    SignedReward,
)
from jaxdyna.networks.layers import MLP, Convolution
from jaxdyna.networks.objects import RectangleDynamics, Resolution
from jaxdyna.networks.patches import Discriminator, Patched, from_patches, to_patches
from jaxdyna.networks.q_networks import (
    ConvolutionalQ,
    FeaturePointQ,
    GlimpseQ,
    PerceptronQ,
    PlainQ,
    glimpses,
)

__all__ = [
    "MLP", "ClassReward", "Convolution", "ConvolutionalQ", "Discriminator", "EncoderDecoder",
    "FeaturePointQ", "FrameModel", "GlimpseQ", "JointReward", "LocalDynamics", "LocalReward",
    "Patched", "PerceptronQ", "PlainQ", "RectangleDynamics", "Resolution", "SignedReward",
    "from_patches", "glimpses", "to_patches"]  # fmt: skip
