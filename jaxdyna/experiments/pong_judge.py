"""Judging a frame model of Pong, object by object, on episodes that it has not seen."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna.envs.pong_screen import picture_of, shares_of
from jaxdyna.experiments.pong_data import NUM_FRAMES, Played, View, take
from jaxdyna.models.evaluation import Predict, open_loop
from jaxdyna.types import Key

OBJECTS = {"ball": 2, "own paddle": 1, "opponent": 0}
"""Their channels."""
ORDER = np.array(list(OBJECTS.values()))

Judgement = dict[str, jax.Array]


class Asked(NamedTuple):
    """Who predicts.

    Attributes:
        believe: ``(params, obs [N, ...], action [N]) -> [N, H, W, 3]``: how likely a pixel is lit
            by each object.
        picture: from the same to the frame that is expected, 0 to 255.
        predict: the model's.
        threshold: above which a pixel counts as lit.
    """

    believe: Callable[..., jax.Array]
    picture: Callable[..., jax.Array]
    predict: Predict
    threshold: float


def judge(
    asked: Asked, params: Any, view: View, new: Played, starts: list[int], horizon: int, key: Key
) -> Judgement:
    """Counts over new episodes ``[N, T]``, from which recall and precision follow.

    Args:
        asked: the model.
        params: its parameters.
        view: how the episodes are seen.
        new: they.
        starts: steps of each at which dreams begin.
        horizon: how long these are.
        key: random key.

    Returns:
        ``one_step`` ``[objects, 3]``: pixels rightly lit, lit, and of the object; ``mass``
        ``[objects, 2]``: sums of the beliefs at its pixels and elsewhere in its channel; ``dream``
        ``[horizon, objects, 3]`` as ``one_step``, and ``dream_unserved`` of those within which no
        ball has been served yet, of which there are ``still_unserved`` ``[horizon]``; of a step
        with all objects in sight ``seen``, how much of each object is in a pixel of the stack, and
        ``truth`` and ``belief``, the frame that came and the expected one, in [0, 1];
        ``film_truth`` and ``film_dream``, frames ``[horizon, H, W, 3]`` of the first
        episode's dream in which a ball flies longest before one is served.
    """
    episodes, steps = new.action.shape

    def one_by_one(_: None, episode: jax.Array) -> tuple[None, Judgement]:
        times = jnp.arange(steps)
        transitions = take(view, new, jnp.full(steps, episode), times)
        belief = asked.believe(params, transitions.obs, transitions.action)
        truth = _objects(view, new, episode, times + 1)
        masses = [(belief * truth).sum((0, 1, 2)), (belief * ~truth).sum((0, 1, 2))]
        return None, {
            "one_step": counts(belief > asked.threshold, truth, (0, 1, 2)),
            "mass": jnp.stack(masses, axis=-1)[ORDER],
        }

    totals = jax.lax.scan(one_by_one, None, jnp.arange(episodes))[1]
    judgement = jax.tree.map(lambda leaf: leaf.sum(0), totals)
    return judgement | _shown(asked, params, view, new) | _dreams(
        asked, params, view, new, starts, horizon, key
    )  # fmt: skip


def _dreams(
    asked: Asked, params: Any, view: View, new: Played, starts: list[int], horizon: int, key: Key
) -> Judgement:
    """Open-loop dreams from each start, one start after the other."""
    episodes = new.action.shape[0]

    def from_start(key: Key, start: jax.Array) -> tuple[Key, tuple[jax.Array, ...]]:
        key, key_dream = jax.random.split(key)
        first = take(view, new, jnp.arange(episodes), jnp.full(episodes, start))
        action = jax.lax.dynamic_slice_in_dim(new.action, start, horizon, axis=1)

        def one(obs: jax.Array, action: jax.Array, key: Key) -> jax.Array:
            return open_loop(asked.predict, params, obs, action, key).next_obs[..., -3:]

        dreamed = jax.vmap(one)(first.obs, action, jax.random.split(key_dream, episodes))
        times = start + jnp.arange(horizon + 1)
        truth = jax.vmap(lambda episode: _objects(view, new, episode, times))(jnp.arange(episodes))
        lit = shares_of(dreamed, view.palette) > asked.threshold
        counted = counts(lit, truth[:, 1:], (2, 3))
        ball = truth[..., OBJECTS["ball"]]
        unserved = jnp.cumsum(_served(ball), axis=1) == 0
        return key, (
            counted.sum(0),
            (counted * unserved[..., None, None]).sum(0),
            unserved.sum(0),
            (ball[0, 1:].any((1, 2)) & unserved[0]).sum(),
            picture_of(truth[0, 1:], view.palette),
            dreamed[0],
        )

    played = jax.lax.scan(from_start, key, jnp.array(starts))[1]
    counted, unserved, still, in_flight, truth, dreamed = played
    return {
        "dream": counted.sum(0),
        "dream_unserved": unserved.sum(0),
        "still_unserved": still.sum(0),
        "film_truth": truth[in_flight.argmax()],
        "film_dream": dreamed[in_flight.argmax()],
    }


def _served(ball: jax.Array) -> jax.Array:
    """Whether a step brings a new ball, bool ``[episodes, T]``, from where it is, bool ``[episodes,
    T + 1, H, W]``: one that has not been there, or is an eighth of the field away.
    """
    there, columns = ball.any((2, 3)), ball.any(2)
    column = columns.argmax(-1)
    away = jnp.abs(column[:, 1:] - column[:, :-1]) > columns.shape[-1] // 8
    return there[:, 1:] & (~there[:, :-1] | away)


def _shown(asked: Asked, params: Any, view: View, new: Played) -> Judgement:
    """The step of the last episode in which the own paddle moves most while all objects are in
    sight.
    """
    steps = new.action.shape[1]
    episode = jnp.int32(new.action.shape[0] - 1)
    truth = _objects(view, new, episode, jnp.arange(1, steps + 1))
    before = _objects(view, new, episode, jnp.arange(steps))
    whole = (truth.sum((1, 2)) >= jnp.median(truth.sum((1, 2)), axis=0)).all(-1)
    changed = (truth ^ before)[..., OBJECTS["own paddle"]].sum((1, 2))
    time = jnp.argmax(jnp.where(whole & before.any((1, 2)).all(-1), changed, -1))
    shown = take(view, new, episode[None], time[None])
    frames = jnp.split(shown.obs[0], NUM_FRAMES, axis=-1)
    return {
        "seen": jnp.concatenate([shares_of(frame, view.palette) for frame in frames], axis=-1),
        "truth": picture_of(truth[time], view.palette) / 255,
        "belief": asked.picture(params, shown.obs, shown.action)[0] / 255,
    }


def _objects(view: View, played: Played, episode: jax.Array, times: jax.Array) -> jax.Array:
    """Where things are, bool ``[T, H, W, 3]``."""
    there = jax.tree.map(lambda leaf: leaf[episode, times], played.world)
    return jax.vmap(view.objects)(there)


def counts(lit: jax.Array, truth: jax.Array, axes: tuple[int, ...]) -> jax.Array:
    """``[..., objects, 3]``: pixels rightly lit, lit, and to be lit, summed over ``axes``."""
    three = [(lit & truth).sum(axes), lit.sum(axes), truth.sum(axes)]
    return jnp.stack(three, axis=-1)[..., ORDER, :]


def recall(counted: np.ndarray) -> np.ndarray:
    """Of `counts` ``[..., 3]``: the share of an object's pixels that are lit."""
    return counted[..., 0] / np.maximum(counted[..., 2], 1)


def precision(counted: np.ndarray) -> np.ndarray:
    """Of `counts` ``[..., 3]``: the share of lit pixels that are an object's; NaN of none."""
    return np.where(counted[..., 1] > 0, counted[..., 0] / np.maximum(counted[..., 1], 1), np.nan)
