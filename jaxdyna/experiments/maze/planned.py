"""What the Maze's planners are told, and an agent that imitates them.

The goal is 30 steps from the start. A planner without a value must look further ahead than that;
on learned frames that costs seconds a decision, so these look a few steps ahead and take the
agent's values for what comes after: the learner, which is off-policy, learns from what they play.
"""

from dataclasses import replace
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna import agents
from jaxdyna.dyna import Dyna, DynaHParams, DynaState
from jaxdyna.experiments.study.planners import MakeGuide
from jaxdyna.planners import Guide
from jaxdyna.types import Agent


@cache
def by_values(config: agents.DQNConfig) -> MakeGuide:
    """Guides a planner by the values that the agent, or the one that imitates, acts by."""

    def guide(state: DynaState, hparams: DynaHParams, env_params: Any) -> Guide:
        imitates = isinstance(state.agent, agents.CloningState)
        learner = state.agent.agent if imitates else state.agent
        params = learner.target if config.act_by_target else learner.params

        def prior(obs: jax.Array) -> jax.Array:
            return values_of(config, params, obs)

        def value(obs: jax.Array, where: Any, key: Any) -> jax.Array:
            return prior(obs).max() / hparams.agent.reward_scale

        return Guide(prior, value)

    return guide


@cache
def imitator(dyna: Dyna, config: agents.DQNConfig, imitation: agents.CloningConfig) -> Agent:
    """The agent of ``dyna``, which imitates what it is shown."""
    stack = dyna.env.observation_space(dyna.env.default_params).shape
    example = jax.ShapeDtypeStruct(stack, np.uint8), jax.ShapeDtypeStruct((), np.int32)

    def outputs(params: Any, obs: jax.Array) -> jax.Array:
        return values_of(config, params, obs)

    def install(state: agents.DQNState, params: Any) -> agents.DQNState:
        return replace(state, params=params, target=jax.tree.map(jnp.copy, params))

    return agents.cloning(dyna.agent, outputs, example, imitation, install)


def values_of(config: agents.DQNConfig, params: Any, obs: jax.Array) -> jax.Array:
    """Values ``[A]`` of one observation."""
    return agents.q_values(config.network, params, obs[None])[0]
