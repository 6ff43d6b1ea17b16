"""The parts of a run on stacked frames, the same for every world that is seen so."""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxdyna.agents import real_memory
from jaxdyna.dyna.config import DynaHParams
from jaxdyna.dyna.parts import Dream, Dyna, DynaState, Metrics
from jaxdyna.envs import Replayed, ReplayedParams, StackState
from jaxdyna.models import LearnedEnvironment, LearnedParams, probability_rule, uncertain
from jaxdyna.models.evaluation import frame_errors
from jaxdyna.replay import frames as frame_replay
from jaxdyna.replay import memory
from jaxdyna.replay.frames import FrameReplay
from jaxdyna.types import Agent, DynamicsModel, Environment, Key, Transition


class Recorded(NamedTuple):
    """Of a step: the environment's state before it, below the stack, and what it says of it."""

    state: Any
    info: dict[str, jax.Array]


def frame_dyna(
    env: Environment, agent: Agent, model: DynamicsModel,
    watch: Callable[[Transition, Recorded, Any], Metrics] | None = None,
    shared: Callable[[Any], FrameReplay] | None = real_memory, first: bool = False,
) -> Dyna:  # fmt: skip
    """Dyna whose dreams begin at any replayed stack of frames, or at any ``first`` one of a real
    episode, and whose model sees rewards and punishments more often than they come. Both come from
    the agent's own replay, where ``shared`` finds it in the agent's state; None: from one of the
    run's own.
    """
    kept = memory.frames(_rewarded, shared=shared)

    def params(state: DynaState, hparams: DynaHParams) -> LearnedParams:
        return learned_params(state, hparams, kept.of(state))

    def record(state: StackState, after: StackState, info: dict[str, jax.Array]) -> Recorded:
        return Recorded(state.env, info)

    start = draw_first_stack if first else draw_stack
    learned = LearnedEnvironment(env, model.predict, start, probability_rule, uncertain)
    dream, errors = Dream(learned, params), frame_errors(model.predict)
    return Dyna(env, agent, model, dream, errors, watch, kept, record=record)


@cache
def true_dyna(dyna: Dyna, first: bool = False) -> Dyna:
    """The oracle's parts: dreams in the true environment, from states that are remembered beside
    the frames, for ``first`` see `frame_dyna`.
    """
    env: Any = dyna.env
    draw = draw_first_state if first else draw_state

    def params(state: DynaState, hparams: DynaHParams) -> ReplayedParams:
        return ReplayedParams(hparams.env, state.replay, hparams.env.max_steps)

    return with_states(dyna)._replace(dream=Dream(Replayed(env, draw), params))


@cache
def with_states(dyna: Dyna) -> Dyna:
    """With a replay in which states lie beside the frames, for `draw_state`."""
    return dyna._replace(memory=memory.frames(_rewarded, keep=lambda recorded: recorded.state))


def learned_params(state: DynaState, hparams: DynaHParams, start: Any) -> LearnedParams:
    """What a learned environment plays with, out of a run's state and where dreams start."""
    return LearnedParams(
        model=state.model.params,
        start=start,
        hparams=hparams.dream,
        max_steps=hparams.env.max_steps,
    )


def draw_stack(key: Key, held: FrameReplay) -> jax.Array:
    """Any real observation: four frames of a replayed episode."""
    return frame_replay.sample(held, key, ()).obs


def draw_first_stack(key: Key, held: FrameReplay) -> jax.Array:
    """The first observation of any replayed episode."""
    return frame_replay.sample(held, key, (), _first(held)).obs


def draw_state(key: Key, held: FrameReplay) -> tuple[jax.Array, Any]:
    """As `draw_stack`, and the environment's state there."""
    return _with_state(held, frame_replay.draw_numbers(held, key, ()))


def draw_first_state(key: Key, held: FrameReplay) -> tuple[jax.Array, Any]:
    """As `draw_first_stack`, likewise."""
    return _with_state(held, frame_replay.draw_numbers(held, key, (), _first(held)))


def _with_state(held: FrameReplay, number: jax.Array) -> tuple[jax.Array, Any]:
    return frame_replay.take(held, number).obs, frame_replay.take_beside(held, number)


def _first(held: FrameReplay) -> jax.Array:
    return (held.held & (held.time == 0)).astype(jnp.float32)


def _rewarded(rest: dict[str, jax.Array]) -> jax.Array:
    return jnp.stack([rest["reward"] < 0, rest["reward"] > 0])
