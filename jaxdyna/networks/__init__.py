"""Flax Linen modules. The rest of the package sees only parameters and functions."""

from jaxdyna.networks.frames import (
    EncoderDecoder,
    FrameModel,
    JointReward,
    LocalDynamics,
    LocalReward,
    SignedReward,
)
from jaxdyna.networks.layers import MLP, Convolution
from jaxdyna.networks.patches import Discriminator, Patched, from_patches, to_patches
from jaxdyna.networks.places import PlaceQ
from jaxdyna.networks.rectangles import RectangleDynamics
from jaxdyna.networks.values import ConvolutionalQ, GlimpseQ, PerceptronQ, glimpses

__all__ = [
    "MLP",
    "Convolution",
    "ConvolutionalQ",
    "Discriminator",
    "EncoderDecoder",
    "FrameModel",
    "GlimpseQ",
    "JointReward",
    "LocalDynamics",
    "LocalReward",
    "Patched",
    "PerceptronQ",
    "PlaceQ",
    "RectangleDynamics",
    "SignedReward",
    "from_patches",
    "glimpses",
    "to_patches",
]
