"""The replays as `jaxdyna.dyna` is given them, see `jaxdyna.types.Memory`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp

from jaxdyna import frame_replay, replay
from jaxdyna.frame_replay import FrameReplay
from jaxdyna.replay import Replay, share_weight
from jaxdyna.types import Key, Memory, Transition


def transitions() -> Memory:
    """`jaxdyna.replay`; rare are transitions that ended an episode."""

    def start(capacity: int, episodes: int, example: Transition) -> Replay:
        del episodes
        return replay.init(capacity, example)

    def draw_some(
        held: Replay, key: Key, shape: tuple[int, ...], rare_share: float | None
    ) -> jax.Array:
        if rare_share is None:
            return replay.draw_positions(held, key, shape)
        weight = share_weight(held.held, held.data.terminated, rare_share)
        return replay.draw_positions(held, key, shape, weight)

    def forget(held: Replay, when: jax.Array) -> Replay:
        return replace(held, added=jnp.where(when, 0, held.added))

    def put(held: Replay, new: Transition) -> Replay:
        return replay.add(held, new, new.mask)

    return Memory(start, put, draw_some, replay.take, forget)


def frames(rare: Callable[[dict[str, jax.Array]], jax.Array], num_frames: int = 4) -> Memory:
    """`jaxdyna.frame_replay`.

    Args:
        rare: from `FrameReplay.rest` to bool ``[capacity]``: which transitions are rare.
        num_frames: frames in a stack.
    """

    def start(capacity: int, episodes: int, example: Transition) -> FrameReplay:
        return frame_replay.init(capacity, episodes, example, num_frames)

    def draw_some(
        held: FrameReplay, key: Key, shape: tuple[int, ...], rare_share: float | None
    ) -> jax.Array:
        if rare_share is None:
            return frame_replay.draw_numbers(held, key, shape)
        weight = share_weight(held.held, rare(held.rest), rare_share)
        return frame_replay.draw_numbers(held, key, shape, weight)

    def forget(held: FrameReplay, when: jax.Array) -> FrameReplay:
        counts = (held.added, held.episodes_added, held.first)
        added, episodes, first = (jnp.where(when, 0, count) for count in counts)
        return replace(held, added=added, episodes_added=episodes, first=first)

    return Memory(start, frame_replay.add, draw_some, frame_replay.take, forget)
