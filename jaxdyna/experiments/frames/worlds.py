"""What a world and a model tell of themselves, so that any model is judged in any world."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from jaxdyna.experiments.engine import Runs
from jaxdyna.models.evaluation import Predict
from jaxdyna.types import Key, Transition


@struct.dataclass
class Stage:
    """What a model is trained on, and how long.

    Attributes:
        part: of what is to be learned from, such as the first so many episodes; the world's own.
        updates: gradient steps in all.
        learning_rate: at the start; it falls to 0 along half a cosine.
    """

    part: int | jax.Array
    updates: int | jax.Array
    learning_rate: float | jax.Array


class World(NamedTuple):
    """Episodes to learn from and new ones to be judged on, ``data``, whatever that is: `sample`
    draws from it, `take` and `truth` look at the new ones, of which all last as long.

    Attributes:
        data: ``(key, key_new, stage) -> data``, of one run; the second key is for new episodes.
            None where ``collect`` makes it.
        sample: ``(data, key, stage, size) -> Transition [size]`` to learn from.
        take: ``(data, episode, times [T]) -> Transition [T]`` of a new episode.
        truth: likewise what there is after those steps, bool ``[T, H, W, channels]``.
        episodes: new ones.
        steps: of each.
        starts: steps at which dreams begin.
        horizon: how long these are.
        channels: of each class that is scored.
        example: ``data -> (episode, time)`` of the step that is shown.
        shares: from frames ``[..., H, W, 3]`` to how much of each channel is in each pixel, in
            [0, 1].
        faint: what is believed up to here is not counted as spilled.
        tolerance: how far a reward may be off to be right.
        apart: from ``truth [N, horizon + 1, ...]``, what there is where dreams begin and after each
            of their steps, to which steps are counted once more by themselves, bool ``[N,
            horizon]``.
        film: from ``truth [starts, horizon + 1, ...]`` to which dream of the first episode is
            filmed, by default the first.
        collect: see `jaxdyna.experiments.engine.Work`.
    """

    data: Callable[[Key, Key, Stage], Any] | None
    sample: Callable[[Any, Key, Stage, int], Transition]
    take: Callable[[Any, Any, jax.Array], Transition]
    truth: Callable[[Any, Any, jax.Array], jax.Array]
    episodes: int
    steps: int
    starts: tuple[int, ...]
    horizon: int
    channels: tuple[int, ...]
    example: Callable[[Any], tuple[Any, Any]]
    shares: Callable[[jax.Array], jax.Array] = lambda frames: frames.astype(jnp.float32) / 255
    faint: float = 0.0
    tolerance: float = 0.5
    apart: Callable[[jax.Array], jax.Array] | None = None
    film: Callable[[jax.Array], jax.Array] = lambda truth: jnp.int32(0)
    collect: Callable[[Runs], Any] | None = None


class Asked(NamedTuple):
    """Who predicts.

    Attributes:
        believe: ``(params, obs [N, ...], action [N]) -> [N, H, W, channels]``: how likely a pixel
            is lit by each channel.
        rules: by name ways to make frames, each a model's ``predict``; the first one's rewards
            count, and it is filmed.
        threshold: a pixel is lit above it.
        rewards: whether it predicts any.
        picture: from the same to the expected frame in [0, 1]; None: what is believed.
    """

    believe: Callable[..., jax.Array]
    rules: tuple[tuple[str, Predict], ...]
    threshold: float
    rewards: bool = False
    picture: Callable[..., jax.Array] | None = None
