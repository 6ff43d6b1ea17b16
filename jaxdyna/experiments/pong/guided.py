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
from jaxdyna.dyna.frames import draw_state, with_states
from jaxdyna.envs import CHANNELS, Palette, Replayed, ReplayedParams, StackState
from jaxdyna.envs.pong_screen import in_channels, mixture_of, shares_of
from jaxdyna.experiments.pong.world import OBJECTS
from jaxdyna.models.evaluation import Predict
from jaxdyna.types import Key


@struct.dataclass
class GuidedParams(ReplayedParams):
    """The model's beside."""

    model: Any = None


@dataclass(frozen=True)
class Guided(Replayed):
    """A dream from any real stack of frames with the true game beside it."""

    predict: Predict | None = None  #: a model's ``predict``
    #: channels of each frame, seen an object a channel, that are the true game's
    truth: tuple[int, ...] = ()
    #: the colours in which it is seen. Where they are the game's own, a predicted pixel is taken
    #: for a mixture of the background and one object (`shares_of`).
    palette: Palette = CHANNELS

    def step(self, key: Key, state: StackState, action: jax.Array, params: Any) -> Any:
        """One step of both; the reward is the model's."""
        key_game, key_predict = jax.random.split(key)
        stack, new, _, *ends = super().step(key_game, state, action, params)
        assert self.predict is not None
        said = self.predict(params.model, state.obs, action, key_predict)
        true = in_channels(stack[..., -3:], self.palette) / 255
        believed = shares_of(said.next_obs[..., -3:], self.palette)
        mended = jnp.where(np.isin(np.arange(3), self.truth), true, believed)
        frame = jnp.round(mixture_of(mended, self.palette)).astype(stack.dtype)
        obs = jnp.concatenate([state.obs[..., 3:], frame], axis=-1)
        return obs, replace(new, obs=obs), said.reward, *ends


@cache
def guided(dyna: Dyna, things: tuple[str, ...]) -> Dyna:
    """Dreams of the same model with these of the true game's objects."""
    env, model = dyna.env, dyna.model
    palette: Palette = env.env.palette  # type: ignore[attr-defined]
    assert model is not None

    def params(state: DynaState, hparams: DynaHParams) -> GuidedParams:
        return GuidedParams(hparams.env, state.replay, hparams.env.max_steps, state.model.params)

    truth = tuple(OBJECTS[thing] for thing in things)
    dream = Guided(env, draw_state, model.predict, truth, palette)  # type: ignore[arg-type]
    return with_states(dyna)._replace(dream=Dream(dream, params))
