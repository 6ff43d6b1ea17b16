"""A ring buffer over any pytree: the newest ``capacity`` items."""

import chex
import jax
import jax.numpy as jnp
from flax import struct

from jaxdyna.fields import check_counts
from jaxdyna.types import Key, PyTree

ROW = 256


@struct.dataclass
class Replay:
    """The buffer."""

    data: PyTree  #: every leaf ``[capacity, ...]``
    #: int32, how many items were added; item ``i`` lies at ``i % capacity``. Once it is full, a
    #: multiple of the capacity is left out.
    added: jax.Array

    @property
    def capacity(self) -> int:
        """The most items held."""
        return jax.tree.leaves(self.data)[0].shape[0]

    @property
    def size(self) -> jax.Array:
        """How many items it holds now."""
        return jnp.minimum(self.added, self.capacity)

    @property
    def held(self) -> jax.Array:
        """Which positions hold an item: bool ``[capacity]``."""
        return jnp.arange(self.capacity) < self.size


def init(capacity: int, example: PyTree) -> Replay:
    """An empty buffer for items like the example: arrays, or anything with ``shape`` and ``dtype``.
    `ValueError` where ``capacity`` is not positive.
    """
    check_counts(capacity=capacity)
    data = jax.tree.map(lambda leaf: jnp.zeros((capacity, *leaf.shape), leaf.dtype), example)
    return Replay(data=data, added=jnp.int32(0))


def add(replay: Replay, items: PyTree, mask: jax.Array) -> Replay:
    """Adds the items where ``mask`` is true, oldest first; the oldest held make room.

    Args:
        replay: the buffer.
        items: every leaf ``[*mask.shape, ...]``.
        mask: bool, any shape.

    Raises:
        AssertionError: where items and mask differ in these axes, or the mask is not bool.
        TypeError: where a leaf is of another type than what is held.
        ValueError: where more items than ``capacity`` could come at once.
    """
    chex.assert_type(mask, bool)
    chex.assert_tree_shape_prefix(items, mask.shape)
    if mask.size > replay.capacity:
        raise ValueError(
            f"{mask.size} items at once do not fit a replay of {replay.capacity}: "
            "give it at least the capacity of one batch"
        )
    mask = mask.reshape(-1)
    position = (replay.added + jnp.cumsum(mask) - 1) % replay.capacity
    position = jnp.where(mask, position, replay.capacity)  # out of bounds: dropped

    def write(held, new):
        check_type(held, new)
        new = new.reshape(-1, *held.shape[1:]).astype(held.dtype)
        return held.at[position].set(new, mode="drop")

    data = jax.tree.map(write, replay.data, items)
    added = replay.added + mask.sum(dtype=jnp.int32)
    whole = 2 * replay.capacity  # places and size stay as they are, and the count within int32
    return Replay(data, jnp.where(added > whole, whole + added % replay.capacity, added))


def check_type(held: jax.Array, new: jax.Array) -> None:
    """Refuses by a `TypeError` to store floats as whole numbers: frames in [0, 1] would become
    zeros; and items ``new [..., *item]`` of another shape.
    """
    item = held.shape[1:]
    if new.shape[new.ndim - len(item) :] != item:
        said = f"the replay holds arrays {list(item)} and is given {list(new.shape)}"
        raise TypeError(f"{said}: let the last axes be as its example's")
    if not jnp.can_cast(new.dtype, held.dtype, "same_kind"):
        raise TypeError(
            f"the replay holds {held.dtype} and is given {new.dtype}: let the environment return "
            f"{held.dtype} (frames as bytes from 0 to 255), or make the replay of an example of "
            f"{new.dtype}"
        )


def sample(
    replay: Replay, key: Key, shape: tuple[int, ...], weight: jax.Array | None = None
) -> PyTree:
    """Draws items with replacement: every leaf ``[*shape, ...]``.

    Args:
        replay: a buffer; an empty one yields its zeros where it is traced, so check ``size`` or
            mask what comes, and else a `ValueError`.
        key: random key.
        shape: how many, as leading axes.
        weight: ``[capacity]``, what each item's probability is in proportion to, as `share_weight`
            makes it; uniform without.
    """
    if not isinstance(replay.added, jax.core.Tracer) and not replay.added:
        raise ValueError("the replay is empty: add to it before it is sampled")
    return take(replay, draw_positions(replay, key, shape, weight))


