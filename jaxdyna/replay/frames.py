"""A replay of stacked frames that keeps every frame once.

What `jaxdyna.replay.ring` would store of a transition, two stacks, holds each frame eight times
where a stack is four deep. Here a transition keeps only the newest frame of its ``obs``; its older
frames are found with the transitions before it, and the frame after its action with the one after.
What an episode lacks, the frames before its first and the one after its last, has a small store of
its own, so that a dream that branched off from the middle of a real episode is held as well. Of
the Maze's 16x16 RGB frames, in episodes of 200 steps, a transition takes 802 bytes; as two stacks
of four frames it would take more than 6,144. A vector is a frame as well, of one axis.
"""

from dataclasses import replace
from typing import Any

import chex
import jax
import jax.numpy as jnp
from flax import struct

from jaxdyna.fields import check_counts
from jaxdyna.replay.ring import check_type, draw
from jaxdyna.types import Key, Transition, check_transitions


@struct.dataclass
class FrameReplay:
    """The buffer. Transition ``i`` lies at ``i % capacity``, episode ``e`` at ``e % episodes``."""

    #: the newest frame of ``obs``, ``[capacity, H, W, C]``, in the frames' own type
    frame: jax.Array
    #: everything else of a transition: action, reward, terminated, truncated, mask and, where it
    #: has one, weight, ``[capacity]``
    rest: dict[str, jax.Array]
    time: jax.Array  #: int32 ``[capacity]``, steps since the episode began
    episode: jax.Array  #: int32 ``[capacity]``, its number
    #: the frames under each episode's first, ``[episodes, H, W, C * (num_frames - 1)]``
    older: jax.Array
    last_frame: jax.Array  #: the frame after each episode's last action, ``[episodes, H, W, C]``
    added: jax.Array  #: int32, transitions ever added
    episodes_added: jax.Array  #: int32, episodes ever added
    first: jax.Array  #: int32 ``[episodes]``, number of each episode's first transition
    #: what else is kept of each, such as the environment's state: leaves ``[capacity, ...]``
    beside: Any
    num_frames: int = struct.field(pytree_node=False)  #: frames in a stack; not an array

    @property
    def capacity(self) -> int:
        """The most transitions held."""
        return self.time.shape[0]

    @property
    def oldest(self) -> jax.Array:
        """Number of the oldest transition whose frames are all still there."""
        whole = jnp.where(self.added > self.capacity, self.added - self.capacity, 0)
        cut_off = jnp.where(whole > 0, whole + self.num_frames - 1, 0)
        episode = jnp.maximum(self.episodes_added - self.last_frame.shape[0], 0)
        return jnp.maximum(cut_off, self.first[episode % self.last_frame.shape[0]])

    @property
    def held(self) -> jax.Array:
        """Which positions hold a transition that can be drawn: bool ``[capacity]``."""
        number = self.number(jnp.arange(self.capacity))
        return (number >= self.oldest) & (number >= 0)

    @property
    def size(self) -> jax.Array:
        """How many transitions can be drawn."""
        return jnp.maximum(self.added - self.oldest, 0)

    def number(self, position: jax.Array) -> jax.Array:
        """Numbers of the transitions at these positions; negative where there is none."""
        newest = self.added - 1
        return newest - (newest - position) % self.capacity


