"""The bridge to Gymnasium, and the only module that imports it.

`HostEnv` and `HostVectorEnv` play any of this package's environments, a learned one included, from
the host, so that other libraries can train in it.
"""

from __future__ import annotations

from functools import partial
from typing import Any, ClassVar

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from jaxdyna.fields import check_counts, check_kind
from jaxdyna.types import Environment, check_part

__all__ = ["HostEnv", "HostVectorEnv", "atari_emulator", "register", "spaces"]


class Discrete:
    """What environments of this package share: actions are numbered."""

    num_actions: ClassVar[int]

    def action_space(self, params: Any) -> spaces.Discrete:
        """One of ``num_actions``."""
        return spaces.Discrete(self.num_actions)


class Pictures(Discrete):
    """And of those that are seen as frames: bytes."""

    frame_shape: Any

    def observation_space(self, params: Any) -> spaces.Box:
        """Bytes ``[height, width, 3]``."""
        return spaces.Box(0, 255, self.frame_shape, np.uint8)


def register(env_id: str, env: Environment, params: Any, **spec: Any) -> None:
    """Registers an environment for ``gymnasium.make`` and ``gymnasium.make_vec``.

    Args:
        env_id: such as ``"jaxdyna/CartPole-v0"``.
        env: the environment.
        params: its parameters; for a learned environment the trained weights.
        **spec: further fields of Gymnasium's ``EnvSpec``, such as ``reward_threshold``.
    """
    _checked(env, params)
    gymnasium.register(
        env_id,
        entry_point=f"{__name__}:HostEnv",
        vector_entry_point=f"{__name__}:HostVectorEnv",
        kwargs={"env": env, "params": params},
        **spec,
    )


def atari_emulator(game: str) -> Any:
    """The emulator itself of such a game at its start, an ``ale_py.ALEInterface`` that repeats no
    actions; always the same.

    Raises:
        ImportError: without the ``atari`` extra.
    """
    check_atari()
    env: Any = gymnasium.make(f"ALE/{game}-v5", repeat_action_probability=0.0)
    env.reset(seed=0)
    return env.unwrapped.ale


def check_atari() -> None:
    """Makes the real Atari games known to Gymnasium.

    Raises:
        ImportError: without the ``atari`` extra, with how to install it.
    """
    try:
        import ale_py  # noqa: PLC0415  (an extra that most people do without)
    except ImportError as error:
        raise ImportError(
            "the real Atari games need ale-py: python -m pip install 'jaxdyna[atari]'"
        ) from error
    ale_py.ALEInterface.setLoggerMode(ale_py.LoggerMode.Error)  # no banner for every copy
    gymnasium.register_envs(ale_py)


class HostEnv(gymnasium.Env[np.ndarray, np.int64]):
    """One environment behind Gymnasium's interface; time limits are the environment's own.

    Args:
        env: the environment.
        params: its parameters, by default ``env.default_params``.
        render_mode: None or ``"rgb_array"``.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50}

    def __init__(self, env: Environment, params: Any = None, render_mode: str | None = None):
        self.env = env
        self.params = _checked(env, params)
        self.render_mode = _check_render_mode(env, render_mode)
        self.observation_space = env.observation_space(self.params)
        self.action_space = env.action_space(self.params)
        self._state: Any = None
        self._end: tuple[np.ndarray, bool, bool] | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Starts an episode; ``seed`` makes it and all that follows reproducible."""
        super().reset(seed=seed)
        obs, self._state = _reset(self.env, self.params, _draw_seeds(self.np_random, 1)[0])
        self._end = None
        return np.array(obs), {}

    def step(self, action: np.int64):
        """Plays one step. After the end of an episode nothing moves and nothing is paid, and
        Gymnasium warns.

        Raises:
            ValueError: before a reset, or where the action is none of the action space.
        """
        if self._state is None:
            raise ValueError("step before reset: call reset() first")
        chosen: Any = np.asarray(action)  # JAX's numbers too
        if not self.action_space.contains(chosen):
            raise ValueError(f"action {action!r} is not in {self.action_space}")
        if self._end is not None:
            gymnasium.logger.warn("step after the end of the episode: call reset() first")
            return self._end[0].copy(), 0.0, *self._end[1:], {}
        seed = _draw_seeds(self.np_random, 1)[0]
        obs, self._state, reward, terminated, truncated, info = _step(
            self.env, self.params, seed, self._state, jnp.asarray(chosen)
        )
        if terminated or truncated:
            self._end = (np.array(obs), bool(terminated), bool(truncated))
        return np.array(obs), float(reward), bool(terminated), bool(truncated), _arrays(info)

    def render(self) -> np.ndarray | None:
        """The current frame, uint8 ``[height, width, 3]``, with ``render_mode="rgb_array"``."""
        if self.render_mode is None or self._state is None:
            return None
        return np.asarray(_render(self.env, self.params, self._state))


