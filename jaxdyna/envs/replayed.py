"""The true environment, its episodes beginning where real ones have been."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
from flax import struct

from jaxdyna.envs.stack import FrameStack, StackState
from jaxdyna.types import Key


@struct.dataclass
class ReplayedParams:
    """The environment's own, what start states are drawn from, and the longest episode."""

    env: Any
    start: Any
    max_steps: int | jax.Array = 200


@dataclass(frozen=True)
class Replayed:
    """An environment of stacked frames whose episodes begin at any real stack instead of the start:
    the world of an oracle's dreams, which begin where those in a learned model do.

    Attributes:
        real: the environment.
        draw: ``(key, params.start) -> stack``: where episodes begin.
        read: ``(stack, params.env, key) -> state`` of the environment below the stack; the key
            draws what the stack does not show.
    """

    real: FrameStack
    draw: Callable[[Key, Any], jax.Array]
    read: Callable[[jax.Array, Any, Key], Any]

    @property
    def default_params(self) -> ReplayedParams:
        """Without frames; fill in ``start``."""
        return ReplayedParams(self.real.default_params, start=None)

    @property
    def num_actions(self) -> int:
        """The environment's."""
        return self.real.num_actions

    def reset(self, key: Key, params: ReplayedParams) -> tuple[jax.Array, StackState]:
        """Draws a real stack and reads the state off it."""
        key_draw, key_read = jax.random.split(key)
        obs = self.draw(key_draw, params.start)
        return obs, StackState(self.read(obs, params.env, key_read), obs)

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