def init(
    capacity: int, episodes: int, example: Transition, num_frames: int = 4, beside: Any = ()
) -> FrameReplay:
    """An empty buffer; `ValueError` where a count is not positive or the channels do not divide
    into frames.

    Args:
        capacity: the most transitions held.
        episodes: the most episodes whose last frame is held; transitions of older ones are no
            longer drawn.
        example: one transition: arrays, or anything with ``shape`` and ``dtype``; ``obs`` is
            ``[..., C * num_frames]``: of frames ``[H, W, C]``, or of vectors ``[C]``.
        num_frames: frames in a stack.
        beside: what else is kept of one transition, likewise.
    """
    check_counts(capacity=capacity, episodes=episodes, num_frames=num_frames)
    *lead, depth = example.obs.shape
    if capacity < num_frames:
        raise ValueError(f"capacity is {capacity}: give at least a stack's frames, {num_frames}")
    if depth % num_frames:
        raise ValueError(f"{depth} channels are not {num_frames} frames of equal depth")

    channels = depth // num_frames

    def frames(count: int, deep: int = 1) -> jax.Array:
        return jnp.zeros((count, *lead, channels * deep), example.obs.dtype)

    rest, more = jax.tree.map(
        lambda leaf: jnp.zeros((capacity, *leaf.shape), leaf.dtype), (_rest(example), beside)
    )
    numbers, none = jnp.zeros(capacity, jnp.int32), jnp.int32(0)
    return FrameReplay(
        frame=frames(capacity), rest=rest, time=numbers, episode=numbers,
        older=frames(episodes, num_frames - 1), last_frame=frames(episodes), added=none,
        episodes_added=none, first=jnp.zeros(episodes, jnp.int32), beside=more,
        num_frames=num_frames)  # fmt: skip


def add(replay: FrameReplay, episodes: Transition, beside: Any = ()) -> FrameReplay:
    """Adds whole episodes ``[N, T]``, as `jaxdyna.rollout` returns them, one after the other, and
    what else is kept of their steps, leaves ``[N, T, ...]``; the oldest transitions held make room.
    An episode lasts up to where its mask is true for the last time.

    Raises:
        AssertionError: where they are no such episodes.
        TypeError: where a leaf is of another type than what is held.
        ValueError: where more could come at once than the buffer holds.
    """
    check_transitions(episodes, 2)
    chex.assert_tree_shape_prefix(beside, episodes.mask.shape)
    count, steps = episodes.mask.shape
    if count * steps > replay.capacity or count > replay.last_frame.shape[0]:
        raise ValueError(
            f"{count} episodes of {steps} steps at once do not fit a replay of {replay.capacity} "
            f"transitions and {replay.last_frame.shape[0]} episodes"
        )
    channels = replay.frame.shape[-1]
    lengths = (episodes.valid * jnp.arange(1, steps + 1)).max(1)
    mask = (jnp.arange(steps) < lengths[:, None]).reshape(-1)
    number = replay.added + jnp.cumsum(mask) - 1
    slot = jnp.where(mask, number % replay.capacity, replay.capacity)  # out of bounds: dropped

    def write(held: jax.Array, new: jax.Array, at: jax.Array = slot) -> jax.Array:
        check_type(held, new)
        new = new.reshape(at.size, *held.shape[1:]).astype(held.dtype)
        return held.at[at].set(new, mode="drop")

    numbers = replay.episodes_added + jnp.arange(count)
    row = numbers % replay.last_frame.shape[0]
    last = jax.vmap(lambda frames, at: frames[at])(episodes.next_obs, jnp.maximum(lengths - 1, 0))
    return replace(
        replay,
        frame=write(replay.frame, episodes.obs[..., -channels:]),
        rest={name: write(replay.rest[name], leaf) for name, leaf in _rest(episodes).items()},
        time=write(replay.time, jnp.broadcast_to(jnp.arange(steps), (count, steps))),
        episode=write(replay.episode, jnp.broadcast_to(numbers[:, None], (count, steps))),
        older=write(replay.older, episodes.obs[:, 0, ..., :-channels], row),
        last_frame=write(replay.last_frame, last[..., -channels:], row),
        added=replay.added + mask.sum(dtype=jnp.int32),
        episodes_added=replay.episodes_added + count,
        first=write(replay.first, replay.added + jnp.cumsum(lengths) - lengths, row),
        beside=jax.tree.map(write, replay.beside, beside),
    )


