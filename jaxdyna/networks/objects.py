"""What a perceptron is told of rectangles that move: each alone, and how two of them meet.

What happens often hangs on a single cell, which a perceptron sees late in a scaled number and at
once in a tile of its own. Nothing but the scaled places says where in the picture something
happens: walls and other things are told by how far they are, so that what was seen at one place
is known at every other (relational inductive biases, Battaglia et al. 2018).
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn

from jaxdyna.types import Key

MOMENTS = (0.0, 0.25, 0.5, 0.75, 1.0)  #: parts of a step at which even moves are compared


class Resolution(NamedTuple):
    """How finely places and moves are told, in cells."""

    #: the most rows and columns that a thing moves in a step; further it never goes
    reach: tuple[int, int] = (4, 4)
    longest: int = 5  #: of a thing's length that are told apart
    beside: int = 8  #: by which things that touch are told to lie beside each other
    fast: int = 4  #: a step, by which the moves of things that touch are told
    unit: float = 4.0  #: that are 1 where moves are told as numbers


class Rectangles(NamedTuple):
    """Of each channel the rectangle around all that is lit, leaves ``[..., C, ...]``."""

    #: first and last row, first and last column, int32 ``[..., 4]``; 0 where nothing is lit
    edge: jax.Array
    seen: jax.Array  #: whether anything is, bool


def moves(past: Rectangles) -> jax.Array:
    """How far each edge has gone between the pictures of a stack ``[N, frames, C]``: ``[N, frames -
    1, C, 4]``, 0 where a thing was not there at both ends.
    """
    edge = past.edge.astype(jnp.float32)
    both = past.seen[:, 1:] & past.seen[:, :-1]
    return jnp.where(both[..., None], edge[:, 1:] - edge[:, :-1], 0)


def each_alone(past: Rectangles, size: tuple[int, int], told: Resolution) -> jax.Array:
    """Of the things of a stack ``[N, frames, C]``: places over the picture's ``size`` and moves, in
    numbers; then, cell by cell up to the reach, how far the newest edges are from the picture's
    borders, and will be if they go on as they did, lengths and moves. ``[N, features]``.
    """
    edge, seen = past.edge.astype(jnp.float32), past.seen
    there, both = seen[:, -1, :, None], seen[:, 1:] & seen[:, :-1]
    moved, lengths = moves(past), jnp.array([size[0]] * 2 + [size[1]] * 2, jnp.float32)
    parts = [jnp.where(seen[..., None], 2 * edge / lengths - 1, 0), seen, moved / told.unit]
    for axis, (cells, far) in enumerate(zip(size, told.reach, strict=True)):
        first, last = edge[:, -1, :, 2 * axis], edge[:, -1, :, 2 * axis + 1]
        ahead = moved[:, -1, :, 2 * axis]
        for room, change in ((first, ahead), (cells - 1 - last, -ahead)):
            parts.append(there * near(room, 0, far))
            parts.append(there * near(room + change, -told.fast, 2))
        parts.append(there * near(last - first, 0, told.longest))
        moves_here = moved[..., 2 * axis : 2 * axis + 2]
        parts.append(both[..., None, None] * near(moves_here, -far, far))
    return _flat(parts)


def pairs(now: Rectangles, shift: jax.Array, told: Resolution) -> jax.Array:
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
                for axis, far in enumerate(told.reach)
            ]
    touch = jnp.stack(touches, axis=-1)
    any_touch, when = touch.max(-1, keepdims=True), jnp.argmax(touch > 0, axis=-1)
    beside = jnp.take_along_axis(jnp.stack(gaps, -1), when[..., None, None], -1)[..., 0]
    beside = jnp.clip(beside, -told.beside, told.beside)
    parts += [touch, any_touch, any_touch * beside / told.unit]
    there = any_touch[..., None]
    parts.append(there * near(beside, -told.beside, told.beside))
    parts += [there * near(shift[:, which, ::2], -told.fast, told.fast) for which in (one, other)]
    return _flat(parts)


def change(now: Rectangles, then: Rectangles, told: Resolution) -> jax.Array:
    """What became of things ``[N, G]``, for a perceptron ``[N, features]``."""
    moved = moves(Rectangles(*(jnp.stack(both, 1) for both in zip(now, then, strict=True))))[:, 0]
    parts = [then.seen, moved / told.unit]
    both = (now.seen & then.seen)[..., None, None]
    for axis, far in enumerate(told.reach):
        parts.append(both * near(moved[..., 2 * axis : 2 * axis + 2], -far, far))
    return _flat(parts)


def near(x: jax.Array, first: int, last: int) -> jax.Array:
    """As `tiles`, of what lies between ``first`` and ``last``; of anything beyond, zeros."""
    return tiles(jnp.clip(x, first - 1, last + 1), first, last)


def tiles(x: jax.Array, first: int, last: int) -> jax.Array:
    """Whole numbers from ``first`` to ``last``, one by one, ``[..., last - first + 1]``: 1 at the
    one that ``x [...]`` is, or shared by its neighbours.
    """
    return nn.relu(1 - jnp.abs(x[..., None] - jnp.arange(first, last + 1, dtype=x.dtype)))


def _flat(parts: list[jax.Array]) -> jax.Array:
    return jnp.concatenate([part.reshape(len(part), -1) for part in parts], axis=-1)


UNLIKELY = -30.0  #: log odds of an edge further away than a thing can move


def rectangles_of(stack: jax.Array, channels: int) -> Rectangles:
    """Those of pictures ``[N, H, W, C * frames]``, uint8 and lit from 128 on: ``[N, frames, C]``.

    The mean place of a thing that is drawn on cells does not tell where in its cells it is; its two
    edges do, as far as the picture can.
    """
    count, height, width, depth = stack.shape
    lit = stack.reshape(count, height, width, depth // channels, channels) > 127

    def ends(line: jax.Array, size: int) -> list[jax.Array]:
        return [jnp.argmax(line, axis=1), size - 1 - jnp.argmax(line[:, ::-1], axis=1)]

    rows, columns = lit.any(2), lit.any(1)
    seen = rows.any(1)
    edge = jnp.stack([*ends(rows, height), *ends(columns, width)], axis=-1)
    return Rectangles(jnp.where(seen[..., None], edge, 0).astype(jnp.int32), seen)


def drawn(there: Rectangles, size: tuple[int, int]) -> jax.Array:
    """The picture of `Rectangles` ``[..., C]``, bool ``[..., H, W, C]``."""

    def within(first: jax.Array, last: jax.Array, length: int) -> jax.Array:
        cells = jnp.arange(length)[:, None]
        return (first[..., None, :] <= cells) & (cells <= last[..., None, :])

    top, bottom, left, right = jnp.moveaxis(there.edge, -1, 0)
    rows = within(top, bottom, size[0]) & there.seen[..., None, :]
    return rows[..., :, None, :] & within(left, right, size[1])[..., None, :, :]


class EdgeOdds(NamedTuple):
    """What is believed of the next picture's rectangles, leaves ``[N, C, ...]``."""

    rows: jax.Array  #: logarithms of how likely each row is the first and the last, ``[2, H]``
    columns: jax.Array  #: likewise, ``[2, W]``
    seen: jax.Array  #: log odds that there is any


