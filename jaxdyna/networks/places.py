"""Values of actions from where things are."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import linen as nn

from jaxdyna.networks.values import dueling, normalised


class PlaceQ(nn.Module):
    """Values of actions from a perceptron on where each colour is: for games in which every colour
    is one thing. Of each channel of a stack it takes the mean row and column, as feature points do
    (Finn et al. 2016), how that moved from frame to frame, how far the newest frame's colours are
    from one another, and the newest frame's rows and columns, one by one. A blurred thing is at
    its mean place, and pale. The perceptron is normalised as `ConvolutionalQ` is.

    Attributes:
        num_actions: how many values.
        channels: of one frame.
        hidden: widths of the perceptron's hidden layers.
    """

    num_actions: int
    channels: int = 3
    hidden: tuple[int, ...] = (256, 256)

    @nn.compact
    def __call__(self, stack: jax.Array) -> jax.Array:
        """From ``[N, H, W, C * frames]`` in [0, 1] to ``[N, actions]``, dueling (Wang et al.
        2016).
        """
        count = stack.shape[0]
        place, mass = mean_places(stack)
        place = place.reshape(count, -1, self.channels, 2)
        mass = mass.reshape(count, -1, self.channels, 1)
        there = jnp.minimum(mass, 1)
        moved = (place[:, 1:] - place[:, :-1]) * there[:, 1:] * there[:, :-1]
        first, second = jnp.triu_indices(self.channels, 1)
        together = there[:, -1, first] * there[:, -1, second]
        apart = (place[:, -1, second] - place[:, -1, first]) * together
        newest = stack[..., -self.channels :]
        parts = [place, there, 8 * moved, apart, jnp.tanh(8 * apart), newest.max(1), newest.max(2)]
        x = jnp.concatenate([part.reshape(count, -1) for part in parts], axis=-1)
        return dueling(nn.Dense(self.num_actions + 1)(normalised(x, self.hidden)))


def mean_places(x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Of pictures ``[N, H, W, C]``: mean row and column of each channel in [-1, 1], ``[N, C, 2]``,
    0 where it is dark, and how much is lit, ``[N, C]``.
    """
    by_row, by_column = x.sum(2), x.sum(1)
    mass = by_row.sum(1)
    rows, columns = (jnp.linspace(-1, 1, length) for length in x.shape[1:3])
    place = jnp.stack([rows @ by_row, columns @ by_column], axis=-1)
    return place / jnp.maximum(mass, 0.5)[..., None], mass