class HostVectorEnv(VectorEnv):
    """``num_envs`` copies of a `HostEnv` stepped in one jitted call; an ended one resets in the
    following step.
    """

    metadata = {
        "render_modes": ["rgb_array"],
        "render_fps": 50,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self, env: Environment, params: Any = None, num_envs: int = 1,
        render_mode: str | None = None,
    ):  # fmt: skip
        check_counts(num_envs=num_envs)
        self.env = env
        self.params = _checked(env, params)
        self.num_envs = num_envs
        self.render_mode = _check_render_mode(env, render_mode)
        self.single_observation_space = env.observation_space(self.params)
        self.single_action_space = env.action_space(self.params)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._state: Any = None
        self._ended = np.zeros(num_envs, bool)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Starts an episode in every copy; ``seed`` is one number for all that follows."""
        super().reset(seed=seed)
        seeds = _draw_seeds(self.np_random, self.num_envs)
        obs, self._state = _vector_reset(self.env, self.params, seeds)
        self._ended = np.zeros(self.num_envs, bool)
        return np.array(obs), {}

    def step(self, actions: np.ndarray):
        """Plays one step in every copy; those that ended in the last one start anew instead, with
        reward 0. What ``info`` has of a copy counts where its underscored twin is true.
        """
        if self._state is None:
            raise ValueError("step before reset: call reset() first")
        if not self.action_space.contains(np.asarray(actions)):
            raise ValueError(f"actions {actions!r} are not in {self.action_space}")
        seeds = _draw_seeds(self.np_random, self.num_envs)
        obs, self._state, *outcome, info = _vector_step(
            self.env, self.params, seeds, self._state, jnp.asarray(actions), self._ended
        )
        reward, terminated, truncated = (np.asarray(part) for part in outcome)
        played, self._ended = ~self._ended, terminated | truncated
        infos = _arrays(info)
        infos |= {f"_{name}": played for name in infos}
        return np.array(obs), reward, terminated, truncated, infos

    def render(self) -> tuple[np.ndarray, ...] | None:
        """One frame a copy, with ``render_mode="rgb_array"``."""
        if self.render_mode is None or self._state is None:
            return None
        frames = jax.vmap(lambda state: _render(self.env, self.params, state))(self._state)
        return tuple(np.asarray(frames))


def _checked(env: Environment, params: Any) -> Any:
    """The params, by default the environment's."""
    check_part("env", env, "reset", "step", "default_params")
    params = env.default_params if params is None else params
    check_kind("params", params, type(env.default_params))
    return params


def _check_render_mode(env: Environment, render_mode: str | None) -> str | None:
    if render_mode not in (None, "rgb_array"):
        raise ValueError(f"render_mode is {render_mode!r}: there are None and 'rgb_array'")
    if render_mode is not None and not hasattr(env, "render"):
        raise ValueError(
            f"{type(env).__name__} cannot be rendered: use render_mode=None, or give it a method "
            "render(state, params) that returns a frame"
        )
    return render_mode


def _draw_seeds(generator: np.random.Generator, count: int) -> np.ndarray:
    return generator.integers(0, 2**32, size=count, dtype=np.uint32)


@partial(jax.jit, static_argnums=0)
def _reset(env, params, seed):
    return env.reset(jax.random.key(seed), params)


@partial(jax.jit, static_argnums=0)
def _step(env, params, seed, state, action):
    return env.step(jax.random.key(seed), state, action, params)


def _arrays(info: dict[str, Any]) -> dict[str, np.ndarray]:
    """What of an environment's ``info`` is an array."""
    return {name: np.asarray(part) for name, part in info.items() if isinstance(part, jax.Array)}


@partial(jax.jit, static_argnums=0)
def _render(env: Any, params, state):
    return env.render(state, params)


@partial(jax.jit, static_argnums=0)
def _vector_reset(env, params, seeds):
    return jax.vmap(lambda seed: _reset(env, params, seed))(seeds)


@partial(jax.jit, static_argnums=0)
def _vector_step(env, params, seeds, state, actions, ended):
    def one(seed, state, action, ended):
        fresh = _reset(env, params, seed)
        obs, state, reward, terminated, truncated, info = _step(env, params, seed, state, action)
        obs, state = jax.tree.map(lambda new, old: jnp.where(ended, new, old), fresh, (obs, state))
        reward = jnp.where(ended, 0, reward)
        return obs, state, reward, terminated & ~ended, truncated & ~ended, info

    return jax.vmap(one)(seeds, state, actions, ended)
