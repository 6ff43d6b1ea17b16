"""Pictures as rectangles, a channel each, and how these move."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn

from jaxdyna.networks.contacts import Rectangles, change, each_alone, moves, pairs
from jaxdyna.types import Key

UNLIKELY = -30.0
"""Log odds of an edge further away than a thing can move."""


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
    """What is believed of the next picture's rectangles, leaves ``[N, C, ...]``.

    Attributes:
        rows: logarithms of how likely each row is the first and the last, ``[2, H]``.
        columns: likewise, ``[2, W]``.
        seen: log odds that there is any.
    """

    rows: jax.Array
    columns: jax.Array
    seen: jax.Array


class RectangleDynamics(nn.Module):
    """How likely each edge of each rectangle comes to lie in each row or column: the last edge's
    place and a move of so many cells, each with a probability of its own, or for a thing that was
    not there places learned for it. Categories do not blur: what is uncertain stays a choice.
    A perceptron decides, group of channels after group, from what `jaxdyna.networks.contacts` tells
    it: the things that are decided go where they have been put, the others on as they did, so that
    a thing that bounces off another one agrees with where that one is.

    Attributes:
        size: of the picture, ``(height, width)``.
        reach: the most rows and columns that a thing moves.
        groups: the channels that are decided together, one group after the other.
        hidden: widths of each group's perceptron.
        dropout: share of the features that a step of training does without.
    """

    size: tuple[int, int]
    reach: tuple[int, int]
    groups: tuple[tuple[int, ...], ...]
    hidden: tuple[int, ...] = (256, 256)
    dropout: float = 0.0

    @nn.compact
    def __call__(
        self,
        past: Rectangles,
        action: jax.Array,
        settle: Callable[[EdgeOdds, Sequence[int]], Rectangles],
        key: Key | None = None,
    ) -> tuple[EdgeOdds, Rectangles, jax.Array]:
        """What comes next.

        Args:
            past: the stack's, ``[N, frames, C]``, the newest last.
            action: one-hot ``[N, actions]``.
            settle: from what is believed of a group of channels ``[N, G]``, and which they are, to
                where they are taken to be: what is true or what is drawn.
            key: draws the features that are dropped; None drops none.

        Returns:
            What is believed ``[N, C]``, what has been settled ``[N, C]``, and log odds ``[N, 3]``
            of a reward of -1, 0 and 1.
        """
        now = Rectangles(past.edge[:, -1], past.seen[:, -1])
        alone, shift = each_alone(past, self.size, self.reach), moves(past)[:, -1]
        decided, news = [], action
        for number, group in enumerate(self.groups):
            known = jnp.concatenate([alone, pairs(now, shift, self.reach)], axis=-1)
            if key is not None and self.dropout > 0:
                key_group = jax.random.fold_in(key, number)
                kept = jax.random.bernoulli(key_group, 1 - self.dropout, known.shape)
                known = jnp.where(kept, known, 0) / (1 - self.dropout)
            x = self._perceptron(jnp.concatenate([known, news], axis=-1))
            at = jnp.array(group)
            before = Rectangles(now.edge[:, at], now.seen[:, at])
            odds = self._odds(x, before)
            then = settle(odds, group)
            told = change(before, then, self.reach)
            news = jnp.concatenate([news, told], axis=-1)
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
        return odds, then, nn.Dense(3)(jnp.concatenate([x, told], axis=-1))

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

        rows = places(now.edge[..., :2], self.reach[0], self.size[0])
        columns = places(now.edge[..., 2:], self.reach[1], self.size[1])
        return EdgeOdds(rows, columns, head()[...])
