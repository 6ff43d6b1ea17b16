"""What a run of `jaxdyna.dyna` is put together from, and what it is between two episodes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
from flax import struct

from jaxdyna.dyna.config import DynaConfig, DynaHParams
from jaxdyna.replay import memory
from jaxdyna.rollout import Record
from jaxdyna.types import Agent, DynamicsModel, Environment, Key, Memory, Transition

Metrics = dict[str, jax.Array]


class Dream(NamedTuple):
    """The world that fake episodes are played in.

    Attributes:
        env: a learned environment, or for the oracle the true one.
        params: ``(state, hparams) -> env_params`` from the run's `DynaState`.
    """

    env: Environment
    params: Callable[[DynaState, DynaHParams], Any]


class Expert(NamedTuple):
    """Who acts in real episodes in the agent's place, such as a planner in the learned model.

    Attributes:
        act: ``(state, obs, key, hparams) -> action`` from the run's `DynaState`: it sees the model.
        episodes: real episodes that it plays, after the first N that gather the model's first data;
            None: all that follow.
    """

    act: Callable[[DynaState, jax.Array, Key, DynaHParams], jax.Array]
    episodes: int | None = None

    def plays(self, episode: jax.Array, config: DynaConfig) -> jax.Array:
        """Whether the real episode numbered ``episode`` (from 0) is its own."""
        after = episode - config.num_real_first
        last = config.num_episodes if self.episodes is None else self.episodes
        return (after >= 0) & (after < last)


class Dyna(NamedTuple):
    """The parts. Without ``model`` nothing is learned of the world; without ``dream`` the arm is
    model-free.

    Attributes:
        env: the real environment.
        agent: who acts.
        model: what is learned of the world, None where nothing is.
        dream: where fake episodes are played.
        diagnose: ``(model_params, transitions, key) -> metrics``: judges the model on real
            episodes ``[N, T]`` that it has not been trained on yet.
        watch: ``(transitions, recorded, env_params) -> metrics`` of real episodes ``[N, T]`` and
            what was recorded of their steps.
        memory: how real transitions are kept for model and dreams; None: not at all.
        expert: who acts in some of the real episodes instead of the agent; None: no one.
        record: see `jaxdyna.rollout.rollout`, of the real episodes.
        safe: ``episodes [N, T] -> bool``: whether they are as good as can be, such as `survived`.
            After such a real episode neither model nor policy learns of dreams, and dreaming stops
            after such fake ones: what works is left alone, and costs nothing. None: never.
    """

    env: Environment
    agent: Agent
    model: DynamicsModel | None = None
    dream: Dream | None = None
    diagnose: Callable[[Any, Transition, Key], Metrics] | None = None
    watch: Callable[[Transition, Any, Any], Metrics] | None = None
    memory: Memory | None = memory.transitions()
    expert: Expert | None = None
    record: Record | None = None
    safe: Callable[[Transition], jax.Array] | None = None


def survived(episodes: Transition) -> jax.Array:
    """None terminated: for tasks whose end is a failure."""
    return ~episodes.terminated.any()


@struct.dataclass
class DynaState:
    """A run between two real episodes; arrays only.

    Attributes:
        agent: the agent's state.
        model: the model's state, None without one.
        replay: real transitions so far; None where they are not kept, or the agent keeps them.
        starts: first observations of the real episodes so far, None where these are not kept.
        key: the random key of all that follows.
    """

    agent: Any
    model: Any
    replay: Any
    starts: Any
    key: Key
