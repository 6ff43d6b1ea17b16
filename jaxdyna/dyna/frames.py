"""The parts of a run on stacked frames, the same for every world that is seen so, and for those
that are seen as vectors, which are frames of one axis.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxdyna.actions import actions_of, number_of
from jaxdyna.agents import ReinforceConfig, dqn, real_memory, reinforce
from jaxdyna.dyna.config import DynaHParams
from jaxdyna.dyna.parts import Dream, Dyna, DynaState, Metrics
from jaxdyna.envs import FrameStack, Replayed, ReplayedParams, StackState
from jaxdyna.models import (
    LearnedEnvironment,
    LearnedParams,
    PixelConfig,
    pixels,
    probability_rule,
    supervised,
    uncertain,
)
from jaxdyna.models.evaluation import change_error, frame_errors
from jaxdyna.replay import frames as frame_replay, memory
from jaxdyna.replay.frames import FrameReplay
from jaxdyna.types import Agent, DynamicsModel, Key, Transition


def rewarded(rest: dict[str, jax.Array]) -> jax.Array:
    """Which transitions of a `FrameReplay` cost or earn something, bool ``[2, capacity]``."""
    return jnp.stack([rest["reward"] < 0, rest["reward"] > 0])


def ended(rest: dict[str, jax.Array]) -> jax.Array:
    """Which end an episode, and of the others which cost or earn something, ``[3, capacity]``."""
    over = rest["terminated"]
    return jnp.concatenate([over[None], rewarded(rest) & ~over])


class Recorded(NamedTuple):
    """Of a step: the environment's state before it, below the stack, and what it says of it."""

    state: Any
    info: dict[str, jax.Array]


def frame_dyna(
    env: FrameStack, agent: Agent, model: DynamicsModel,
    watch: Callable[[Transition, Recorded, Any], Metrics] | None = None,
    shared: Callable[[Any], FrameReplay] | None = real_memory, first: bool = False,
    rare: Callable[[dict[str, jax.Array]], jax.Array] = rewarded,
) -> Dyna:  # fmt: skip
    """Dyna whose dreams begin at any replayed stack of frames, or at any ``first`` one of a real
    episode, and whose model sees what is ``rare`` more often than it comes. Both come from the
    agent's own replay, where ``shared`` finds it in the agent's state; None: from one of the run's
    own.
    """
    kept = memory.frames(rare, env.num_frames, shared=shared)

    def params(state: DynaState, hparams: DynaHParams) -> LearnedParams:
        return learned_params(state, hparams, kept.of(state))

    def record(state: StackState, after: StackState, info: dict[str, jax.Array]) -> Recorded:
        return Recorded(state.env, info)

    start = draw_first_stack if first else draw_stack
    learned = LearnedEnvironment(env, model.predict, start, probability_rule, uncertain)
    pictures = len(env.observation_space(env.default_params).shape) == 3
    errors = frame_errors if pictures else change_error
    dream, judge = Dream(learned, params), errors(model.predict)
    return Dyna(env, agent, model, dream, judge, watch, kept, record=record)


@cache
def parts(env: FrameStack, agent: Any, model: Any) -> Dyna:
    """The parts of ``dyna`` by the settings of its agent and its model; one object, and so one
    program, for the same. Where REINFORCE acts, which remembers nothing, dreams begin where real
    episodes did.

    Args:
        env: frames, or vectors, stacked; where its actions are a Box, vectors and REINFORCE.
        agent: a `DQNConfig` or a `ReinforceConfig`.
        model: a `PixelConfig` of frames, a `SupervisedConfig` of vectors.
    """
    count, actions = env.num_frames, actions_of(env)
    shape = env.env.observation_space(env.default_params).shape
    stack = env.observation_space(env.default_params).shape
    if isinstance(model, PixelConfig):
        number = number_of(actions, "the model of frames", "let the world be seen as vectors")
        learned, rare = pixels(shape, number, model, count), rewarded
    else:
        learned, rare = supervised(stack[0], actions, model), ended
    if isinstance(agent, ReinforceConfig):
        policy = reinforce(stack, actions, agent)
        return frame_dyna(env, policy, learned, shared=None, first=True, rare=rare)
    number = number_of(actions, "a DQN", "let REINFORCE act")
    return frame_dyna(env, dqn(shape, number, agent, count), learned, rare=rare)


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
    env: Any = dyna.env
    kept = memory.frames(rewarded, env.num_frames, keep=lambda recorded: recorded.state)
    return dyna._replace(memory=kept)


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
