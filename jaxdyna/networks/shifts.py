"""Frames in which things move as wholes."""

from __future__ import annotations

from typing import NamedTuple

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
    which every colour is a single rectangle, which its rows and its columns say.

    Attributes:
        channels: of the picture that is predicted.
        reach: the most rows and columns that a thing moves.
        hidden: widths of the perceptron that decides.
        sharp: once trained, every thing moves by its likeliest shift instead of the mixture, so
            that what is uncertain about its way neither blurs nor dissolves it: a dream goes on
            with one of the possible futures.
    """

    channels: int
    reach: tuple[int, int] = (8, 4)
    hidden: tuple[int, ...] = (128, 128)
    sharp: bool = False

    @nn.compact
    def __call__(
        self, stack: jax.Array, action: jax.Array, train: bool, valid: jax.Array | None = None
    ) -> tuple[jax.Array, ...]:
        """From pictures ``[N, H, W, C * frames]`` in [0, 1] and actions ``[N, actions]`` (one-hot)
        to the log odds of the next picture's pixels ``[N, H, W, channels]`` and the perceptron's
        last features ``[N, width]``.
        """
        del valid
        count, height, width, _ = stack.shape
        newest = stack[..., -self.channels :]
        where = whereabouts(stack, self.channels)
        x = jnp.concatenate([places(where), tiles(where, self.reach), action], axis=-1)
        for features in self.hidden:
            x = nn.relu(nn.Dense(features)(x))
        num_down, num_right = (2 * cells + 1 for cells in self.reach)

        def head(size: int) -> jax.Array:
            return nn.Dense(self.channels * size)(x).reshape(count, self.channels, size)

        def shares(size: int) -> jax.Array:
            odds = head(size)
            if self.sharp and not train:
                return jax.nn.one_hot(odds.argmax(-1), size, dtype=odds.dtype)
            return jax.nn.softmax(odds)

        down, right = shares(num_down), shares(num_right)
        rows = jnp.einsum("ncih,nhc->nic", shift_matrix(down, height), newest.max(2))
        columns = jnp.einsum("ncjw,nwc->njc", shift_matrix(right, width), newest.max(1))
        moved = rows[:, :, None] * columns[:, None]
        stays, appears = jnp.moveaxis(jax.nn.sigmoid(head(2))[:, :, None, None], -1, 0)
        stays, appears = (jnp.moveaxis(share, 1, -1) for share in (stays, appears))
        origin = self.param("where", nn.initializers.constant(-4.0), newest.shape[1:])
        lit = stays * moved + appears * jax.nn.sigmoid(origin)
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


class Whereabouts(NamedTuple):
    """Where the colours of a stack of pictures are, in cells; 0 where there is none of a colour.

    Attributes:
        place: mean row and column, ``[N, frames, C, 2]``.
        seen: whether there is any, bool ``[N, frames, C]``.
        moved: from frame to frame, ``[N, frames - 1, C, 2]``.
        apart: from colour to colour in the newest frame, ``[N, pairs, 2]``.
        mass: how much there is in the newest frame, ``[N, C]``.
        size: ``(height, width)`` of the picture.
    """

    place: jax.Array
    seen: jax.Array
    moved: jax.Array
    apart: jax.Array
    mass: jax.Array
    size: tuple[int, int]


def whereabouts(stack: jax.Array, channels: int) -> Whereabouts:
    """Of pictures ``[N, H, W, C * frames]`` in [0, 1] with C ``channels``."""
    count, height, width, depth = stack.shape
    frames = depth // channels
    x = stack.reshape(count, height, width, frames, channels)
    by_row, by_column = x.sum(2), x.sum(1)
    mass = by_row.sum(1)
    seen = mass > 0.5
    rows = jnp.einsum("nhfc,h->nfc", by_row, jnp.arange(height, dtype=x.dtype))
    columns = jnp.einsum("nwfc,w->nfc", by_column, jnp.arange(width, dtype=x.dtype))
    place = jnp.stack([rows, columns], -1) / jnp.maximum(mass, 0.5)[..., None]
    moved = jnp.where((seen[:, 1:] & seen[:, :-1])[..., None], place[:, 1:] - place[:, :-1], 0)
    near = place[:, -1, :, None] - place[:, -1, None, :]
    both = seen[:, -1, :, None] & seen[:, -1, None, :]
    first, second = jnp.triu_indices(channels, 1)
    apart = jnp.where(both[..., None], near, 0)[:, first, second]
    return Whereabouts(place, seen, moved, apart, mass[:, -1], (height, width))


def places(where: Whereabouts) -> jax.Array:
    """`Whereabouts` for a perceptron, ``[N, features]``: of each colour in each frame its place
    over the picture's size and whether there is any of it, then in units of a few cells how far it
    moved from frame to frame, how far the colours are from one another, and how large they are.
    """
    size = jnp.array(where.size, where.place.dtype)
    parts = [
        jnp.where(where.seen[..., None], 2 * where.place / size - 1, 0),
        where.seen.astype(where.place.dtype),
        where.moved / 2,
        where.apart / 4,
        jnp.tanh(where.apart / 2),
        where.mass / 8,
    ]
    return jnp.concatenate([part.reshape(len(part), -1) for part in parts], axis=-1)


def tiles(where: Whereabouts, reach: tuple[int, int]) -> jax.Array:
    """The same cell by cell, ``[N, features]``: a hat function over each whole number that a place
    in the newest frame, a move within ``reach`` or a distance within twice that can be. What
    happens to a thing often hangs on a single cell, which a perceptron sees late in a scaled
    number, and at once here.
    """
    parts = []
    for axis, (size, cells) in enumerate(zip(where.size, reach, strict=True)):
        there = where.seen[:, -1, :, None]
        parts += [
            there * _hats(where.place[:, -1, :, axis], 0, size - 1),
            _hats(where.moved[..., axis], -cells, cells),
            _hats(where.apart[..., axis], -2 * cells, 2 * cells),
        ]
    return jnp.concatenate([part.reshape(len(part), -1) for part in parts], axis=-1)


def _hats(x: jax.Array, first: int, last: int) -> jax.Array:
    """``[..., last - first + 1]``: 1 at the whole number that ``x`` is, or shared by its
    neighbours.
    """
    return nn.relu(1 - jnp.abs(x[..., None] - jnp.arange(first, last + 1, dtype=x.dtype)))
