"""Random search over linear policies: the simplest thing that a task can be tried with (Rechenberg
1973; that linear policies and random search go far is Mania et al. 2018). Nothing is learned from
one policy about the next.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxdyna.fields import check_counts, check_shape, setting
from jaxdyna.trees import where
from jaxdyna.types import Agent, Key, Transition, check_transitions


@struct.dataclass
class LinearSearchHParams:
    """What can be swept."""

    enough: float = setting(help="Return from which on a policy is kept and tried once more.")


@struct.dataclass
class LinearPolicy:
    """A policy."""

    params: jax.Array  #: ``[A, n]``: each action's weights of the flattened observation


def linear_action(params: jax.Array, obs: jax.Array) -> jax.Array:
    """The action, int32, whose linear function ``[A, n]`` of the observation is the highest."""
    return jnp.argmax(params @ obs.reshape(-1).astype(jnp.float32))


def linear_search(obs_shape: tuple[int, ...], num_actions: int) -> Agent:
    """An `Agent` whose hparams are `LinearSearchHParams`: the action is that of the highest of
    ``[A]`` linear functions of the observation ``obs_shape``, whose weights are drawn from a normal
    distribution, anew after every update from episodes whose mean return is not enough.
    """
    check_shape(obs_shape=obs_shape)
    check_counts(num_actions=num_actions)
    shape = num_actions, int(np.prod(obs_shape))

    def init(key: Key, hparams: LinearSearchHParams) -> LinearPolicy:
        return LinearPolicy(jax.random.normal(key, shape))

    def act(state: LinearPolicy, obs: jax.Array, key: Key, hparams: Any) -> jax.Array:
        return linear_action(state.params, obs)

    def update(
        state: LinearPolicy, transitions: Transition, key: Key, hparams: LinearSearchHParams
    ) -> tuple[LinearPolicy, dict[str, jax.Array]]:
        """``loss`` is the mean return with its sign turned."""
        check_transitions(transitions, 2)
        valid = transitions.weights > 0
        total = jnp.where(valid, transitions.reward, 0).sum()
        mean = total / jnp.maximum(valid.any(1).sum(), 1)
        again = valid.any() & (mean < hparams.enough)
        return where(again, init(key, hparams), state), {"loss": -mean.astype(jnp.float32)}

    return Agent(init, act, update, num_actions=num_actions, hparams=LinearSearchHParams)
