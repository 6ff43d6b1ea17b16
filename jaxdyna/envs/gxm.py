"""Worlds by gxm's names, of suites that have gymnax's functions: Craftax, and gymnax itself.

gxm's own ``step`` begins the next episode by itself, so that what was seen last is lost, and takes
a time limit for an end. So a suite is played below it, by its ``reset_env`` and ``step_env``.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxdyna.actions import actions_in
from jaxdyna.envs.gymnasium import spaces
from jaxdyna.envs.hosted import HostedParams
from jaxdyna.trees import raw
from jaxdyna.types import Key, Stepped

LIMITS = "max_steps_in_episode", "max_timesteps"  #: what suites call the steps of an episode
INSTALL = "python -m pip install 'jaxdyna[gxm]' 'gymnax<1' 'craftax<1.6'"


def from_gxm(world: str) -> "Gxm":
    """A world such as ``"Craftax/Craftax-Symbolic-v1"`` as a `jaxdyna.types.Environment`. Pictures
    ``[height, width, channels]`` of numbers from 0 to 1 are seen as bytes, all else as a vector.
    `ImportError` without gxm, `ValueError` where it has no such world, or of another suite.
    """
    try:
        import gxm  # noqa: PLC0415  (an extra that most people do without)
    except ImportError as error:
        raise ImportError(f"gxm's worlds need gxm, and their own suites: {INSTALL}") from error
    try:
        made = gxm.make(world)
        suite: Any = vars(made).get("env")
        kind, look = made.action_space, made.observation_space
        if not hasattr(suite, "step_env"):
            raise ValueError("its step resets, and what was seen last is lost")
        given = made.env_params
        limit = next(name for name in LIMITS if hasattr(given, name))
        if isinstance(kind, gxm.spaces.Discrete):
            actions: Any = spaces.Discrete(int(kind.n))
        else:
            actions = spaces.Box(np.array(kind.low), np.array(kind.high))
        lit = len(look.shape) == 3 and look.low.min() >= 0 and look.high.max() <= 1

        def played(key: jax.Array) -> Any:
            return suite.step_env(key, suite.reset_env(key, given)[1], kind.sample(key), given)

        jax.eval_shape(played, raw(jax.random.key(0)))  # a suite's fault is said here
    except Exception as error:  # whatever that is
        how = f"give one of Craftax or Gymnax, as gxm calls it, and {INSTALL}"
        raise ValueError(f"{world} cannot be played ({error!r}): {how}") from error
    vector = spaces.Box(-np.inf, np.inf, (int(np.prod(look.shape)),))
    seen = spaces.Box(0, 255, look.shape, np.uint8) if lit else vector
    params = HostedParams(int(getattr(given, limit)))
    return Gxm(suite, given, given.replace(**{limit: 2**30}), seen, actions, params)


@struct.dataclass
class GxmState:
    """Where an episode stands."""

    suite: Any  #: the suite's own state
    time: jax.Array  #: int32, steps taken


@dataclass(frozen=True, eq=False)
class Gxm:
    """What `from_gxm` returns."""

    suite: Any
    given: Any  #: the suite's parameters
    endless: Any  #: these without a time limit: it looks like an end
    seen: spaces.Box
    actions: Any
    default_params: HostedParams

    @property
    def num_actions(self) -> int:
        """The number of discrete actions."""
        return int(self.actions.n)

    def action_space(self, params: HostedParams) -> spaces.Space:
        return self.actions

    def observation_space(self, params: HostedParams) -> spaces.Box:
        return self.seen

    def reset(self, key: Key, params: HostedParams) -> tuple[jax.Array, GxmState]:
        """Begins an episode, by a raw key: suites may use it twice."""
        obs, state = self.suite.reset_env(raw(key), self.given)
        return self._see(obs), GxmState(_typed(state), jnp.int32(0))

    def step(self, key: Key, state: GxmState, action: jax.Array, params: HostedParams) -> Stepped:
        """One step of the world."""
        action = actions_in(self.actions).clip(action)
        obs, new, reward, *_ = self.suite.step_env(raw(key), state.suite, action, self.given)
        new, reward = GxmState(_typed(new), state.time + 1), jnp.float32(reward)
        terminated = jnp.bool_(self.suite.is_terminal(new.suite, self.endless))
        truncated = ~terminated & (new.time >= params.max_steps)
        return self._see(obs), new, reward, terminated, truncated, {}

    def _see(self, obs: jax.Array) -> jax.Array:
        bytes_ = self.seen.dtype == np.uint8
        return jnp.round(255 * obs).astype(np.uint8) if bytes_ else jnp.float32(obs).ravel()


def _typed(state: Any) -> Any:
    """With types of its own where they came from a number of Python's: a loop keeps them."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.result_type(leaf)), state)
