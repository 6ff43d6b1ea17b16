"""The bridge to Gymnasium; only it and the way back, `jaxdyna.envs.hosted`, import that.

`HostEnv` and `HostVectorEnv` play any of this package's environments, a learned one included, from
the host, so that other libraries can train in it.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, ClassVar

import cloudpickle
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
    keys: ClassVar[Mapping[str, int]] = {}  #: actions by the arrow, or space, that chooses them

    def action_space(self, params: Any) -> spaces.Discrete:
        """One of ``num_actions``."""
        return spaces.Discrete(self.num_actions)


class Pictures(Discrete):
    """And of those that are seen as frames: bytes."""

    frame_shape: Any

    def observation_space(self, params: Any) -> spaces.Box:
        """Bytes ``[height, width, 3]``."""
        return spaces.Box(0, 255, self.frame_shape, np.uint8)


REGISTERED: dict[str, tuple[Environment, Any]] = {}  #: environments and their parameters, by name


def register(env_id: str, env: Environment, params: Any, **spec: Any) -> None:
    """Registers an environment for ``gymnasium.make`` and ``gymnasium.make_vec``.

    Args:
        env_id: such as ``"jaxdyna/CartPole-v0"``.
        env: the environment.
        params: its parameters; for a learned environment the trained weights.
        **spec: further fields of Gymnasium's ``EnvSpec``, such as ``reward_threshold``;
            ``max_episode_steps`` is ``params.max_steps`` unless given.
    """
    _checked(env, params)
    REGISTERED[env_id] = env, params
    gymnasium.register(
        env_id,
        entry_point=f"{__name__}:HostEnv",
        vector_entry_point=f"{__name__}:HostVectorEnv",
        kwargs={"env": env_id},  # nothing that could not become JSON
        **{"max_episode_steps": int(params.max_steps)} | spec,
    )


def play(
    env_id: str, policy: Callable[..., jax.Array], seed: int, episodes: int, max_steps: int
) -> np.ndarray:  # fmt: skip
    """Returns ``[episodes]`` that ``policy``, ``(obs, key) -> action``, earns in an environment of
    Gymnasium's own, in episodes of at most ``max_steps`` steps, side by side.
    """
    env = gymnasium.make_vec(env_id, episodes, "sync", max_episode_steps=max_steps)
    act, key = jax.jit(jax.vmap(policy)), jax.random.key(seed)
    obs, _ = env.reset(seed=seed)
    returns, alive = np.zeros(episodes), np.ones(episodes, bool)
    while alive.any():
        key, key_act = jax.random.split(key)
        actions = np.asarray(act(obs, jax.random.split(key_act, episodes)))
        obs, reward, terminated, truncated, _ = env.step(actions)
        returns += np.where(alive, reward, 0)
        alive &= ~(terminated | truncated)
    env.close()
    return returns


def atari_emulator(game: str) -> Any:
    """The emulator itself of such a game at its start, an ``ale_py.ALEInterface`` that repeats no
    actions; always the same. `ImportError` without the ``atari`` extra.
    """
    check_atari()
    env: Any = gymnasium.make(f"ALE/{game}-v5", repeat_action_probability=0.0)
    env.reset(seed=0)
    return env.unwrapped.ale


def check_atari() -> None:
    """Makes the real Atari games known to Gymnasium; `ImportError` without the ``atari`` extra."""
    try:
        import ale_py  # noqa: PLC0415  (an extra that most people do without)
    except ImportError as error:
        raise ImportError(
            "the real Atari games need ale-py: pip install 'jaxdyna[atari]'"
        ) from error
    ale_py.ALEInterface.setLoggerMode(ale_py.LoggerMode.Error)  # no banner for every copy
    gymnasium.register_envs(ale_py)


class ByValue:
    """An environment, pickled by value where it has no name to be found by, as the functions of a
    learned one; copies share it and with it the compiled programs.
    """

    def __init__(self, env: Environment):
        self.env = env

    def __deepcopy__(self, memo: dict) -> ByValue:
        return self

    def __reduce__(self) -> tuple:
        return _by_value, (cloudpickle.dumps(self.env),)


def _by_value(pickled: bytes) -> ByValue:
    return ByValue(pickle.loads(pickled))


class Host:
    """What one environment and a vector of them share.

    Args:
        env: the environment, or the name that it is registered by.
        params: its parameters, by default those registered, or ``env.default_params``.
        render_mode: None or ``"rgb_array"``.

    Raises:
        CannotRenderError: with ``"rgb_array"`` where the environment has no frames to show.
        ValueError: where nothing is registered by this name.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50}

    def __init__(self, env: Environment | str, params: Any = None, render_mode: str | None = None):
        if isinstance(env, str):
            if env not in REGISTERED:
                said = "call jaxdyna.envs.register(name, env, params) in this process first"
                raise ValueError(f"nothing is registered by the name {env!r}: {said}")
            env, registered = REGISTERED[env]
            params = registered if params is None else params
        self.env = env
        self.params = _checked(env, params)
        self.render_mode = _check_render_mode(env, self.params, render_mode)
        self._state: Any = None

    def _chosen(self, action: Any) -> Any:
        """As the environment takes it: JAX's numbers too, and of vectors those of 64 bits."""
        if self._state is None:
            raise ValueError("step before reset: call reset() first")
        space: Any = self.action_space  # type: ignore[attr-defined]
        chosen = np.asarray(action, np.float32 if isinstance(space, spaces.Box) else None)
        if not space.contains(chosen):
            raise ValueError(f"action {action!r} is not in {space}")
        return chosen

    def _seeds(self, count: int) -> np.ndarray:
        generator: np.random.Generator = self.np_random  # type: ignore[attr-defined]
        return generator.integers(0, 2**32, size=count, dtype=np.uint32)

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "env": ByValue(self.env)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, env=state["env"].env)


