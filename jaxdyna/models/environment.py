"""A learned model as an environment: its weights travel in the params slot."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from jaxdyna.envs.maze import enlarge
from jaxdyna.fields import Checked, SettingError, setting
from jaxdyna.types import Environment, Key, Prediction, Stepped


@struct.dataclass
class DreamHParams:
    """What ends a fake episode; can be swept."""

    termination_threshold: float = setting(
        0.5, "Probability of the end above which a fake episode terminates (threshold_rule).",
        at_least=0, at_most=1)  # fmt: skip
    uncertainty_threshold: float = setting(
        math.inf,
        "How uncertain the model may be before a fake episode ends (threshold_rule, uncertain), in "
        "its own units: jaxdyna.types.Prediction.uncertainty.", at_least=0, infinite=True,
    )  # fmt: skip


@struct.dataclass
class LearnedParams:
    """What a learned environment takes in its params slot."""

    model: Any = setting(help="What the model's predict takes: its weights.")
    start: Any = setting(None, "What the function that draws start states takes.")
    hparams: DreamHParams = setting(factory=DreamHParams, help="What ends an episode.")
    max_steps: int = setting(200, "Steps until truncation.", at_least=1)


@struct.dataclass
class LearnedState:
    """The predicted observation ``[*obs]`` and the number of steps taken."""

    obs: jax.Array
    time: jax.Array


def as_observed(predicted: jax.Array, dtype: Any) -> jax.Array:
    """A prediction in the type of observations: whole numbers are the nearest in their range."""
    if not jnp.issubdtype(dtype, jnp.integer):
        return predicted.astype(dtype)
    limits = jnp.iinfo(dtype)
    return jnp.clip(jnp.round(predicted), limits.min, limits.max).astype(dtype)


def threshold_rule(prediction: Prediction, params: LearnedParams, key: Key) -> jax.Array:
    """Terminates where the predicted probability exceeds `DreamHParams.termination_threshold`, and
    where the model is more uncertain than ``uncertainty_threshold``: what is not known is as bad as
    the end (the pessimism of MOReL, Kidambi et al. 2020). A bool scalar, as of every rule here.
    """
    ends = prediction.terminated > params.hparams.termination_threshold
    return ends | (prediction.uncertainty > params.hparams.uncertainty_threshold)


def probability_rule(prediction: Prediction, params: LearnedParams, key: Key) -> jax.Array:
    """Terminates where the predicted probability exceeds `DreamHParams.termination_threshold`."""
    return prediction.terminated > params.hparams.termination_threshold


def uncertain(prediction: Prediction, params: LearnedParams) -> jax.Array:
    """Whether the model is less certain of a prediction than ``uncertainty_threshold`` allows.
    To truncate there keeps dreams to where the model is good and calls it no end; the uncertain
    step is the last (Pan et al. 2020 leave it out as well).
    """
    return prediction.uncertainty > params.hparams.uncertainty_threshold


def never(prediction: Prediction, params: LearnedParams) -> jax.Array:
    """Trusts every prediction."""
    return jnp.bool_(False)


def uniform_start(low: float, high: float) -> Callable[[Key, Any], jax.Array]:
    """Start states whose every entry is uniform in ``[low, high)``; ``params.start`` is an array
    of the observation's shape. `SettingError` where there is nothing between them.
    """
    if not -math.inf < low <= high < math.inf:
        raise SettingError("low", f"is {low} and high {high}: give finite ones, low at most high")

    def start(key: Key, like: jax.Array) -> jax.Array:
        return jax.random.uniform(key, like.shape, like.dtype, minval=low, maxval=high)

    return start


@dataclass(frozen=True)
class LearnedEnvironment(Checked):
    """What a `DynamicsModel` believes, played like any environment.

    Attributes:
        real: the environment it imitates: actions, spaces and the shape of an observation.
        predict: a model's ``predict``.
        start: ``(key, params.start) -> obs``: where fake episodes begin.
        terminates: ``(prediction, params, key) -> bool``: when they end.
        truncates: ``(prediction, params) -> bool``: when they are broken off before
            ``params.max_steps``.
    """

    real: Environment
    predict: Callable[[Any, jax.Array, jax.Array, Key], Prediction]
    start: Callable[[Key, Any], jax.Array]
    terminates: Callable[[Prediction, LearnedParams, Key], jax.Array] = threshold_rule
    truncates: Callable[[Prediction, LearnedParams], jax.Array] = never

    @property
    def default_params(self) -> LearnedParams:
        """Without weights; fill in ``model`` and ``start``."""
        return LearnedParams(model=None, max_steps=self.real.default_params.max_steps)

    @property
    def num_actions(self) -> int:
        return self.real.num_actions  # type: ignore[attr-defined]

    def reset(self, key: Key, params: LearnedParams) -> tuple[jax.Array, LearnedState]:
        """Draws a start state."""
        obs = self.start(key, params.start)
        return obs, self.state_of(obs)

    def state_of(self, obs: jax.Array) -> LearnedState:
        """The state that is seen as ``obs [*obs]`` when an episode starts."""
        return LearnedState(obs, time=jnp.int32(0))

    def step(
        self, key: Key, state: LearnedState, action: jax.Array, params: LearnedParams
    ) -> Stepped:
        """One predicted step; ``info["prediction"]`` is the whole `Prediction`."""
        key_predict, key_end = jax.random.split(key)
        prediction = self.predict(params.model, state.obs, action, key_predict)
        next_obs = as_observed(prediction.next_obs, state.obs.dtype)
        state = LearnedState(next_obs, state.time + 1)
        terminated = self.terminates(prediction, params, key_end)
        truncated = (state.time >= params.max_steps) | self.truncates(prediction, params)
        truncated = truncated & jnp.logical_not(terminated)
        info = {"prediction": prediction}
        return state.obs, state, prediction.reward, terminated, truncated, info

    def render(self, state: LearnedState, params: LearnedParams) -> jax.Array:
        """Of a stack its newest frame, enlarged; else the real environment's frame of the state
        that is seen so, by its ``state_of(obs)``. Bytes ``[height, width, 3]``.
        """
        real: Any = self.real
        count = getattr(real, "num_frames", None)
        newest = state.obs[..., -(state.obs.shape[-1] // (count or 1)) :]
        if state.obs.ndim != 3:
            world = real.env if count else real
            return world.render(world.state_of(newest), world.default_params)
        frame = jnp.broadcast_to(newest, (*newest.shape[:2], 3))
        return enlarge(frame, max(1, 256 // max(frame.shape)))

    def observation_space(self, params: LearnedParams) -> Any:
        return self.real.observation_space(self.real.default_params)

    def action_space(self, params: LearnedParams) -> Any:
        return self.real.action_space(self.real.default_params)
