"""Dreams of Pong in which the true game runs beside the model and shows some of what is seen, where
the question is which object's error does the harm.
"""

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxdyna.dyna import Dream, Dyna, DynaHParams, DynaState
from jaxdyna.envs import Replayed, ReplayedParams, StackState
from jaxdyna.experiments.pong.world import OBJECTS
from jaxdyna.experiments.study.frames import draw_state, with_states
from jaxdyna.models.evaluation import Predict
from jaxdyna.types import Key


@struct.dataclass
class GuidedParams(ReplayedParams):
    """The model's beside."""

    model: Any = None


@dataclass(frozen=True)
class Guided(Replayed):
    """A dream from any real stack of frames with the true game beside it.

    Attributes:
        predict: a model's ``predict``.
        truth: channels of each frame that are the true game's.
    """

    predict: Predict | None = None
    truth: tuple[int, ...] = ()

    def step(self, key: Key, state: StackState, action: jax.Array, params: Any) -> Any:
        """One step of both; the reward is the model's."""
        key_game, key_predict = jax.random.split(key)
        frame, new, _, *ends = super().step(key_game, state, action, params)
        assert self.predict is not None
        said = self.predict(params.model, state.obs, action, key_predict)
        true = np.isin(np.arange(frame.shape[-1]) % len(OBJECTS), self.truth)
        obs = jnp.where(true, frame, said.next_obs)
        return obs, replace(new, obs=obs), said.reward, *ends


@cache
def guided(dyna: Dyna, things: tuple[str, ...]) -> Dyna:
    """Dreams of the same model with these of the true game's objects."""
    env, model = dyna.env, dyna.model
    assert model is not None

    def params(state: DynaState, hparams: DynaHParams) -> GuidedParams:
        return GuidedParams(hparams.env, state.replay, hparams.env.max_steps, state.model.params)

    truth = tuple(OBJECTS[thing] for thing in things)
    dream = Guided(env, draw_state, predict=model.predict, truth=truth)  # type: ignore[arg-type]
    return with_states(dyna)._replace(dream=Dream(dream, params))
