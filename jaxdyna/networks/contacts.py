"""What a perceptron is told of rectangles that move: each alone, and how two of them meet.

What happens often hangs on a single cell, which a perceptron sees late in a scaled number and at
once in a tile of its own. Nothing but the scaled places says where in the picture something
happens: walls and other things are told by how far they are, so that what was seen at one place
is known at every other (relational inductive biases, Battaglia et al. 2018).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn

MOMENTS = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Parts of a step at which things that move evenly are compared."""
LONGEST = 5
"""Cells of a thing's length that are told apart."""
BESIDE = 8
"""Cells by which things that touch are told to lie beside each other."""
FAST = 4
"""Cells a step that their moves are told by."""


class Rectangles(NamedTuple):
    """Of each channel the rectangle around all that is lit, leaves ``[..., C, ...]``.

    Attributes:
        edge: first and last row, first and last column, int32 ``[..., 4]``; 0 where nothing is lit.
        seen: whether anything is, bool.
    """

    edge: jax.Array
    seen: jax.Array


def moves(past: Rectangles) -> jax.Array:
    """How far each edge has gone between the pictures of a stack ``[N, frames, C]``: ``[N, frames -
    1, C, 4]``, 0 where a thing was not there at both ends.
    """
    edge = past.edge.astype(jnp.float32)
    both = past.seen[:, 1:] & past.seen[:, :-1]
    return jnp.where(both[..., None], edge[:, 1:] - edge[:, :-1], 0)


def each_alone(past: Rectangles, size: tuple[int, int], reach: tuple[int, int]) -> jax.Array:
    """Of the things of a stack ``[N, frames, C]``: places over the picture's ``size`` and moves, in
    numbers; then, cell by cell up to ``reach``, how far the newest edges are from the picture's
    borders, and will be if they go on as they did, lengths and moves. ``[N, features]``.
    """
    edge, seen = past.edge.astype(jnp.float32), past.seen
    there, both = seen[:, -1, :, None], seen[:, 1:] & seen[:, :-1]
    moved, lengths = moves(past), jnp.array([size[0]] * 2 + [size[1]] * 2, jnp.float32)
    parts = [jnp.where(seen[..., None], 2 * edge / lengths - 1, 0), seen, moved / 4]
    for axis, (cells, far) in enumerate(zip(size, reach, strict=True)):
        first, last = edge[:, -1, :, 2 * axis], edge[:, -1, :, 2 * axis + 1]
        ahead = moved[:, -1, :, 2 * axis]
        for room, change in ((first, ahead), (cells - 1 - last, -ahead)):
            parts.append(there * near(room, 0, far))
            parts.append(there * near(room + change, -4, 2))
        parts.append(there * near(last - first, 0, LONGEST))
        moves_here = moved[..., 2 * axis : 2 * axis + 2]
        parts.append(both[..., None, None] * near(moves_here, -far, far))
    return _flat(parts)


def pairs(now: Rectangles, shift: jax.Array, reach: tuple[int, int]) -> jax.Array:
    """Of each two things ``[N, C]`` that move evenly by ``shift`` ``[N, C, 4]`` within the step:
    how far they are apart at its beginning and end, whether they touch at any of `MOMENTS`, and
    where they first do, how they lie beside each other and move. ``[N, features]``.
    """
    edge = now.edge.astype(jnp.float32)
    one, other = jnp.triu_indices(now.seen.shape[-1], 1)
    together = now.seen[:, one] & now.seen[:, other]
    parts, touches, gaps = [], [], []
    for moment in MOMENTS:
        at = edge + moment * shift
        first, last = at[..., ::2], at[..., 1::2]
        overlap = jnp.minimum(last[:, one], last[:, other])
        overlap = overlap - jnp.maximum(first[:, one], first[:, other])
        touches.append(jnp.clip(1 + overlap, 0, 1).prod(-1) * together)
        gaps.append(at[:, other] - at[:, one])
        if moment in (MOMENTS[0], MOMENTS[-1]):
            apart = first[:, other] - first[:, one]
            parts += [
                together[..., None] * near(apart[..., axis], -far, far)
                for axis, far in enumerate(reach)
            ]
    touch = jnp.stack(touches, axis=-1)
    any_touch, when = touch.max(-1, keepdims=True), jnp.argmax(touch > 0, axis=-1)
    beside = jnp.take_along_axis(jnp.stack(gaps, -1), when[..., None, None], -1)[..., 0]
    beside = jnp.clip(beside, -BESIDE, BESIDE)
    parts += [touch, any_touch, any_touch * beside / 4]
    there = any_touch[..., None]
    parts.append(there * near(beside, -BESIDE, BESIDE))
    parts += [there * near(shift[:, which, ::2], -FAST, FAST) for which in (one, other)]
    return _flat(parts)


def change(now: Rectangles, then: Rectangles, reach: tuple[int, int]) -> jax.Array:
    """What became of things ``[N, G]``, for a perceptron ``[N, features]``."""
    moved = moves(Rectangles(*(jnp.stack(both, 1) for both in zip(now, then, strict=True))))[:, 0]
    parts = [then.seen, moved / 4]
    both = (now.seen & then.seen)[..., None, None]
    for axis, far in enumerate(reach):
        parts.append(both * near(moved[..., 2 * axis : 2 * axis + 2], -far, far))
    return _flat(parts)


def near(x: jax.Array, first: int, last: int) -> jax.Array:
    """`tiles` of what lies between ``first`` and ``last``; of anything beyond, nothing."""
    return tiles(jnp.clip(x, first - 1, last + 1), first, last)


def tiles(x: jax.Array, first: int, last: int) -> jax.Array:
    """``[..., last - first + 1]``: 1 at the whole number that ``x`` is, or shared by its
    neighbours.
    """
    return nn.relu(1 - jnp.abs(x[..., None] - jnp.arange(first, last + 1, dtype=x.dtype)))


def _flat(parts: list[jax.Array]) -> jax.Array:
    return jnp.concatenate([part.reshape(len(part), -1) for part in parts], axis=-1)
