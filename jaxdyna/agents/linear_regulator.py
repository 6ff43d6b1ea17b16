"""The linear-quadratic regulator of a linear model fitted by least squares: what control theory
tries first (Kalman 1960; that it goes far with a learned model is Dean et al. 2020).

That a small observation is a good one is its own assumption: it never looks at rewards.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxdyna.agents.linear_search import linear_action
from jaxdyna.fields import check_counts, check_shape, setting
from jaxdyna.trees import where
from jaxdyna.types import Agent, Key, Transition, check_transitions


@struct.dataclass
class LinearRegulatorHParams:
    """What can be swept."""

    action_cost: float = setting(
        1.0, "What an action costs beside a squared observation of 1.", above=0
    )
    ridge: float = setting(
        1e-4, "Added to the diagonal of the normal equations: what is not known is 0.", above=0
    )


class LinearModel(NamedTuple):
    """``next_obs = obs + drift @ obs + effect[:, action]``."""

    drift: jax.Array  #: ``[n, n]``: the change of an observation, flattened, whatever is done
    effect: jax.Array  #: ``[n, A]``: the change that each action makes


@struct.dataclass
class LinearRegulator:
    """A model and its policy."""

    #: ``[n + A, n + A]``: the sum over all transitions of the outer product of what the model is
    #: told, the observation and the action as one of ``A``
    inputs: jax.Array
    targets: jax.Array  #: ``[n + A, n]``: likewise with the change of the observation
    model: LinearModel  #: fitted to them
    #: ``[A, n]``: each action's weights of the observation; all 0 before any transition
    params: jax.Array


def least_squares(inputs: jax.Array, targets: jax.Array, ridge: float) -> LinearModel:
    """The linear model of least squared error; ``inputs`` and ``targets`` as in `LinearRegulator`,
    ``ridge`` as in `LinearRegulatorHParams`.
    """
    size = targets.shape[1]
    solved = jnp.linalg.solve(inputs + ridge * _eye(inputs), targets).T
    return LinearModel(solved[:, :size], solved[:, size:])


def regulator(model: LinearModel, action_cost: float, horizon: int) -> jax.Array:
    """The feedback that keeps squared observations, and actions, small over ``horizon`` steps:
    ``[A, n]``, how much of each action, as a linear function of the observation (the discrete
    Riccati equation, backwards from the last step). Of the model only the differences between
    actions count; ``action_cost`` as in `LinearRegulatorHParams`.
    """
    last = _eye(model.drift)
    step = last + model.drift
    push = model.effect - model.effect.mean(1, keepdims=True)

    def feedback(cost: jax.Array) -> jax.Array:
        price = push.T @ cost @ push
        return -jnp.linalg.solve(price + action_cost * _eye(price), push.T @ cost @ step)

    def earlier(_: Any, cost: jax.Array) -> jax.Array:
        return last + step.T @ cost @ (step + push @ feedback(cost))

    return feedback(jax.lax.fori_loop(0, horizon - 1, earlier, last))


def _eye(like: jax.Array) -> jax.Array:
    return jnp.eye(len(like), dtype=like.dtype)


def linear_regulator(obs_shape: tuple[int, ...], num_actions: int, horizon: int = 200) -> Agent:
    """An `Agent` whose hparams are `LinearRegulatorHParams`: random actions in the first episode,
    then that which the regulator wants most of, for a model fitted anew to all real transitions
    after every episode.

    Args:
        obs_shape: of an observation; 0 in all is where it ought to stay.
        num_actions: how many actions there are.
        horizon: steps that the regulator looks ahead; of CartPole 50 and 500 do as well.
    """
    check_shape(obs_shape=obs_shape)
    check_counts(num_actions=num_actions, horizon=horizon)
    size = int(np.prod(obs_shape))

    def init(key: Key, hparams: LinearRegulatorHParams) -> LinearRegulator:
        told, zeros = size + num_actions, partial(jnp.zeros, dtype=jnp.float32)
        model = LinearModel(zeros((size, size)), zeros((size, num_actions)))
        return LinearRegulator(
            zeros((told, told)), zeros((told, size)), model, zeros((num_actions, size))
        )

    def act(state: LinearRegulator, obs: jax.Array, key: Key, hparams: Any) -> jax.Array:
        chosen = act_greedy(state, obs, key, hparams)
        anything = jax.random.randint(key, (), 0, num_actions, chosen.dtype)
        return jnp.where(state.params.any(), chosen, anything)

    def act_greedy(state: LinearRegulator, obs: jax.Array, key: Key, hparams: Any) -> jax.Array:
        return linear_action(state.params, obs)

    def update(
        state: LinearRegulator, transitions: Transition, key: Key, hparams: LinearRegulatorHParams
    ) -> tuple[LinearRegulator, dict[str, jax.Array]]:
        """``loss`` is the mean squared error of the transitions' changes under the new model."""
        check_transitions(transitions, 2)
        steps, weights = transitions.blanked(), transitions.weights.reshape(-1)
        flat = partial(jnp.reshape, shape=(len(weights), size))
        obs, after = (flat(each).astype(jnp.float32) for each in (steps.obs, steps.next_obs))
        done = jax.nn.one_hot(steps.action.reshape(-1), num_actions, dtype=jnp.float32)
        told, change = jnp.concatenate([obs, done], 1), after - obs
        weighted = told.T * weights
        inputs, targets = state.inputs + weighted @ told, state.targets + weighted @ change
        model = least_squares(inputs, targets, jnp.float32(hparams.ridge))
        params = regulator(model, jnp.float32(hparams.action_cost), horizon)
        new = LinearRegulator(inputs, targets, model, params)
        error = change - obs @ model.drift.T - done @ model.effect.T
        loss = (weights[:, None] * error**2).sum() / (size * jnp.maximum(weights.sum(), 1e-6))
        return where((weights > 0).any(), new, state), {"loss": loss}

    return Agent(
        init, act, update, num_actions=num_actions, hparams=LinearRegulatorHParams,
        act_greedy=act_greedy)  # fmt: skip
