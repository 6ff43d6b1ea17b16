"""Planners on the learned model as experts (§1.1): one acts after the first N real episodes, or it
acts in some of them, which the agent imitates (Nagabandi et al. 2018).
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp

from jaxdyna.agents import CloningState, DQNConfig, q_values
from jaxdyna.dyna.config import DynaHParams
from jaxdyna.dyna.parts import Dyna, DynaState, Expert
from jaxdyna.models import LearnedState
from jaxdyna.planners import Guide, Planner, rollout_value
from jaxdyna.types import Key

MakeGuide = Callable[[DynaState, DynaHParams, Any], Guide]
"""``(state, hparams, env_params) -> guide``: what the planner is told beside the world."""
MakePlanner = Callable[[Any, Any], Planner]
"""``(env, config) -> planner``, such as `jaxdyna.planners.random_shooting`."""


@cache
def acting(
    dyna: Dyna, make: MakePlanner, config: Any, guide: MakeGuide, episodes: int | None = None
) -> Dyna:
    """``dyna`` where a planner in the world of its dreams acts in every real episode after the
    first N, or in so many of them. One object, and so one program, for the same parts.
    """
    assert dyna.dream is not None
    planner = make(dyna.dream.env, config)
    return dyna._replace(expert=Expert(on_model(dyna, planner, guide), episodes))


def on_model(dyna: Dyna, planner: Planner, guide: MakeGuide) -> Callable[..., jax.Array]:
    """`jaxdyna.dyna.Expert.act`: the planner in the world of the dreams of ``dyna``, from what is
    seen in the real one.
    """
    world = dyna.dream
    assert world is not None

    def act(state: DynaState, obs: jax.Array, key: Key, hparams: DynaHParams) -> jax.Array:
        env_params = world.params(state, hparams)
        start = LearnedState(obs, time=jnp.int32(0))
        return planner(env_params, obs, start, key, guide(state, hparams, env_params)).action

    return act


def without_guide(state: DynaState, hparams: DynaHParams, env_params: Any) -> Guide:
    """The world is all that the planner is told."""
    return Guide()


@cache
def random_episodes(env: Any, discount: float, steps: int) -> MakeGuide:
    """What is looked at last is worth what a random episode from it earns in ``env``."""
    return lambda state, hparams, params: Guide(value=rollout_value(env, params, steps, discount))


@cache
def by_values(config: DQNConfig) -> MakeGuide:
    """What is looked at last is worth the values by which a DQN acts, or one that imitates."""

    def guide(state: DynaState, hparams: DynaHParams, env_params: Any) -> Guide:
        imitates = isinstance(state.agent, CloningState)
        learner = state.agent.agent if imitates else state.agent
        params = learner.target if config.act_by_target else learner.params

        def prior(obs: jax.Array) -> jax.Array:
            return q_values(config.network, params, obs[None])[0]

        def value(obs: jax.Array, where: Any, key: Any) -> jax.Array:
            return prior(obs).max() / hparams.agent.reward_scale

        return Guide(prior, value)

    return guide