class RectangleDynamics(nn.Module):
    """How likely each edge of each rectangle comes to lie in each row or column: the last edge's
    place and a move of so many cells, each with a probability of its own, or for a thing that was
    not there places learned for it. Categories do not blur: what is uncertain stays a choice.
    A perceptron decides, group of channels after group, from what `jaxdyna.networks.objects` tells
    it: the things that are decided go where they have been put, the others on as they did, so that
    a thing that bounces off another one agrees with where that one is.
    """

    size: tuple[int, int]  #: of the picture, ``(height, width)``
    told: Resolution  #: how finely
    #: the channels that are decided together, one group after the other
    groups: tuple[tuple[int, ...], ...]
    hidden: tuple[int, ...] = (256, 256)  #: widths of each group's perceptron
    dropout: float = 0.0  #: share of the features that a step of training does without
    rewards: int = 3  #: kinds of rewards that are told apart

    @nn.compact
    def __call__(
        self, past: Rectangles, action: jax.Array,
        settle: Callable[[EdgeOdds, Sequence[int]], Rectangles], key: Key | None = None,
    ) -> tuple[EdgeOdds, Rectangles, jax.Array]:  # fmt: skip
        """What comes next.

        Args:
            past: the stack's, ``[N, frames, C]``, the newest last.
            action: one-hot ``[N, actions]``.
            settle: from what is believed of a group of channels ``[N, G]``, and which they are, to
                where they are taken to be: what is true or what is drawn.
            key: draws the features that are dropped; None drops none.

        Returns:
            What is believed ``[N, C]``, what has been settled ``[N, C]``, and log odds ``[N,
            rewards]`` of each kind of reward.
        """
        now = Rectangles(past.edge[:, -1], past.seen[:, -1])
        alone, shift = each_alone(past, self.size, self.told), moves(past)[:, -1]
        decided, news = [], action
        for number, group in enumerate(self.groups):
            known = jnp.concatenate([alone, pairs(now, shift, self.told)], axis=-1)
            if key is not None and self.dropout > 0:
                key_group = jax.random.fold_in(key, number)
                kept = jax.random.bernoulli(key_group, 1 - self.dropout, known.shape)
                known = jnp.where(kept, known, 0) / (1 - self.dropout)
            x = self._perceptron(jnp.concatenate([known, news], axis=-1))
            at = jnp.array(group)
            before = Rectangles(now.edge[:, at], now.seen[:, at])
            odds = self._odds(x, before)
            then = settle(odds, group)
            became = change(before, then, self.told)
            news = jnp.concatenate([news, became], axis=-1)
            there = (before.seen & then.seen)[..., None]
            went = jnp.where(there, then.edge - before.edge, 0).astype(jnp.float32)
            shift = shift.at[:, at].set(went)
            decided.append((odds, then))
        order = [channel for group in self.groups for channel in group]
        back = jnp.argsort(jnp.array(order))
        odds, then = (
            jax.tree.map(lambda *leaves: jnp.concatenate(leaves, axis=1)[:, back], *part)
            for part in zip(*decided, strict=True)
        )
        return odds, then, nn.Dense(self.rewards)(jnp.concatenate([x, became], axis=-1))

    def _perceptron(self, x: jax.Array) -> jax.Array:
        for width in self.hidden:
            x = nn.relu(nn.Dense(width)(x))
        return x

    def _odds(self, x: jax.Array, now: Rectangles) -> EdgeOdds:
        """From the perceptron's features ``[N, width]`` and where things ``[N, G]`` are."""
        count, things = now.seen.shape

        def head(*shape: int) -> jax.Array:
            size = things
            for length in shape:
                size *= length
            return nn.Dense(size)(x).reshape(count, things, *shape)

        def places(edge: jax.Array, reach: int, size: int) -> jax.Array:
            moves, appears = head(2, 2 * reach + 1), head(2, size)
            move = jnp.arange(size) - edge[..., None]
            near = jnp.take_along_axis(moves, jnp.clip(move + reach, 0, 2 * reach), axis=-1)
            near = jnp.where(jnp.abs(move) <= reach, near, UNLIKELY)
            return jax.nn.log_softmax(jnp.where(now.seen[..., None, None], near, appears))

        rows = places(now.edge[..., :2], self.told.reach[0], self.size[0])
        columns = places(now.edge[..., 2:], self.told.reach[1], self.size[1])
        return EdgeOdds(rows, columns, head()[...])
