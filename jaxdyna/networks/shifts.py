"""Frames in which things move as wholes."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import linen as nn

NEVER = 1e-4
"""The least and, from 1, the most that is believed of a pixel: the loss stays finite."""


class ShiftDynamics(nn.Module):
    """The next picture as a mixture of shifts of the newest one: each colour moves by so many cells
    with such a probability (convolutional dynamic neural advection, Finn, Goodfellow and Levine
    2016), may vanish, and may appear where the network has learned that it does. What decides is
    where the colours are in each frame of the stack, the mean place of each, and the action. A
    thing that moves keeps its shape: nothing blurs but what is uncertain. Meant for pictures in
    which every colour is a single thing.

    Attributes:
        channels: of the picture that is predicted.
        reach: the most rows and columns that a thing moves.
        hidden: widths of the perceptron that decides.
    """

    channels: int
    reach: tuple[int, int] = (8, 4)
    hidden: tuple[int, ...] = (128, 128)

    @nn.compact
    def __call__(
        self, stack: jax.Array, action: jax.Array, train: bool, valid: jax.Array | None = None
    ) -> tuple[jax.Array, ...]:
        """From pictures ``[N, H, W, C * frames]`` in [0, 1] and actions ``[N, actions]`` (one-hot)
        to the log odds of the next picture's pixels ``[N, H, W, channels]`` and the perceptron's
        last features ``[N, width]``.
        """
        del train, valid
        count, height, width, _ = stack.shape
        newest = stack[..., -self.channels :]
        x = jnp.concatenate([places(stack, self.channels), action], axis=-1)
        for features in self.hidden:
            x = nn.relu(nn.Dense(features)(x))
        rows, columns = (2 * cells + 1 for cells in self.reach)

        def head(size: int) -> jax.Array:
            return nn.Dense(self.channels * size)(x).reshape(count, self.channels, size)

        down, right = jax.nn.softmax(head(rows)), jax.nn.softmax(head(columns))
        moved = jnp.einsum(
            "ncih,nhwc,ncjw->nijc", shift_matrix(down, height), newest, shift_matrix(right, width)
        )
        stays, appears = jnp.moveaxis(jax.nn.sigmoid(head(2))[:, :, None, None], -1, 0)
        stays, appears = (jnp.moveaxis(share, 1, -1) for share in (stays, appears))
        where = self.param("where", nn.initializers.constant(-4.0), newest.shape[1:])
        lit = stays * moved + appears * jax.nn.sigmoid(where)
        lit = jnp.clip(lit, NEVER, 1 - NEVER)
        return jnp.log(lit) - jnp.log1p(-lit), x


def shift_matrix(share: jax.Array, size: int) -> jax.Array:
    """The matrix that moves a line of cells, a mixture of shifts. What comes in from outside is
    what there is at the edge.

    Args:
        share: of each shift from ``-reach`` to ``reach``, ``[..., 2 * reach + 1]``.
        size: cells in the line.

    Returns:
        ``[..., size (to), size (from)]``; every row sums to 1.
    """
    reach = share.shape[-1] // 2
    to, shift = jnp.arange(size)[:, None], jnp.arange(-reach, reach + 1)
    source = jax.nn.one_hot(jnp.clip(to - shift, 0, size - 1), size, dtype=share.dtype)
    return jnp.einsum("...s,tsf->...tf", share, source)


def places(stack: jax.Array, channels: int) -> jax.Array:
    """Where the colours are, for a perceptron.

    Args:
        stack: ``[N, H, W, C * frames]`` in [0, 1].
        channels: C.

    Returns:
        ``[N, features]``: of each colour in each frame the mean row and column over the picture's
        size and whether there is any of it, then in units of a few cells how far it moved from
        frame to frame, how far the colours are from one another in the newest frame, and how
        large they are.
    """
    count, height, width, depth = stack.shape
    frames = depth // channels
    x = stack.reshape(count, height, width, frames, channels)
    mass = x.sum((1, 2))
    seen = mass > 0.5
    rows = jnp.einsum("nhwfc,h->nfc", x, jnp.arange(height, dtype=x.dtype))
    columns = jnp.einsum("nhwfc,w->nfc", x, jnp.arange(width, dtype=x.dtype))
    place = jnp.stack([rows, columns], -1) / jnp.maximum(mass, 0.5)[..., None]
    moved = jnp.where((seen[:, 1:] & seen[:, :-1])[..., None], place[:, 1:] - place[:, :-1], 0)
    near = place[:, -1, :, None] - place[:, -1, None, :]
    both = seen[:, -1, :, None] & seen[:, -1, None, :]
    first, second = jnp.triu_indices(channels, 1)
    apart = jnp.where(both[..., None], near, 0)[:, first, second]
    size = jnp.array([height, width], x.dtype)
    parts = [
        jnp.where(seen[..., None], 2 * place / size - 1, 0),
        seen.astype(x.dtype),
        moved / 2,
        apart / 4,
        jnp.tanh(apart / 2),
        mass[:, -1] / 8,
    ]
    return jnp.concatenate([part.reshape(count, -1) for part in parts], axis=-1)
