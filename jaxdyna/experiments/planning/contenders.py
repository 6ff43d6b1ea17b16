"""Who decides: a policy, or a planner in the true or the learned environment."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax

from jaxdyna.dyna import Dyna, DynaHParams, DynaState
from jaxdyna.experiments.planning.budgets import Contender
from jaxdyna.experiments.study.planners import MakeGuide, on_model
from jaxdyna.planners import CrossEntropyConfig, Guide, Planner, ShootingConfig, cross_entropy

ROUNDS = 3
"""Of the cross-entropy method."""


def by(which: int, contender: Contender) -> Contender:
    """One who goes by the given one of several states that each run has learned."""

    def act(states: Any, *seen: Any) -> jax.Array:
        return contender.act(states[which], *seen)

    return contender._replace(act=act)


def rounds(config: ShootingConfig) -> Callable[[Any], Planner]:
    """The cross-entropy method with as many sequences in all."""
    candidates = max(config.candidates // ROUNDS, 1)
    elites = max(candidates // 4, 1)
    method = CrossEntropyConfig(
        config.horizon, candidates, config.discount, iterations=ROUNDS, elites=elites
    )
    return partial(cross_entropy, config=method)


def policy(dyna: Dyna, hparams: Any) -> Contender:
    """The forward pass of what a run has learned, with these hparams of the agent."""

    def act(state: DynaState, obs: jax.Array, true_state: Any, key: jax.Array) -> jax.Array:
        return dyna.agent.act(state.agent, obs, key, hparams)

    return Contender("policy", "-", 0, act)


def always(guide: Guide) -> Callable[[DynaState], Guide]:
    """The same whatever a run has learned."""
    return lambda state: guide


def untold(state: DynaState) -> Guide:
    """Nothing of what a run has learned."""
    return Guide()


def in_true(
    who: str,
    env: Any,
    env_params: Any,
    make: Callable[[Any], Planner],
    steps: int,
    told: Callable[[DynaState], Guide],
) -> Contender:
    """A planner in the true environment, from the true state."""
    planner = make(env)

    def act(state: DynaState, obs: jax.Array, true_state: Any, key: jax.Array) -> jax.Array:
        return planner(env_params, obs, true_state, key, told(state)).action

    return Contender(who, "true", steps, act)


def in_model(
    who: str,
    dyna: Dyna,
    hparams: DynaHParams,
    make: Callable[[Any], Planner],
    steps: int,
    guide: MakeGuide,
) -> Contender:
    """A planner in the learned environment, from what is seen."""
    assert dyna.dream is not None
    decide = on_model(dyna, make(dyna.dream.env), guide)

    def act(state: DynaState, obs: jax.Array, true_state: Any, key: jax.Array) -> jax.Array:
        return decide(state, obs, key, hparams)

    return Contender(who, "learned", steps, act)
