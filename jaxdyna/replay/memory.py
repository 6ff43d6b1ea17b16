"""The replays as `jaxdyna.dyna` is given them, see `jaxdyna.types.Memory`."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp

from jaxdyna.fields import check_counts
from jaxdyna.replay import frames as frame_replay, ring
from jaxdyna.replay.frames import FrameReplay
from jaxdyna.replay.ring import Replay, share_weight
from jaxdyna.types import Key, Memory, Transition


def transitions() -> Memory:
    """`jaxdyna.replay.ring`; rare are transitions that ended an episode."""

    def start(capacity: int, episodes: int, example: Transition, recorded: Any) -> Replay:
        return ring.init(capacity, example)

    def draw_some(
        held: Replay, key: Key, shape: tuple[int, ...], rare_share: float | None
    ) -> jax.Array:
        weight = share_weight(held.held, held.data.terminated, rare_share)
        return ring.draw_positions(held, key, shape, weight)

    def forget(held: Replay, when: jax.Array) -> Replay:
        return replace(held, added=jnp.where(when, 0, held.added))

    def put(held: Replay, new: Transition, recorded: Any, number: jax.Array) -> Replay:
        return ring.add(held, new, new.mask)

    return Memory(start, put, draw_some, ring.take, forget)


def frames(
    rare: Callable[[dict[str, jax.Array]], jax.Array],
    num_frames: int = 4,
    shared: Callable[[Any], FrameReplay] | None = None,
    keep: Callable[[Any], Any] = lambda recorded: (),
) -> Memory:
    """`jaxdyna.replay.frames`; ``rare`` says of `FrameReplay.rest` which transitions are rare, bool
    ``[capacity]``, ``keep`` what of that which was recorded is kept beside the transitions, and for
    ``shared`` see `jaxdyna.types.Memory`.
    """

    def start(capacity: int, episodes: int, example: Transition, recorded: Any) -> FrameReplay:
        beside = jax.eval_shape(keep, recorded)
        return frame_replay.init(capacity, episodes, example, num_frames, beside)

    def put(held: FrameReplay, new: Transition, recorded: Any, number: Any) -> FrameReplay:
        return frame_replay.add(held, new, keep(recorded))

    def draw_some(
        held: FrameReplay, key: Key, shape: tuple[int, ...], rare_share: float | None
    ) -> jax.Array:
        weight = share_weight(held.held, rare(held.rest), rare_share)
        return frame_replay.draw_numbers(held, key, shape, weight)

    def forget(held: FrameReplay, when: jax.Array) -> FrameReplay:
        counts = (held.added, held.episodes_added, held.first)
        added, episodes, first = (jnp.where(when, 0, count) for count in counts)
        return replace(held, added=added, episodes_added=episodes, first=first)

    def take(held: FrameReplay, numbers: jax.Array) -> Transition:
        return frame_replay.take(held, numbers)._replace(weight=None)  # that is the agent's

    return Memory(start, put, draw_some, take, forget, shared)


def forgetting(memory: Memory, every: int) -> Memory:
    """A memory that is emptied every so many real episodes, as that of the paper's authors."""
    check_counts(every=every)

    def add(held: Any, new: Transition, recorded: Any, number: jax.Array) -> Any:
        return memory.add(memory.forget(held, number % every == 0), new, recorded, number)

    return memory._replace(add=add)
