"""The Maze's planner arms: shooting or tree search on the learned frames, and imitation of it.

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

from jaxdyna.agents import CloningConfig, DQNConfig, DQNState, cloning, dqn, q_values
from jaxdyna.agents.cloning import margin_loss
from jaxdyna.dyna import Dyna, DynaHParams, DynaState
from jaxdyna.experiments.maze_train_options import Options, agent_config, dyna_config
from jaxdyna.experiments.planner_arms import acting, showing
from jaxdyna.experiments.run import Arm
from jaxdyna.planners import Guide, SearchConfig, ShootingConfig, muzero, random_shooting


def planner_arms(
    options: Options, dyna: Dyna, hparams: DynaHParams
) -> dict[str, Callable[[], Arm]]:
    """What makes each planner arm, by name, from the parts of the ``dyna`` arm."""
    config, agent = replace(dyna_config(options), dream_updates=0), agent_config(options)
    discount = options.hparams.agent.discount
    shooting = replace(options.mpc, discount=discount)
    search = replace(options.mcts, discount=discount)
    capacity = options.shown_episodes * options.steps
    imitation = replace(options.cloning, capacity=capacity, learns_too=True, loss=margin_loss)

    def arm(make: Callable[[], Dyna]) -> Callable[[], Arm]:
        return lambda: Arm(make(), config, hparams)

    shown = (options.size, imitation, options.shown_episodes)
    return {
        "mpc": arm(partial(mpc, dyna, agent, shooting)),
        "mcts": arm(partial(mcts, dyna, agent, search)),
        "mpc_init": arm(partial(mpc_init, dyna, agent, shooting, *shown)),
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
    dyna: Dyna,
    agent: DQNConfig,
    config: ShootingConfig,
    size: int,
    imitation: CloningConfig,
    episodes: int,
) -> Dyna:
    """Random shooting shows the agent what to do."""
    learner = dqn((size, size, 3), dyna.env.num_actions, agent)
    example = (
        jax.ShapeDtypeStruct((size, size, 12), np.uint8),
        jax.ShapeDtypeStruct((), np.int32),
    )
    imitator = cloning(learner, partial(_one, agent), example, imitation, _install)
    planner = random_shooting(_world(dyna), config)

    def guide(state: DynaState, hparams: DynaHParams, env_params: Any) -> Guide:
        inner = replace(state, agent=state.agent.agent)
        return by_values(agent)(inner, hparams, env_params)

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
