"""The parts of a Dyna run on stacked frames, the same for every world that is seen so."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxdyna import frame_replay, memory
from jaxdyna.dyna import Dream, Dyna, DynaHParams, DynaState, Metrics
from jaxdyna.envs import FrameStack, Replayed, ReplayedParams
from jaxdyna.frame_replay import FrameReplay
from jaxdyna.models import LearnedEnvironment, LearnedParams, doubtful, probability_rule
from jaxdyna.models.evaluation import frame_errors
from jaxdyna.types import Agent, DynamicsModel, Environment, Key, Transition


def frame_dyna(
    env: Environment, agent: Agent, model: DynamicsModel,
    watch: Callable[[Transition, Any, Any], Metrics] | None = None,
) -> Dyna:  # fmt: skip
    """Dyna whose dreams begin at any replayed stack of frames, and whose model sees rewards and
    punishments more often than they come.
    """
    learned = LearnedEnvironment(env, model.predict, draw_stack, probability_rule, doubtful)
    kept = memory.frames(lambda rest: jnp.stack([rest["reward"] < 0, rest["reward"] > 0]))
    dream, errors = Dream(learned, learned_params), frame_errors(model.predict)
    return Dyna(env, agent, model, dream, errors, watch, kept)


def learned_params(state: DynaState, hparams: DynaHParams) -> LearnedParams:
    """What a learned environment plays with, out of a run's state."""
    return LearnedParams(
        model=state.model.params,
        start=state.replay,
        termination_threshold=hparams.termination_threshold,
        disagreement_threshold=hparams.disagreement_threshold,
        max_steps=hparams.env.max_steps,
    )


def draw_stack(key: Key, held: FrameReplay) -> jax.Array:
    """Any real observation: four frames of a replayed episode."""
    return frame_replay.sample(held, key, ()).obs


def true_dream(env: FrameStack, read: Callable[[jax.Array, Any, Key], Any]) -> Dream:
    """The oracle's dreams; ``read`` as of `jaxdyna.envs.Replayed`."""

    def params(state: DynaState, hparams: DynaHParams) -> ReplayedParams:
        return ReplayedParams(hparams.env, state.replay, hparams.env.max_steps)

    return Dream(Replayed(env, draw_stack, read), params)
