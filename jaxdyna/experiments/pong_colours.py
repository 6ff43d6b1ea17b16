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
    uint8. A pixel in any other colour shows none of them.
    """
    if palette == CHANNELS:
        return stack
    frames = jnp.split(stack, stack.shape[-1] // 3, axis=-1)
    colours = (palette.opponent, palette.own, palette.ball)
    seen = [
        (frame == jnp.array(colour, jnp.uint8)).all(-1) for frame in frames for colour in colours
    ]
    return 255 * jnp.stack(seen, axis=-1).astype(jnp.uint8)


def in_colours(model: DynamicsModel, palette: Palette) -> DynamicsModel:
    """A model of objects in channels of their own, in a world of these colours."""
    if palette == CHANNELS:
        return model

    def inward(stack: jax.Array) -> jax.Array:
        return in_channels(stack, palette)

    def outward(frame: jax.Array) -> jax.Array:
        return picture_of(frame > 127, palette)

    return translated(model, inward, outward)
