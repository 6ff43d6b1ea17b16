"""Several frames for one observation, so that motion can be seen (§3.2; Mnih et al. 2015)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxdyna.envs.gymnasium import spaces
from jaxdyna.fields import check, setting
from jaxdyna.types import Environment, Key


@struct.dataclass
class StackState:
    """The environment's own state and the frames seen last, ``[H, W, C * frames]``."""

    env: Any
    obs: jax.Array


@dataclass(frozen=True)
class FrameStack:
    """An environment whose observation is its last frames, stacked on the channels, the newest
    last; an episode begins with its first frame repeated.
    """

    env: Environment = setting(help="Observes frames [H, W, C].")
    num_frames: int = setting(4, "Frames in an observation.", at_least=1)

    def __post_init__(self) -> None:
        check(self)
        shape = self.env.observation_space(self.env.default_params).shape
        if len(shape) != 3:
            raise ValueError(
                f"{type(self.env).__name__} observes arrays of shape {shape}: stack the frames of "
                "an environment that observes pictures [height, width, channels]"
            )

    @property
    def default_params(self) -> Any:
        """The environment's."""
        return self.env.default_params

    @property
    def num_actions(self) -> int:
        """The environment's."""
        return self.env.num_actions

    def reset(self, key: Key, params: Any) -> tuple[jax.Array, StackState]:
        """Starts an episode."""
        frame, state = self.env.reset(key, params)
        obs = jnp.tile(frame, (1, 1, self.num_frames))
        return obs, StackState(state, obs)

    def step(
        self, key: Key, state: StackState, action: jax.Array, params: Any
    ) -> tuple[jax.Array, StackState, jax.Array, jax.Array, jax.Array, dict[str, Any]]:
        """One step of the environment; the oldest frame makes room for the new one."""
        frame, inner, reward, terminated, truncated, info = self.env.step(
            key, state.env, action, params
        )
        obs = jnp.concatenate([state.obs[..., frame.shape[-1] :], frame], axis=-1)
        return obs, StackState(inner, obs), reward, terminated, truncated, info

    def render(self, state: StackState, params: Any) -> jax.Array:
        """The environment's."""
        return self.env.render(state.env, params)  # type: ignore[attr-defined]

    def observation_space(self, params: Any) -> spaces.Box:
        """Bytes."""
        height, width, channels = self.env.observation_space(params).shape
        return spaces.Box(0, 255, (height, width, channels * self.num_frames), np.uint8)

    def action_space(self, params: Any) -> Any:
        """The environment's."""
        return self.env.action_space(params)
