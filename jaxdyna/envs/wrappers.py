"""Environments around environments: frames stacked, episodes that begin elsewhere."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxdyna.envs.gymnasium import spaces
from jaxdyna.fields import Checked, setting
from jaxdyna.types import Environment, Key, Stepped


@dataclass(frozen=True)
class Wrapper(Checked):
    """The environment's own, where a wrapper says nothing else."""

    env: Environment = setting(help="What is wrapped.")

    @property
    def default_params(self) -> Any:
        return self.env.default_params

    @property
    def num_actions(self) -> int:
        return self.env.num_actions  # type: ignore[attr-defined]

    def action_space(self, params: Any) -> Any:
        return self.env.action_space(params)


@struct.dataclass
class StackState:
    """The environment's own state and the frames seen last, ``[H, W, C * frames]``."""

    env: Any
    obs: jax.Array


@dataclass(frozen=True)
class FrameStack(Wrapper):
    """An environment whose observation is its last frames, stacked on the channels, the newest
    last; an episode begins with its first frame repeated. A vector is a frame of one axis.
    """

    env: Environment = setting(help="Observes frames [H, W, C], or vectors.")
    num_frames: int = setting(4, "Frames in an observation.", at_least=1)

    def __post_init__(self) -> None:
        super().__post_init__()
        shape = self.env.observation_space(self.env.default_params).shape
        if len(shape) not in (1, 3):
            raise ValueError(
                f"{type(self.env).__name__} observes arrays of shape {shape}: let it observe "
                "pictures [height, width, channels], or vectors"
            )

    def reset(self, key: Key, params: Any) -> tuple[jax.Array, StackState]:
        """Starts an episode."""
        frame, state = self.env.reset(key, params)
        obs = jnp.concatenate([frame] * self.num_frames, axis=-1)
        return obs, StackState(state, obs)

    def step(self, key: Key, state: StackState, action: jax.Array, params: Any) -> Stepped:
        """One step of the environment; the oldest frame makes room for the new one."""
        frame, inner, reward, terminated, truncated, info = self.env.step(
            key, state.env, action, params
        )
        obs = jnp.concatenate([state.obs[..., frame.shape[-1] :], frame], axis=-1)
        return obs, StackState(inner, obs), reward, terminated, truncated, info

    def render(self, state: StackState, params: Any) -> jax.Array:
        return self.env.render(state.env, params)  # type: ignore[attr-defined]

    def observation_space(self, params: Any) -> spaces.Box:
        """The environment's, stacked."""
        space = self.env.observation_space(params)
        low, high = (np.tile(end, self.num_frames) for end in (space.low, space.high))
        return spaces.Box(low, high, dtype=space.dtype)


@struct.dataclass
class ReplayedParams:
    """The environment's own, what start states are drawn from, and the longest episode."""

    env: Any
    start: Any
    max_steps: int | jax.Array = 200


@dataclass(frozen=True)
class Replayed(Wrapper):
    """An environment of stacked frames whose episodes begin in the midst of real ones instead of at
    the start: the world of an oracle's dreams, which begin where those in a learned model do.

    Attributes:
        draw: ``(key, params.start) -> (stack, state)``: what was seen in a real episode, and the
            state below the stack that was seen so; its field ``time`` begins at 0.
    """

    draw: Callable[[Key, Any], tuple[jax.Array, Any]] = setting()

    @property
    def default_params(self) -> ReplayedParams:
        """Without frames; fill in ``start``."""
        return ReplayedParams(self.env.default_params, start=None)

    def reset(self, key: Key, params: ReplayedParams) -> tuple[jax.Array, StackState]:
        """Draws where it begins; `ValueError` where states lack ``time``: dreams count it anew."""
        obs, state = self.draw(key, params.start)
        if not hasattr(state, "time"):
            raise ValueError(
                f"{type(state).__name__} has no field time: count the steps of an episode in it, "
                "from 0, and compare it with params.max_steps"
            )
        return obs, StackState(replace(state, time=jnp.zeros_like(state.time)), obs)

    def step(
        self, key: Key, state: StackState, action: jax.Array, params: ReplayedParams
    ) -> Stepped:
        return self.env.step(key, state, action, params.env)

    def observation_space(self, params: ReplayedParams) -> Any:
        return self.env.observation_space(params.env)

    def action_space(self, params: ReplayedParams) -> Any:
        return self.env.action_space(params.env)


def draw_start(key: Key, starts: Any) -> tuple[jax.Array, Any]:
    """One of ``(obs, state) [starts, ...]``."""
    number = jax.random.randint(key, (), 0, len(starts[0]))
    return jax.tree.map(lambda leaf: leaf[number], starts)


@dataclass(frozen=True)
class Drawn(Replayed):
    """Any environment whose episodes begin in one of the starts that were drawn of it beforehand:
    what its own are drawn from, such as a replay, is not needed any more.
    """

    draw: Callable[[Key, Any], tuple[jax.Array, Any]] = draw_start

    @property
    def state_of(self) -> Callable[[jax.Array], Any]:
        """The environment's, where it has one."""
        return self.env.state_of  # type: ignore[attr-defined]

    def reset(self, key: Key, params: ReplayedParams) -> tuple[jax.Array, Any]:
        """Draws where it begins."""
        return self.draw(key, params.start)

    def step(self, key: Key, state: Any, action: jax.Array, params: ReplayedParams) -> Any:
        change = getattr(params.env, "replace", None) or params.env._replace
        return self.env.step(key, state, action, change(max_steps=params.max_steps))

    def render(self, state: Any, params: ReplayedParams) -> jax.Array:
        return self.env.render(state, params.env)  # type: ignore[attr-defined]
