"""Arms with a planner on the learned model (§1.1): it acts, or it shows the agent how to.

``mpc`` and ``mcts``: after the first N real episodes the planner acts, and the model learns on.
``mpc_init`` (Nagabandi et al. 2018): the planner acts in some real episodes, the agent imitates
them, and model-free learning goes on. None of these dreams; CartPole has two more that begin like
``mpc_init``: in ``mpc_init_dyna`` dreams go on, in ``mpc_clone`` nothing does.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxdyna.dyna import Dyna, DynaHParams, DynaState, Expert
from jaxdyna.models import LearnedState
from jaxdyna.planners import Guide, Planner
from jaxdyna.types import Agent, Key

MakeGuide = Callable[[DynaState, DynaHParams, Any], Guide]
"""``(state, hparams, env_params) -> guide``: what the planner is told beside the world."""


def acting(dyna: Dyna, planner: Planner, guide: MakeGuide) -> Dyna:
    """The planner acts in every real episode after the first N."""
    return dyna._replace(dream=None, expert=Expert(on_model(dyna, planner, guide)))


def showing(dyna: Dyna, planner: Planner, guide: MakeGuide, agent: Agent, episodes: int) -> Dyna:
    """The planner acts in so many real episodes after the first N; ``agent`` imitates it. Dreams
    stay: who wants none replaces them.
    """
    return dyna._replace(agent=agent, expert=Expert(on_model(dyna, planner, guide), episodes))


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
