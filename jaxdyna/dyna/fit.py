"""Whether the parts of a run fit each other: seen by shapes, before anything is computed."""

from __future__ import annotations

import chex
import jax
import numpy as np

from jaxdyna.dyna.config import DynaConfig, DynaHParams
from jaxdyna.dyna.parts import Dyna, DynaState
from jaxdyna.fields import SettingError, check_kind
from jaxdyna.types import Key, check_part


def check_parts(dyna: Dyna, config: DynaConfig) -> None:
    """Raises `ValueError` where parts are none, or disagree without any hyper-parameters."""
    check_part("env", dyna.env, "reset", "step", "num_actions")
    check_part("agent", dyna.agent, "init", "act", "update")
    if dyna.model is not None:
        check_part("model", dyna.model, "init", "predict", "update")
        check_part("memory", dyna.memory, "add", "draw", "take")
    first, episodes = config.num_real_first, config.num_episodes
    if (dyna.dream or dyna.expert) and first > episodes:
        said = f"(N) is {first} but there are only {episodes} episodes: lower N or raise these"
        raise SettingError("num_real_first", said)
    count, dream = dyna.env.num_actions, dyna.dream and dyna.dream.env
    for name, part in (("agent", dyna.agent), ("model", dyna.model), ("dream", dream)):
        own = getattr(part, "num_actions", None)
        if own not in (None, count):
            world = type(dyna.env).__name__
            raise ValueError(f"the {name} has {own} actions and {world} {count}: give it {count}")


def check_hparams(dyna: Dyna, config: DynaConfig, hparams: DynaHParams) -> None:
    """Raises `ValueError` where values of a run, or swept ones of many, are another part's, cannot
    be, or let episodes outlast `DynaConfig.num_steps`; what is traced passes.
    """
    check_kind("hparams", hparams, DynaHParams)
    check_kind("hparams.agent", hparams.agent, dyna.agent.hparams)
    check_kind("hparams.model", hparams.model, dyna.model and dyna.model.hparams)
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
