"""The parts of a Dyna run on stacked frames, the same for every world that is seen so."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from jaxdyna import frame_replay, memory
from jaxdyna.dyna import Dream, Dyna, DynaHParams, DynaState, Metrics
from jaxdyna.envs import FrameStack, StackState
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


@struct.dataclass
class ReplayedParams:
    """The environment's own, the real frames to begin at, and the longest episode."""

    env: Any
    start: FrameReplay
    max_steps: int | jax.Array = 200


@dataclass(frozen=True)
class Replayed:
    """The true environment, its episodes beginning at any real stack of frames instead of the
    start: the world of the oracle's dreams.

    Attributes:
        real: the environment, its frames stacked.
        read: ``(stack, key) -> state`` of the environment itself; the key draws what the stack does
            not show.
    """

    real: FrameStack
    read: Callable[[jax.Array, Key], Any]

    @property
    def default_params(self) -> ReplayedParams:
        """Without frames; fill in ``start``."""
        return ReplayedParams(self.real.default_params, start=None)  # type: ignore[arg-type]

    @property
    def num_actions(self) -> int:
        """The environment's."""
        return self.real.num_actions

    @property
    def dream(self) -> Dream:
        """The oracle's dreams."""

        def params(state: DynaState, hparams: DynaHParams) -> ReplayedParams:
            return ReplayedParams(hparams.env, state.replay, hparams.env.max_steps)

        return Dream(self, params)

    def reset(self, key: Key, params: ReplayedParams) -> tuple[jax.Array, StackState]:
        """Draws a real stack and reads the state off it."""
        key_draw, key_read = jax.random.split(key)
        obs = draw_stack(key_draw, params.start)
        return obs, StackState(self.read(obs, key_read), obs)

    def step(
        self, key: Key, state: StackState, action: jax.Array, params: ReplayedParams
    ) -> tuple[jax.Array, StackState, jax.Array, jax.Array, jax.Array, dict[str, Any]]:
        """The environment's."""
        return self.real.step(key, state, action, params.env)

    def observation_space(self, params: ReplayedParams) -> Any:
        """The environment's."""
        return self.real.observation_space(params.env)

    def action_space(self, params: ReplayedParams) -> Any:
        """The environment's."""
        return self.real.action_space(params.env)
