"""Judging a frame model, class by class, on episodes that it has not seen."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna.experiments.frames.worlds import Asked, World
from jaxdyna.models.evaluation import Predict, open_loop
from jaxdyna.types import Key

THRESHOLDS = np.round(np.arange(0.05, 0.96, 0.05), 2)
Judgement = dict[str, jax.Array]


def judge(world: World, asked: Asked, params: Any, data: Any, key: Key) -> Judgement:
    """Counts over the new episodes, from which scores follow.

    Returns:
        ``one_step`` ``[thresholds, classes, 3]``: pixels rightly lit, lit, and to be lit, by
        `THRESHOLDS`; ``threshold``, the one that the model uses; ``mass`` ``[classes, 2]``: sums of
        the beliefs at pixels that are lit, and of those above `World.faint` elsewhere; where
        rewards are predicted, ``reward`` ``[4, 2]``: those that are right, and all, where they are
        below 0, above 0, 0, and below 0 in the first step; by rule ``dream_RULE`` ``[horizon,
        classes, 3]`` as ``one_step`` for open-loop dreams, ``pixels`` of each of their steps, and
        where some steps are counted apart ``dream_RULE_apart`` and ``steps_apart``, how many,
        ``[horizon]``.
    """
    key_steps, key_dreams = jax.random.split(key)

    def one_by_one(key: Key, episode: jax.Array) -> tuple[Key, Judgement]:
        key, key_now = jax.random.split(key)
        return key, _one_step(world, asked, params, data, episode, key_now)

    totals = jax.lax.scan(one_by_one, key_steps, jnp.arange(world.episodes))[1]
    judged = jax.tree.map(lambda leaf: leaf.sum(0), totals)
    for number, (rule, predict) in enumerate(asked.rules):
        key_rule = jax.random.fold_in(key_dreams, number)
        dreamed = _dreams(world, asked.threshold, predict, params, data, key_rule)
        judged |= {name.replace("dream", f"dream_{rule}"): leaf for name, leaf in dreamed.items()}
    return judged | {"threshold": jnp.float32(asked.threshold)}


def _one_step(world: World, asked: Asked, params, data, episode, key) -> Judgement:
    """The counts of one episode."""
    times = jnp.arange(world.steps)
    seen, truth = world.take(data, episode, times), world.truth(data, episode, times)
    belief = asked.believe(params, seen.obs, seen.action)
    faint = belief * (~truth & (belief > world.faint))
    mass = [(belief * truth).sum((0, 1, 2)), faint.sum((0, 1, 2))]
    judged = {
        "one_step": jax.lax.map(
            lambda bar: counts(world, belief > bar, truth, (0, 1, 2)), jnp.asarray(THRESHOLDS)
        ),
        "mass": jnp.stack(mass, axis=-1)[np.array(world.channels)],
    }
    if asked.rewards:
        keys, predict = jax.random.split(key, world.steps), asked.rules[0][1]
        said = jax.vmap(predict, (None, 0, 0, 0))(params, seen.obs, seen.action, keys).reward
        right = jnp.abs(said - seen.reward) < world.tolerance
        below = seen.reward < 0
        kinds = jnp.stack([below, seen.reward > 0, seen.reward == 0, below & (times == 0)])
        judged["reward"] = jnp.stack([(kinds & right).sum(1), kinds.sum(1)], axis=-1)
    return judged


def _dreams(world: World, threshold: float, predict: Predict, params, data, key) -> Judgement:
    """Open-loop dreams of all episodes, one start after the other."""
    numbers = jnp.arange(world.episodes)

    def from_start(key: Key, start: jax.Array) -> tuple[Key, Judgement]:
        key, key_dream = jax.random.split(key)
        times = start + jnp.arange(world.horizon)
        keys = jax.random.split(key_dream, world.episodes)
        frames = jax.vmap(
            lambda number, key: _dream(world, predict, params, data, number, start, key)
        )(numbers, keys)
        truth = jax.vmap(lambda number: world.truth(data, number, times))(numbers)
        counted = counts(world, world.shares(frames) > threshold, truth, (2, 3))
        pixels = jnp.int32(frames[:, 0, ..., 0].size)
        judged = {"dream": counted.sum(0), "pixels": pixels}
        if world.apart is not None:
            before = jax.vmap(lambda number: world.truth(data, number, start[None] - 1))(numbers)
            apart = world.apart(jnp.concatenate([before, truth], axis=1))
            judged["dream_apart"] = (counted * apart[..., None, None]).sum(0)
            judged["steps_apart"] = apart.sum(0)
        return key, judged

    totals = jax.lax.scan(from_start, key, jnp.array(world.starts))[1]
    return jax.tree.map(lambda leaf: leaf.sum(0), totals)


def _dream(world: World, predict: Predict, params, data, episode, start, key) -> jax.Array:
    """The frames of one, ``[horizon, H, W, 3]``, actions as recorded."""
    obs = world.take(data, episode, start[None]).obs[0]
    action = world.take(data, episode, start + jnp.arange(world.horizon)).action
    return open_loop(predict, params, obs, action, key).next_obs[..., -3:]


def show(world: World, asked: Asked, params: Any, data: Any, key: Key) -> Judgement:
    """Pictures: ``seen``, ``truth`` and ``belief`` (in [0, 1]) of a step, the stack before it, the
    frame that came and what was expected; ``film_truth`` and ``film_dream`` ``[horizon, H, W, 3]``
    of a dream in the first new episode.
    """
    episode, time = world.example(data)
    shown = world.take(data, episode, jnp.asarray(time)[None])
    picture = (asked.picture or asked.believe)(params, shown.obs, shown.action)
    starts, span = jnp.array(world.starts), jnp.arange(world.horizon + 1)
    truth = jax.vmap(lambda start: world.truth(data, 0, start - 1 + span))(starts)
    start = starts[world.film(truth)]
    return {
        "seen": shown.obs[0],
        "truth": shown.next_obs[0, ..., -3:],
        "belief": picture[0],
        "film_truth": world.take(data, 0, start + span[:-1]).next_obs[..., -3:],
        "film_dream": _dream(world, asked.rules[0][1], params, data, 0, start, key),
    }


def counts(world: World, lit: jax.Array, truth: jax.Array, axes: tuple[int, ...]) -> jax.Array:
    """``[..., classes, 3]``: pixels rightly lit, lit, and to be lit, summed over ``axes``."""
    three = [(lit & truth).sum(axes), lit.sum(axes), truth.sum(axes)]
    return jnp.stack(three, axis=-1)[..., np.array(world.channels), :]