class HostEnv(Host, gymnasium.Env[np.ndarray, np.int64]):
    """One environment behind Gymnasium's interface; for the arguments see `Host`.

    Its own ``params.max_steps`` is the time limit, unless it is made by its name: then Gymnasium's
    ``TimeLimit`` is, by ``max_episode_steps``.
    """

    def __init__(self, env: Environment | str, params: Any = None, render_mode: str | None = None):
        super().__init__(env, params, render_mode)
        self.observation_space = self.env.observation_space(self.params)
        self.action_space = self.env.action_space(self.params)
        self._limited = not isinstance(env, str)
        self._steps = 0
        self._end: tuple[np.ndarray, bool, bool] | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Starts an episode; ``seed`` makes it and all that follows reproducible. With ``options``
        obs, that is its first observation; with low and high, every number of it is uniform
        between them, as in Gymnasium's own CartPole; `ValueError` on others, or where it cannot be.
        """
        super().reset(seed=seed)
        if options:
            obs = _first_obs(self.env, options, self.observation_space, self.np_random)
            self._state = self.env.state_of(jnp.asarray(obs))  # type: ignore[attr-defined]
        else:
            obs, self._state = _reset(self.env, self.params, self._seeds(1)[0])
        self._end, self._steps = None, 0
        return np.array(obs), {}

    def step(self, action: np.int64):
        """Plays one step; `ValueError` before a reset, or where the action is none of the action
        space. After the end of an episode nothing moves and nothing is paid, and Gymnasium warns.
        """
        chosen = self._chosen(action)
        if self._end is not None:
            gymnasium.logger.warn("step after the end of the episode: call reset() first")
            return self._end[0].copy(), 0.0, *self._end[1:], {}
        obs, self._state, reward, terminated, truncated, info = _step(
            self.env, self.params, self._seeds(1)[0], self._state, jnp.asarray(chosen)
        )
        self._steps += 1
        if self._steps >= self.params.max_steps and not self._limited:
            truncated = False  # the limit is TimeLimit's
        if terminated or truncated:
            self._end = (np.array(obs), bool(terminated), bool(truncated))
        return np.array(obs), float(reward), bool(terminated), bool(truncated), _arrays(info)

    def render(self) -> np.ndarray | None:
        """The current frame, uint8 ``[height, width, 3]``, with ``render_mode="rgb_array"``."""
        if self.render_mode is None or self._state is None:
            return None
        return np.asarray(_render(self.env, self.params, self._state))


class HostVectorEnv(Host, VectorEnv):
    """``num_envs`` copies of a `HostEnv` stepped in one jitted call; an ended one resets in the
    following step. ``max_episode_steps`` stands in for ``params.max_steps``; the rest is `Host`'s.
    """

    metadata = Host.metadata | {"autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(
        self, env: Environment | str, params: Any = None, num_envs: int = 1,
        render_mode: str | None = None, max_episode_steps: int | None = None,
    ):  # fmt: skip
        check_counts(num_envs=num_envs)
        super().__init__(env, params, render_mode)
        self.num_envs = num_envs
        if max_episode_steps is not None:
            if max_episode_steps < 1:
                raise ValueError(f"max_episode_steps is {max_episode_steps}: give at least 1")
            change = getattr(self.params, "replace", None) or self.params._replace
            self.params = change(max_steps=max_episode_steps)
        self.single_observation_space = self.env.observation_space(self.params)
        self.single_action_space = self.env.action_space(self.params)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._ended = np.zeros(num_envs, bool)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Starts an episode in every copy; ``seed`` is one number for all that follows.
        `ValueError` where there are options: no copy takes any.
        """
        if options:
            raise ValueError(f"options {sorted(options)}: give them to a single environment")
        super().reset(seed=seed)
        seeds = self._seeds(self.num_envs)
        obs, self._state = jax.vmap(partial(_reset, self.env, self.params))(seeds)
        self._ended = np.zeros(self.num_envs, bool)
        return np.array(obs), {}

    def step(self, actions: np.ndarray):
        """Plays one step in every copy; those that ended in the last one start anew instead, with
        reward 0. What ``info`` has of a copy counts where its underscored twin is true.
        """
        chosen, seeds = jnp.asarray(self._chosen(actions)), self._seeds(self.num_envs)
        obs, self._state, *outcome, info = _vector_step(
            self.env, self.params, seeds, self._state, chosen, self._ended
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


class CannotRenderError(ValueError, TypeError):
    """No frames: a `TypeError` too, upon which Stable-Baselines3 goes on without them."""


def _check_render_mode(env: Environment, params: Any, render_mode: str | None) -> str | None:
    if render_mode not in (None, "rgb_array"):
        raise ValueError(f"render_mode is {render_mode!r}: there are None and 'rgb_array'")
    if render_mode is not None:
        try:
            jax.eval_shape(
                lambda key: _render(env, params, env.reset(key, params)[1]), jax.random.key(0)
            )
        except AttributeError as error:
            raise CannotRenderError(
                f"{type(getattr(env, 'env', env)).__name__} cannot be rendered: give it a method "
                "render(state, params) that returns a frame, bytes [height, width, 3], or let "
                f"render_mode be None ({error})"
            ) from error
    return render_mode


def _first_obs(
    env: Environment, options: dict[str, Any], space: Any, generator: np.random.Generator
) -> np.ndarray:
    known = hasattr(env, "state_of")
    if known and sorted(options) == ["obs"] and np.shape(options["obs"]) == space.shape:
        return np.asarray(options["obs"], space.dtype)
    if known and sorted(options) == ["high", "low"] and options["low"] <= options["high"]:
        obs = generator.uniform(options["low"], options["high"], space.shape)
        return obs.astype(space.dtype)
    takes = f"obs {space.shape}, or low and high, in this order of size" if known else "no options"
    raise ValueError(f"options are {options}: {type(env).__name__} takes {takes}")


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
def _vector_step(env, params, seeds, state, actions, ended):
    def one(seed, state, action, ended):
        fresh = _reset(env, params, seed)
        obs, state, reward, terminated, truncated, info = _step(env, params, seed, state, action)
        obs, state = jax.tree.map(lambda new, old: jnp.where(ended, new, old), fresh, (obs, state))
        reward = jnp.where(ended, 0, reward)
        return obs, state, reward, terminated & ~ended, truncated & ~ended, info

    return jax.vmap(one)(seeds, state, actions, ended)
