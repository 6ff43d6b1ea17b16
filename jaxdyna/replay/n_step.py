"""A few successive transitions at a time, for n-step learning."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxdyna.replay import frames as frame_replay
from jaxdyna.replay.frames import FrameReplay
from jaxdyna.types import Transition


class Window(NamedTuple):
    """What n-step learning takes of a few successive transitions (Sutton and Barto 2018, §7.1)."""

    first: Transition  #: the first of them, a `Transition` ``[...]``
    reward: jax.Array  #: their discounted sum, up to the end of the episode, ``[...]``
    last_obs: jax.Array  #: the observation after the last of them, ``[..., *obs]``
    #: of the value there: ``discount ** length``, 0 where the episode terminated
    discount: jax.Array


def take_window(
    replay: FrameReplay, number: jax.Array, length: int, discount: jax.Array | float
) -> Window:
    """The windows that begin with the transitions of these numbers (`jaxdyna.replay.frames.take`),
    fewer than ``length`` long where an episode ends.
    """
    first = frame_replay.take(replay, number)
    if length == 1:
        going_on = discount * (1 - first.terminated)
        return Window(first, first.reward, first.next_obs, going_on)
    slot = (number[..., None] + jnp.arange(length)) % replay.capacity
    same_episode = replay.episode[slot] == replay.episode[slot[..., :1]]
    alive = same_episode & (number[..., None] + jnp.arange(length) < replay.added)
    powers = discount ** jnp.arange(length)
    reward = (replay.rest["reward"][slot] * alive * powers).sum(-1)
    steps = alive.sum(-1)
    last = frame_replay.take(replay, number + steps - 1)
    return Window(first, reward, last.next_obs, discount**steps * (1 - last.terminated))
