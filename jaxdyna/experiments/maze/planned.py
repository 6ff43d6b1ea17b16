"""The planner arms: shooting or tree search on the learned frames, and imitation of it.

The goal is 30 steps from the start. A planner without a value must look further ahead than that;
on learned frames that costs seconds a decision, so these look a few steps ahead and take the
agent's values for what comes after: the learner, which is off-policy, learns from what they play.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna.agents import CloningConfig, DQNConfig, DQNState, cloning, q_values
from jaxdyna.dyna import Dyna, DynaHParams, DynaState
from jaxdyna.experiments.maze.options import MazeOptions
from jaxdyna.experiments.study.planners import acting, showing
from jaxdyna.planners import Guide, SearchConfig, ShootingConfig, muzero, random_shooting


def planned(options: MazeOptions, dyna: Dyna, agent: DQNConfig) -> dict[str, Callable[[], Dyna]]:
    """What makes the parts of each planner arm, by name, from those of ``dyna``."""
    shown = options.cloning, options.shown_episodes
    return {
        "mpc": partial(mpc, dyna, agent, options.mpc),
        "mcts": partial(mcts, dyna, agent, options.mcts),
        "mpc_init": partial(mpc_init, dyna, agent, options.mpc, *shown),
    }


@cache
def mpc(dyna: Dyna, agent: DQNConfig, config: ShootingConfig) -> Dyna:
    """Random shooting acts; the agent learns from it."""
    return acting(dyna, random_shooting(_world(dyna), config), by_values(agent))


@cache
def mcts(dyna: Dyna, agent: DQNConfig, config: SearchConfig) -> Dyna:
    """Tree search acts, the agent's values for log odds; the agent learns from it."""
    return acting(dyna, muzero(_world(dyna), config), by_values(agent))


@cache
def mpc_init(
    dyna: Dyna, agent: DQNConfig, config: ShootingConfig, imitation: CloningConfig, episodes: int
) -> Dyna:
    """Random shooting shows the agent what to do."""
    env = dyna.env
    stack = env.observation_space(env.default_params).shape
    example = jax.ShapeDtypeStruct(stack, np.uint8), jax.ShapeDtypeStruct((), np.int32)
    imitator = cloning(dyna.agent, partial(_one, agent), example, imitation, _install)

    def guide(state: DynaState, hparams: DynaHParams, env_params: Any) -> Guide:
        inner = replace(state, agent=state.agent.agent)
        return by_values(agent)(inner, hparams, env_params)

    planner = random_shooting(_world(dyna), config)
    return showing(dyna, planner, guide, imitator, episodes)._replace(dream=None)


def by_values(agent: DQNConfig) -> Callable[[DynaState, DynaHParams, Any], Guide]:
    """Guides a planner by the values that the agent acts by."""

    def guide(state: DynaState, hparams: DynaHParams, env_params: Any) -> Guide:
        learner = state.agent
        params = learner.target if agent.act_by_target else learner.params

        def prior(obs: jax.Array) -> jax.Array:
            return _one(agent, params, obs)

        def value(obs: jax.Array, where: Any, key: Any) -> jax.Array:
            return _one(agent, params, obs).max() / hparams.agent.reward_scale

        return Guide(prior, value)

    return guide


def _one(agent: DQNConfig, params: Any, obs: jax.Array) -> jax.Array:
    """Values ``[A]`` of one observation."""
    return q_values(agent.network, params, obs[None])[0]


def _install(state: DQNState, params: Any) -> DQNState:
    return replace(state, params=params, target=jax.tree.map(jnp.copy, params))


def _world(dyna: Dyna) -> Any:
    assert dyna.dream is not None
    return dyna.dream.env
