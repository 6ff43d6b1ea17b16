"""Our model of Pong where frames are in the game's colours: objects are told by theirs."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxdyna.envs import CHANNELS, Palette
from jaxdyna.envs.pong_screen import picture_of, shares_of
from jaxdyna.models import translated
from jaxdyna.types import DynamicsModel


def in_channels(stack: jax.Array, palette: Palette) -> jax.Array:
    """A stack ``[..., H, W, 3 * frames]`` in these colours, each object in a channel of its own."""
    if palette == CHANNELS:
        return stack
    frames = jnp.split(stack, stack.shape[-1] // 3, axis=-1)
    seen = jnp.concatenate([shares_of(frame, palette) > 0.5 for frame in frames], axis=-1)
    return 255 * seen.astype(jnp.uint8)


def in_colours(model: DynamicsModel, palette: Palette) -> DynamicsModel:
    """A model of objects in channels of their own, in a world of these colours."""
    if palette == CHANNELS:
        return model

    def inward(stack: jax.Array) -> jax.Array:
        return in_channels(stack, palette)

    def outward(frame: jax.Array) -> jax.Array:
        return picture_of(frame > 127, palette)

    return translated(model, inward, outward)
