"""How much a learner that is otherwise greedy explores."""

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from jaxdyna.agents.dqn_settings import DQNHParams
from jaxdyna.types import Transition


@struct.dataclass
class Exploration:
    """What decides it."""

    episodes: jax.Array  #: int32, real episodes counted so far
    rewarded: jax.Array  #: bool, whether a real step has brought a reward above 0 yet
    drift: jax.Array  #: ``[actions]``, log odds of exploratory actions


def init(num_actions: int) -> Exploration:
    """Before the first episode: no direction."""
    return Exploration(jnp.int32(0), jnp.bool_(False), jnp.zeros(num_actions))


def count(
    before: Exploration, real: Transition, hparams: DQNHParams, until_rewarded: bool
) -> Exploration:
    """After the real episodes ``[N, T]``. ``until_rewarded`` stops the count where exploration
    would begin to fall, for as long as no step has brought a reward above 0.
    """
    episodes = before.episodes + real.mask.shape[0]
    rewarded = before.rewarded | (real.mask & (real.reward > 0)).any()
    if until_rewarded:
        hold = jnp.asarray(hparams.epsilon_hold).astype(jnp.int32)
        episodes = jnp.where(rewarded, episodes, jnp.minimum(episodes, hold))
    return replace(before, episodes=episodes, rewarded=rewarded)


def epsilon(state: Exploration, hparams: DQNHParams) -> jax.Array:
    """The share of exploratory actions, a scalar in [0, 1]."""
    falling = (state.episodes - hparams.epsilon_hold) / jnp.maximum(hparams.epsilon_episodes, 1e-6)
    gone = jnp.clip(falling, 0, 1)
    return hparams.epsilon_first + gone * (hparams.epsilon_last - hparams.epsilon_first)


def epsilon_fake(state: Exploration, hparams: DQNHParams) -> jax.Array:
    """The same in dreams."""
    share = hparams.epsilon_fake
    return epsilon(state, hparams) if share is None else jnp.asarray(share)
