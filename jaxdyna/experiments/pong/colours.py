"""Our model of Pong where frames are in the game's colours: objects are told by theirs."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxdyna.envs import CHANNELS, Palette
from jaxdyna.envs.pong_screen import picture_of
from jaxdyna.models import translated
from jaxdyna.types import DynamicsModel


def in_channels(stack: jax.Array, palette: Palette) -> jax.Array:
    """A stack ``[..., H, W, 3 * frames]`` in these colours, each object in a channel of its own,
    uint8. They are told by how red they are, in which they all differ.
    """
    if palette == CHANNELS:
        return stack
    reds = jnp.array([colour[0] for colour in (palette.opponent, palette.own, palette.ball)])
    red = stack.reshape(*stack.shape[:-1], -1, 3)[..., :1]
    return 255 * (red == reds.astype(jnp.uint8)).reshape(stack.shape).astype(jnp.uint8)


def in_colours(model: DynamicsModel, palette: Palette) -> DynamicsModel:
    """A model of objects in channels of their own, in a world of these colours."""
    if palette == CHANNELS:
        return model

    def inward(stack: jax.Array) -> jax.Array:
        return in_channels(stack, palette)

    def outward(frame: jax.Array) -> jax.Array:
        return picture_of(frame > 127, palette)

    return translated(model, inward, outward)
