"""Whether the parts of a run fit each other: seen by shapes, before anything is computed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna.dyna.config import DynaConfig, DynaHParams
from jaxdyna.dyna.parts import Dyna, DynaState
from jaxdyna.fields import SettingError, check_like, why
from jaxdyna.types import check_part


def check_parts(dyna: Dyna, config: DynaConfig) -> None:
    """Checks what is known without hyper-parameters.

    Raises:
        ValueError: where parts are none, dreams or an expert would wait for more episodes than
            there are, a model has no memory to learn from, or numbers of actions differ.
    """
    if not isinstance(dyna, Dyna) or not isinstance(config, DynaConfig):
        kinds = f"{type(dyna).__name__} and {type(config).__name__}"
        raise ValueError(f"a run is made of a Dyna and a DynaConfig, not of {kinds}: give these")
    check_part("env", dyna.env, "reset", "step", "num_actions")
    check_part("agent", dyna.agent, "init", "act", "update")
    if dyna.model is not None:
        check_part("model", dyna.model, "init", "predict", "update")
        if dyna.memory is None:
            raise ValueError("memory is None, but the model learns from it: give Dyna a memory")
    first, episodes = config.num_real_first, config.num_episodes
    if (dyna.dream or dyna.expert) and first > episodes:
        said = f"(N) is {first} but there are only {episodes} episodes: lower N or raise these"
        raise SettingError("num_real_first", said)
    count, world = dyna.env.num_actions, type(dyna.env).__name__
    dream = dyna.dream and dyna.dream.env
    for name, part in (("agent", dyna.agent), ("model", dyna.model), ("dream", dream)):
        own = getattr(part, "num_actions", None)
        if own not in (None, count):
            raise ValueError(
                f"the {name} has {own} actions and {world} {count}: make it for {count}"
            )


def check_hparams(dyna: Dyna, config: DynaConfig, hparams: DynaHParams) -> None:
    """Checks a run's values, or the swept ones of many; not what is traced.

    Raises:
        ValueError: where they are another part's, cannot be, or let episodes last longer than
            `DynaConfig.num_steps`.
    """
    if not isinstance(hparams, DynaHParams):
        raise ValueError(f"hparams is a {type(hparams).__name__}: give a DynaHParams")
    check_like("hparams", hparams, hparams)
    for name in ("agent", "model"):
        kinds, given = getattr(getattr(dyna, name), "hparams", None), getattr(hparams, name)
        if kinds is not None and not isinstance(given, kinds):
            names = [kind.__name__ for kind in (kinds if isinstance(kinds, tuple) else (kinds,))]
            said = f"is a {type(given).__name__}: give a {' or '.join(names)}"
            raise SettingError(f"hparams.{name}", said)
    check_like("hparams.env", hparams.env, getattr(dyna.env, "default_params", None))
    longest = getattr(hparams.env, "max_steps", 0)
    if not isinstance(longest, jax.core.Tracer) and np.max(longest) > config.num_steps:
        said = (
            f"is {config.num_steps}, but hparams.env.max_steps {np.max(longest)}: every episode "
            "would be cut off there; raise the one, or lower the other"
        )
        raise SettingError("num_steps", said)


def check_shapes(dyna: Dyna, state: DynaState, hparams: DynaHParams) -> None:
    """Checks what the parts make of each other's arrays, by their shapes alone.

    Args:
        dyna: the parts.
        state: of a run before its first episode.
        hparams: its values.

    Raises:
        ValueError: naming the first part that does not fit.
    """

    def made(what: str, function: Callable, *given: Any) -> Any:
        try:
            return jax.eval_shape(function, *given)
        except Exception as error:
            raise ValueError(f"{what}: {why(error)}") from error

    key, world = jax.eval_shape(jax.random.clone, state.key), type(dyna.env).__name__
    start = f"{world} cannot be reset with hparams.env, mend one of them"
    obs, _ = made(start, dyna.env.reset, key, hparams.env)
    seen, agent, model = f"observations {_named(obs)} of {world}", dyna.agent, dyna.model
    action = made(
        f"the agent does not fit {seen}, make it for these",
        agent.act, state.agent, obs, key, hparams.agent,
    )  # fmt: skip
    if model is not None:
        wrong = f"the model does not fit {seen}, make it for these"
        predicted = made(wrong, model.predict, state.model.params, obs, action, key)
        if predicted.next_obs.shape != obs.shape:
            raise ValueError(f"{wrong}: it predicts {_named(predicted.next_obs)}")
    if dyna.dream is not None:
        lacking = [name for name in ("model", "replay", "starts") if getattr(state, name) is None]
        wrong = f"dreams cannot begin (the run keeps no {' and no '.join(lacking) or 'more'})"
        wrong += ", give Dyna what Dream.params reads, such as a model or a memory"
        params = made(wrong, dyna.dream.params, state, hparams)
        dreamed, _ = made(wrong, dyna.dream.env.reset, key, params)
        if _named(dreamed) != _named(obs):
            raise ValueError(f"dreams begin with observations {_named(dreamed)}, give them {seen}")


def _named(array: Any) -> str:
    return f"{jnp.result_type(array)}{list(array.shape)}"
