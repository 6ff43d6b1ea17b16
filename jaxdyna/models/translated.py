"""A model of frames that sees them in other colours than the world shows them in."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxdyna.types import DynamicsModel, Key, Prediction, Transition


def translated(
    model: DynamicsModel,
    inward: Callable[[jax.Array], jax.Array],
    outward: Callable[[jax.Array], jax.Array],
    channels: int = 3,
) -> DynamicsModel:
    """The model in a world whose frames have to be translated for it.

    Args:
        model: of stacked frames as ``inward`` makes them.
        inward: from the world's stack ``[..., H, W, channels * frames]`` to the model's.
        outward: from the model's frame ``[H, W, C]`` to the world's ``[H, W, channels]``, uint8.
        channels: of one of the world's frames.
    """

    def predict(params: Any, obs: jax.Array, action: jax.Array, key: Key) -> Prediction:
        stack = inward(obs)
        frames = obs.shape[-1] // channels
        said = model.predict(params, stack, action, key)
        frame = outward(said.next_obs[..., -(stack.shape[-1] // frames) :])
        return said._replace(next_obs=jnp.concatenate([obs[..., channels:], frame], axis=-1))

    def update(
        state: Any, transitions: Transition, key: Key, hparams: Any
    ) -> tuple[Any, dict[str, jax.Array]]:
        seen = transitions._replace(
            obs=inward(transitions.obs), next_obs=inward(transitions.next_obs)
        )
        return model.update(state, seen, key, hparams)

    return DynamicsModel(model.init, predict, update)