def draw_positions(
    replay: Replay, key: Key, shape: tuple[int, ...], weight: jax.Array | None = None
) -> jax.Array:
    """Where the items of `sample` lie, int32 ``[*shape]``."""
    if weight is not None and weight.shape != (replay.capacity,):
        raise ValueError(f"weight is {list(weight.shape)}: give one an item, [{replay.capacity}]")
    if weight is None:
        return jax.random.randint(key, shape, 0, jnp.maximum(replay.size, 1))
    return draw(weight, key, shape)


def take(replay: Replay, position: jax.Array) -> PyTree:
    """The items at these positions ``[...]``, every leaf ``[..., ...]``."""
    return jax.tree.map(lambda leaf: leaf[position], replay.data)


def sample_distinct(replay: Replay, key: Key, count: int) -> PyTree:
    """Draws ``count`` items, none twice; those that it holds less than that come as zeros."""
    ticket = jnp.where(replay.held, jax.random.uniform(key, (replay.capacity,)), -1)
    best, rows = jax.lax.top_k(ticket, count)

    def drawn(leaf):
        return jax.vmap(jnp.where)(best >= 0, leaf[rows], jnp.zeros_like(leaf[rows]))

    return jax.tree.map(drawn, replay.data)


def share_weight(
    held: jax.Array, marked: jax.Array, share: jax.Array | float | None
) -> jax.Array | None:
    """Weights ``[capacity]`` for `sample`, 0 for what is not held, that give each kind of the
    marked items at least an equal part of ``share`` of the draws: rare ones are seen often enough
    to be learned, ones that have become common as often as they come.

    Args:
        held: bool ``[capacity]``, such as `Replay.held`.
        marked: bool ``[capacity]``, or ``[kinds, capacity]``, no item of two kinds.
        share: between 0 and 1; None: no weights, since all are drawn alike.
    """
    if share is None:
        return None
    kinds = held & jnp.atleast_2d(marked)
    other = held & ~kinds.any(0)
    counts, rest = kinds.sum(-1), other.sum()
    part = jnp.where(counts > 0, share / jnp.maximum((counts > 0).sum(), 1), 0.0)
    shares = jnp.maximum(counts / jnp.maximum(held.sum(), 1), part)
    left = jnp.maximum(1 - shares.sum(), 0.0)
    each = shares / jnp.maximum(counts, 1)
    return (kinds * each[:, None]).sum(0) + other * left / jnp.maximum(rest, 1)


def draw(weight: jax.Array, key: Key, shape: tuple[int, ...]) -> jax.Array:
    """Positions ``[*shape]`` drawn with probabilities in proportion to ``weight [capacity]``: first
    a row of them, then one in it, which saves running sums over all. In a row so unlikely that it
    has fewer of the 2^23 heights than items, the random number's other bits decide between these.
    """
    rows = _rows(weight)
    sums = rows.sum(1)
    ends = jnp.cumsum(sums)
    bits = jax.random.bits(key, shape, jnp.uint32).reshape(-1)
    height = (bits >> 9) * jnp.float32(2**-23) * ends[-1]  # as jax.random.uniform
    finer = (bits & 511) * jnp.float32(2**-32) * ends[-1]
    row = jnp.minimum(jnp.searchsorted(ends, height, side="right"), _last(sums > 0))
    within = jnp.maximum(height - (ends - sums)[row], 0.0)  # rounding
    chosen = rows[row]
    coarse = sums[row] < (chosen > 0).sum(-1) * jnp.float32(2**-23) * ends[-1]
    within = jnp.where(coarse, within + finer, within)
    column = (jnp.cumsum(chosen, -1) <= within[:, None]).sum(-1)
    column = jnp.minimum(column, _last(chosen > 0))
    return jnp.minimum(row * rows.shape[1] + column, weight.size - 1).reshape(shape)


def _rows(weight: jax.Array) -> jax.Array:
    """Rows of the weights; of a length, where there is one, that needs no padded copy of them."""
    length = next((n for n in range(ROW, ROW // 2, -1) if weight.size % n == 0), ROW)
    return jnp.pad(weight, (0, -weight.size % length)).reshape(-1, length)


def _last(flags: jax.Array) -> jax.Array:
    """The last position along the last axis that is true, the very last where none is."""
    return flags.shape[-1] - 1 - jnp.argmax(flags[..., ::-1], axis=-1)
