"""What a run of `jaxdyna.dyna` is put together from, what it is between two episodes, and whether
its parts fit each other, which is seen by shapes before anything is computed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import chex
import jax
import numpy as np
from flax import struct

from jaxdyna.actions import actions_of, as_actions
from jaxdyna.dyna.config import DynaConfig, DynaHParams
from jaxdyna.fields import SettingError, check_kind
from jaxdyna.replay import memory
from jaxdyna.rollout import Record
from jaxdyna.types import Agent, DynamicsModel, Environment, Key, Memory, Transition, check_part

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
            Dreaming stops once all fake ones were so twice in a row; where the last dreaming ended
            so, neither model nor policy learns of dreams after such a real episode: what works is
            left alone, and costs nothing. None: never.
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
    """A run between two real episodes; arrays only."""

    agent: Any  #: the agent's state
    model: Any  #: the model's state, None without one
    replay: Any  #: real transitions so far; None where they are not kept, or the agent keeps them
    starts: Any  #: first observations of the real episodes so far, None where these are not kept
    dreams_safe: jax.Array  #: whether the last dreaming ended because its fake episodes were safe
    key: Key  #: the random key of all that follows


def check_parts(dyna: Dyna, config: DynaConfig) -> None:
    """Raises `ValueError` where parts are none, or disagree without any hyper-parameters."""
    check_part("env", dyna.env, "reset", "step", "default_params")
    check_part("agent", dyna.agent, "init", "act", "update")
    if dyna.model is not None:
        check_part("model", dyna.model, "init", "predict", "update")
        check_part("memory", dyna.memory, "add", "draw", "take")
    first, episodes = config.num_real_first, config.num_episodes
    if (dyna.dream or dyna.expert) and first > episodes:
        said = f"(N) is {first} but there are only {episodes} episodes: lower N or raise these"
        raise SettingError("num_real_first", said)
    actions, dream = actions_of(dyna.env), dyna.dream and dyna.dream.env
    told: dict[str, Any] = {name: getattr(getattr(dyna, name), "num_actions", None)
                            for name in ("agent", "model")}  # fmt: skip
    if hasattr(dream, "num_actions") or hasattr(dream, "action_space"):
        told["dream"] = actions_of(dream)
    for name, own in told.items():
        if own is not None and as_actions(own) != actions:
            said = f"the {name} has {own} actions and {type(dyna.env).__name__} {actions}"
            raise ValueError(f"{said}: give it {actions}")


def check_hparams(dyna: Dyna, config: DynaConfig, hparams: DynaHParams) -> None:
    """Raises `ValueError` where values of a run, or swept ones of many, are another part's, cannot
    be, or let episodes outlast `DynaConfig.num_steps`; what is traced passes.
    """
    check_kind("hparams", hparams, DynaHParams)
    for name in ("agent", "model"):
        kinds = getattr(getattr(dyna, name), "hparams", None)
        check_kind(f"hparams.{name}", getattr(hparams, name), kinds)
    check_kind("hparams.env", hparams.env, type(dyna.env.default_params))
    longest = hparams.env.max_steps
    if not isinstance(longest, jax.core.Tracer) and np.max(longest) > config.num_steps:
        said = f"is {config.num_steps}, less than max_steps, {np.max(longest)}, of hparams.env"
        raise SettingError("num_steps", f"{said}: raise it, or episodes are cut off there")


def check_shapes(dyna: Dyna, state: DynaState, hparams: DynaHParams) -> None:
    """Raises `ValueError` where the parts of a run before its first episode cannot take, or make,
    each other's arrays.
    """
    wrong = "env cannot be reset: give hparams.env what its reset takes"

    def meet(key: Key) -> None:
        nonlocal wrong
        keys = jax.random.split(key, 4)
        obs, _ = dyna.env.reset(keys[0], hparams.env)
        seen = f"{type(dyna.env).__name__}'s observations, {obs.dtype}{list(obs.shape)}"
        wrong = f"the agent does not take {seen}: make it for these"
        action = dyna.agent.act(state.agent, obs, keys[1], hparams.agent)
        if dyna.model is not None:
            wrong = f"the model does not take, or predict, {seen}: make it for these"
            predicted = dyna.model.predict(state.model.params, obs, action, keys[2])
            chex.assert_equal_shape([predicted.next_obs, obs])
        if dyna.dream is not None:
            wrong = "dreams cannot begin: give Dyna the model, or memory, that Dream.params takes"
            dreamed, _ = dyna.dream.env.reset(keys[3], dyna.dream.params(state, hparams))
            wrong = f"dreams do not begin with {seen}: let them"
            chex.assert_equal_shape([dreamed, obs])

    try:
        jax.eval_shape(meet, state.key)
    except Exception as error:
        raise ValueError(f"{wrong} ({str(error).partition(chr(10))[0]})") from error
