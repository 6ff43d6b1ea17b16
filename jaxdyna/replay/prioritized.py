"""Transitions drawn the more often, the more there is to learn from them (Schaul et al. 2016)."""

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from jaxdyna.replay import frames as frame_replay
from jaxdyna.replay.frames import FrameReplay
from jaxdyna.replay.ring import draw
from jaxdyna.types import Key, Transition

SMALLEST_ERROR = 1e-3


@struct.dataclass
class Prioritized:
    """A replay of frames with priorities."""

    memory: FrameReplay  #: the transitions
    #: ``[capacity]``, what each position's probability is in proportion to; 0 where there is
    #: nothing to draw
    priority: jax.Array

    @property
    def size(self) -> jax.Array:
        """How many transitions can be drawn."""
        return self.memory.size


def init(memory: FrameReplay) -> Prioritized:
    """An empty buffer with priorities."""
    return Prioritized(memory, jnp.zeros(memory.capacity))


def add(held: Prioritized, episodes: Transition) -> Prioritized:
    """Adds whole episodes ``[N, T]`` at the highest priority that there is: all are seen soon."""
    memory = frame_replay.add(held.memory, episodes)
    numbers = memory.number(jnp.arange(memory.capacity))
    highest = held.priority.max()
    highest = jnp.where(highest > 0, highest, 1.0)
    priority = jnp.where(numbers >= held.memory.added, highest, held.priority)
    return Prioritized(memory, jnp.where(memory.held, priority, 0.0))


def draw_numbers(
    held: Prioritized, key: Key, shape: tuple[int, ...]
) -> tuple[jax.Array, jax.Array]:
    """Numbers of transitions drawn with replacement, and how often each is drawn compared with a
    uniform draw, both ``[*shape]``.
    """
    position = draw(held.priority, key, shape)
    mean = held.priority.sum() / jnp.maximum(held.size, 1)
    often = held.priority[position] / jnp.where(mean > 0, mean, 1.0)
    return held.memory.number(position), jnp.where(often > 0, often, 1.0)


def reprioritise(
    held: Prioritized, numbers: jax.Array, errors: jax.Array, which: jax.Array,
    exponent: jax.Array | float,
) -> Prioritized:  # fmt: skip
    """Priorities anew of the transitions of these numbers, where ``which`` (bool) says so, by their
    TD errors, all ``[N]``; an exponent of 0 draws uniformly.
    """
    capacity = held.memory.capacity
    slot = jnp.where(which, numbers % capacity, capacity)  # out of bounds: dropped
    errors = jnp.where(jnp.isfinite(errors), jnp.abs(errors), 0.0)  # one would be drawn for ever
    priority = (errors + SMALLEST_ERROR) ** exponent
    priority = priority.astype(held.priority.dtype)
    return replace(held, priority=held.priority.at[slot].set(priority, mode="drop"))
