"""CartPole's planner arms: random shooting or tree search on the model, and imitation of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any

import jax
import numpy as np

from jaxdyna.agents import CloningConfig, ReinforceConfig, cloning, policy_logits, reinforce
from jaxdyna.dyna import Dyna, DynaHParams, DynaState
from jaxdyna.experiments.cartpole_options import Options, dyna_config
from jaxdyna.experiments.planner_arms import acting, showing, without_guide
from jaxdyna.experiments.run import Arm
from jaxdyna.planners import (
    Guide,
    SearchConfig,
    ShootingConfig,
    muzero,
    random_shooting,
    rollout_value,
)


def planner_arms(
    options: Options, dyna: Dyna, hparams: DynaHParams
) -> dict[str, Callable[[], Arm]]:
    """What makes each planner arm, by name, from the parts of the ``dyna`` arm."""
    config = replace(dyna_config(options), dream_updates=0)

    def arm(make: Callable[[], Dyna]) -> Callable[[], Arm]:
        return lambda: Arm(make(), config, hparams)

    shown = (options.mpc, options.agent, options.cloning, options.shown_episodes)
    late = replace(hparams, num_real_first=options.real_first + options.shown_episodes)
    return {
        "mpc": arm(partial(mpc, dyna, options.mpc)),
        "mcts": arm(partial(mcts, dyna, options.mcts, options.mcts_rollout)),
        "mpc_init": arm(partial(mpc_init, dyna, *shown)),
        "mpc_init_dyna": lambda: Arm(mpc_shows(dyna, *shown), dyna_config(options), late),
        "mpc_clone": arm(partial(mpc_clone, dyna, *shown)),
    }


@cache
def mpc(dyna: Dyna, config: ShootingConfig) -> Dyna:
    """Random shooting acts."""
    return acting(resting(dyna), random_shooting(world(dyna), config), without_guide)


@cache
def mcts(dyna: Dyna, config: SearchConfig, rollout_steps: int) -> Dyna:
    """Tree search acts; a leaf is worth what a random episode from it earns in the model."""
    guide = random_episodes(dyna, config.discount, rollout_steps)
    return acting(resting(dyna), muzero(world(dyna), config), guide)


@cache
def mpc_shows(
    dyna: Dyna,
    config: ShootingConfig,
    agent: ReinforceConfig,
    imitation: CloningConfig,
    episodes: int,
) -> Dyna:
    """Random shooting shows the policy what to do; ``dyna`` goes on."""
    num_actions = dyna.env.num_actions
    example = (jax.ShapeDtypeStruct((4,), np.float32), jax.ShapeDtypeStruct((), np.int32))
    logits = policy_logits(num_actions, agent)
    imitator = cloning(reinforce((4,), num_actions, agent), logits, example, imitation)
    planner = random_shooting(world(dyna), config)
    return showing(dyna, planner, without_guide, imitator, episodes)


@cache
def mpc_init(dyna: Dyna, *shown: Any) -> Dyna:
    """As `mpc_shows`; model-free learning goes on."""
    return mpc_shows(dyna, *shown)._replace(dream=None)


@cache
def mpc_clone(dyna: Dyna, *shown: Any) -> Dyna:
    """As `mpc_shows`; the policy stays as it is from then on."""
    imitator = mpc_shows(dyna, *shown)
    agent = imitator.agent._replace(update=learn_nothing)
    return imitator._replace(dream=None, agent=agent)


def world(dyna: Dyna) -> Any:
    """The environment that ``dyna`` dreams in."""
    assert dyna.dream is not None
    return dyna.dream.env


def random_episodes(dyna: Dyna, discount: float, steps: int) -> Any:
    """Guides a planner by random episodes in the model."""

    def guide(state: DynaState, hparams: DynaHParams, env_params: Any) -> Guide:
        return Guide(value=rollout_value(world(dyna), env_params, steps, discount))

    return guide


def resting(dyna: Dyna) -> Dyna:
    """With an agent that learns nothing from the episodes that a planner plays."""

    return dyna._replace(agent=dyna.agent._replace(update_expert=learn_nothing))


def learn_nothing(state: Any, transitions: Any, key: Any, hparams: Any) -> tuple[Any, Any]:
    """An agent's update that leaves it as it is."""
    return state, {"loss": jax.numpy.float32(0)}