def sample(
    replay: FrameReplay, key: Key, shape: tuple[int, ...], weight: jax.Array | None = None
) -> Transition:
    """Draws transitions ``[*shape, ...]`` with replacement as `jaxdyna.replay.ring.sample` does and
    rebuilds their stacks: each is as it was added. An empty buffer yields zeros, ``mask`` False.
    """
    return take(replay, draw_numbers(replay, key, shape, weight))


def draw_numbers(
    replay: FrameReplay, key: Key, shape: tuple[int, ...], weight: jax.Array | None = None
) -> jax.Array:
    """The numbers of the transitions of `sample`, int32 ``[*shape]``."""
    if weight is None:
        return replay.oldest + jax.random.randint(key, shape, 0, jnp.maximum(replay.size, 1))
    return replay.number(draw(weight, key, shape))


def take(replay: FrameReplay, number: jax.Array) -> Transition:
    """The transitions of these numbers, counted from the first ever added, int ``[...]``; they must
    be held (`FrameReplay.oldest` up to ``added``).
    """
    slot = number % replay.capacity
    row = replay.episode[slot] % replay.last_frame.shape[0]
    frames = _frames_of(replay, number, slot, row)
    next_slot = (number + 1) % replay.capacity
    following = replay.frame[next_slot]
    ended = (number + 1 == replay.added) | (replay.episode[next_slot] != replay.episode[slot])
    rank = replay.frame.ndim - 1
    after = jnp.where(_over(ended, rank), replay.last_frame[row], following)
    # One stack of all frames, cut twice: two stacks are laid out byte by byte, six times slower.
    after_all = jnp.expand_dims(after, -1 - rank)
    stacked = _stack(jnp.concatenate([frames, after_all], axis=-1 - rank), rank)
    channels = after.shape[-1]
    rest = {name: leaf[slot] for name, leaf in replay.rest.items()}
    rest["mask"] = rest["mask"] & (replay.size > 0)
    return Transition(obs=stacked[..., :-channels], next_obs=stacked[..., channels:], **rest)


def take_beside(replay: FrameReplay, number: jax.Array) -> Any:
    """What else is kept of the transitions of these numbers, leaves ``[..., ...]``."""
    return jax.tree.map(lambda leaf: leaf[number % replay.capacity], replay.beside)


def _frames_of(
    replay: FrameReplay, number: jax.Array, slot: jax.Array, row: jax.Array
) -> jax.Array:
    """The frames of these transitions' ``obs``, ``[..., num_frames, H, W, C]``."""
    deepest = replay.num_frames - 1
    ages = jnp.arange(deepest, -1, -1)
    frames = replay.frame[(number[..., None] - ages) % replay.capacity]
    if deepest == 0:
        return frames
    older = replay.older[row]
    older = older.reshape(*older.shape[:-1], deepest, replay.frame.shape[-1])
    # At time t a stack's frame j is number t + j of the episode's, its first stack included.
    place = replay.time[slot][..., None] + jnp.arange(deepest + 1)
    rank = replay.frame.ndim - 1
    early = jnp.take_along_axis(
        jnp.moveaxis(older, -2, -1 - rank),
        _over(jnp.minimum(place, deepest - 1), rank),
        axis=-1 - rank,
    )
    return jnp.where(_over(place < deepest, rank), early, frames)


def _over(x: jax.Array, rank: int) -> jax.Array:
    """With an axis more for each of a frame's."""
    return x.reshape(*x.shape, *(1,) * rank)


def _stack(frames: jax.Array, rank: int) -> jax.Array:
    """``[..., frames, *frame, C]`` to ``[..., *frame, frames * C]``."""
    moved = jnp.moveaxis(frames, -1 - rank, -2)
    return moved.reshape(*moved.shape[:-2], moved.shape[-2] * moved.shape[-1])


def _rest(transitions: Transition) -> dict[str, Any]:
    rest = transitions._asdict()
    return {name: leaf for name, leaf in rest.items() if leaf is not None and "obs" not in name}
