"""Judging a frame model on episodes that it has not seen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna.envs.maze import MOVES
from jaxdyna.experiments.maze_options import DREAM_FROM, Options
from jaxdyna.models import PixelConfig, frame_probability, pixels
from jaxdyna.models.evaluation import Predict, open_loop
from jaxdyna.types import DynamicsModel, Key, Transition

CLASSES = {"agent": 2, "obstacles": 0, "goal": 1}
CHANNELS = np.array(list(CLASSES.values()))
THRESHOLDS = np.round(np.arange(0.05, 0.96, 0.05), 2)
FAINT = 0.05
REWARD_KINDS = ("collision", "goal", "neither", "collision in the first step")

Judgement = dict[str, jax.Array]


def make_model(options: Options, config: PixelConfig) -> DynamicsModel:
    """A model of the experiment's maze."""
    return pixels((options.size, options.size, 3), len(MOVES), config)


class Predictor(NamedTuple):
    """What `judge` asks of a model.

    Attributes:
        believe: ``(params, obs [N, ...], action [N]) -> [N, H, W, C]``: how likely a pixel is lit.
        lit: its ``predict``, frames by the threshold.
        drawn: likewise, each pixel drawn with its probability.
    """

    believe: Callable[..., jax.Array]
    lit: Predict
    drawn: Predict


def predictor(options: Options, config: PixelConfig) -> Predictor:
    """A model's."""
    drawing = make_model(options, replace(config, threshold=None))
    believe = frame_probability(len(MOVES), config)
    return Predictor(believe, make_model(options, config).predict, drawing.predict)


def judge(options: Options, asked: Predictor, params: Any, new: Transition, key: Key) -> Judgement:
    """Counts over new episodes, from which scores follow.

    Args:
        options: the experiment's.
        asked: who predicts.
        params: the model's.
        new: episodes ``[N, T]``.
        key: random key.

    Returns:
        ``one_step`` ``[thresholds, classes, 3]``: pixels rightly lit, lit, and to be lit; ``mass``
        ``[classes, 2]``: sums of the beliefs at pixels that are lit, and of those above `FAINT`
        elsewhere; ``reward`` ``[kinds, 2]``: rewards right to within half the smallest that is
        not 0, and all, by `REWARD_KINDS`; ``dream_lit`` and ``dream_drawn`` ``[horizon, classes,
        3]`` as ``one_step`` for open-loop dreams; ``seen``, ``truth`` and ``belief`` of two steps;
        ``film_truth`` and ``film_dream`` ``[horizon, H, W, 3]``.
    """
    key_reward, key_lit, key_drawn = jax.random.split(key, 3)

    def one_by_one(key: Key, episode: Transition) -> tuple[Key, Judgement]:
        key, key_now = jax.random.split(key)
        return key, _one_step(options, asked, params, episode, key_now)

    totals = jax.lax.scan(one_by_one, key_reward, new)[1]
    judgement = jax.tree.map(lambda leaf: leaf.sum(0), totals)
    span = slice(DREAM_FROM, DREAM_FROM + options.horizon)
    truth = new.next_obs[:, span, ..., -3:]

    def dream(predict: Predict, key: Key) -> jax.Array:
        def one(obs: jax.Array, action: jax.Array, key: Key) -> jax.Array:
            return open_loop(predict, params, obs, action, key).next_obs[..., -3:]

        keys = jax.random.split(key, options.held_out)
        return jax.vmap(one)(new.obs[:, DREAM_FROM], new.action[:, span], keys)

    lit, drawn = dream(asked.lit, key_lit), dream(asked.drawn, key_drawn)
    shown = jax.tree.map(lambda leaf: leaf[0, DREAM_FROM - 2 : DREAM_FROM], new)
    return judgement | {
        "dream_lit": _counts(lit > 0, truth > 0, (0, 2, 3)),
        "dream_drawn": _counts(drawn > 0, truth > 0, (0, 2, 3)),
        "seen": shown.obs,
        "truth": shown.next_obs[..., -3:],
        "belief": asked.believe(params, shown.obs, shown.action),
        "film_truth": truth[0],
        "film_dream": lit[0],
    }


def _one_step(
    options: Options, asked: Predictor, params: Any, one: Transition, key: Key
) -> Judgement:
    """The counts of one episode ``[T]``."""
    truth = one.next_obs[..., -3:] > 0
    belief = asked.believe(params, one.obs, one.action)
    lit = belief > THRESHOLDS[:, None, None, None, None]
    keys = jax.random.split(key, one.action.shape[0])
    reward = jax.vmap(asked.lit, (None, 0, 0, 0))(params, one.obs, one.action, keys).reward
    rewards = [abs(options.collision_reward), abs(options.goal_reward)]
    right = jnp.abs(reward - one.reward) < min(filter(None, rewards), default=1.0) / 2
    red, green, blue = jnp.moveaxis(truth, -1, 0)
    collision, at_goal = ((other & blue).any((-1, -2)) for other in (red, green))
    first = jnp.arange(len(collision)) == 0
    apart = [collision, at_goal & ~collision, ~(at_goal | collision)]
    kinds = jnp.stack([*apart, collision & first])
    faint = belief * (~truth & (belief > FAINT))
    mass = [(belief * truth).sum((0, 1, 2)), faint.sum((0, 1, 2))]
    return {
        "one_step": _counts(lit, truth, (1, 2, 3)),
        "mass": jnp.stack(mass, axis=-1)[CHANNELS],
        "reward": jnp.stack([(kinds & right).sum(1), kinds.sum(1)], axis=-1),
    }


def _counts(lit: jax.Array, truth: jax.Array, axes: tuple[int, ...]) -> jax.Array:
    """``[..., classes, 3]``: pixels rightly lit, lit, and to be lit, summed over ``axes``."""
    truth = jnp.broadcast_to(truth, lit.shape)
    counts = jnp.stack([(lit & truth).sum(axes), lit.sum(axes), truth.sum(axes)], axis=-1)
    return counts[..., CHANNELS, :]


def f1(counts: np.ndarray) -> np.ndarray:
    """F1 of `_counts` ``[..., 3]``: the harmonic mean of precision and recall."""
    return 2 * counts[..., 0] / np.maximum(counts[..., 1] + counts[..., 2], 1)
