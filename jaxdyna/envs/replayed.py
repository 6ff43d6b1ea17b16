"""The true environment, its episodes beginning where real ones have been."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from jaxdyna.envs.stack import FrameStack, StackState
from jaxdyna.types import Key


@struct.dataclass
class ReplayedParams:
    """The environment's own, what start states are drawn from, and the longest episode."""

    env: Any
    start: Any
    max_steps: int | jax.Array = 200


def at_time_0(state: Any) -> Any:
    """The same, no step of the episode taken: its field ``time`` is 0."""
    return replace(state, time=jnp.zeros_like(state.time))


@dataclass(frozen=True)
class Replayed:
    """An environment of stacked frames whose episodes begin in the midst of real ones instead of at
    the start: the world of an oracle's dreams, which begin where those in a learned model do.

    Attributes:
        real: the environment.
        draw: ``(key, params.start) -> (stack, state)``: what was seen in a real episode, and the
            state below the stack that was seen so.
        begin: from such a state to one in which an episode begins.
    """

    real: FrameStack
    draw: Callable[[Key, Any], tuple[jax.Array, Any]]
    begin: Callable[[Any], Any] = at_time_0

    @property
    def default_params(self) -> ReplayedParams:
        """Without frames; fill in ``start``."""
        return ReplayedParams(self.real.default_params, start=None)

    @property
    def num_actions(self) -> int:
        """The environment's."""
        return self.real.num_actions

    def reset(self, key: Key, params: ReplayedParams) -> tuple[jax.Array, StackState]:
        """Draws where it begins."""
        obs, state = self.draw(key, params.start)
        return obs, StackState(self.begin(state), obs)

    def step(
        self, key: Key, state: StackState, action: jax.Array, params: ReplayedParams
    ) -> tuple[jax.Array, StackState, jax.Array, jax.Array, jax.Array, dict[str, Any]]:
        """The environment's."""
        return self.real.step(key, state, action, params.env)

    def observation_space(self, params: ReplayedParams) -> Any:
        """The environment's."""
        return self.real.observation_space(params.env)

    def action_space(self, params: ReplayedParams) -> Any:
        """The environment's."""
        return self.real.action_space(params.env)
