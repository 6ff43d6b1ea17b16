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
    """What a model is trained on, and how long."""

    #: of what is to be learned from, such as the first so many episodes; the world's own
    part: int | jax.Array
    updates: int | jax.Array  #: gradient steps in all
    learning_rate: float | jax.Array  #: at the start; it falls to 0 along half a cosine


class World(NamedTuple):
    """Episodes to learn from and new ones to be judged on, ``data``, whatever that is: `sample`
    draws from it, `take` and `truth` look at the new ones, of which all last as long.
    """

    #: ``(key, key_new, stage) -> data``, of one run; the second key is for new episodes. None where
    #: ``collect`` makes it.
    data: Callable[[Key, Key, Stage], Any] | None
    #: ``(data, key, stage, size) -> Transition [size]`` to learn from
    sample: Callable[[Any, Key, Stage, int], Transition]
    #: ``(data, episode, times [T]) -> Transition [T]`` of a new episode
    take: Callable[[Any, Any, jax.Array], Transition]
    #: likewise what there is after those steps, bool ``[T, H, W, channels]``
    truth: Callable[[Any, Any, jax.Array], jax.Array]
    episodes: int  #: new ones
    steps: int  #: of each
    starts: tuple[int, ...]  #: steps at which dreams begin
    horizon: int  #: how long these are
    channels: tuple[int, ...]  #: of each class that is scored
    #: ``data -> (episode, time)`` of the step that is shown
    example: Callable[[Any], tuple[Any, Any]]
    #: from frames ``[..., H, W, 3]`` to how much of each channel is in each pixel, in [0, 1]
    shares: Callable[[jax.Array], jax.Array] = lambda frames: frames.astype(jnp.float32) / 255
    faint: float = 0.0  #: what is believed up to here is not counted as spilled
    tolerance: float = 0.5  #: how far a reward may be off to be right
    #: from ``truth [N, horizon + 1, ...]``, what there is where dreams begin and after each of
    #: their steps, to which steps are counted once more by themselves, bool ``[N, horizon]``
    apart: Callable[[jax.Array], jax.Array] | None = None
    #: from ``truth [starts, horizon + 1, ...]`` to which dream of the first episode is filmed
    film: Callable[[jax.Array], jax.Array] = lambda truth: jnp.int32(0)
    collect: Callable[[Runs], Any] | None = None  #: see `jaxdyna.experiments.engine.Work`


class Asked(NamedTuple):
    """Who predicts."""

    #: ``(params, obs [N, ...], action [N]) -> [N, H, W, channels]``: how likely each is lit
    believe: Callable[..., jax.Array]
    #: by name ways to make frames, each a ``predict``; the first one's rewards count, it is filmed
    rules: tuple[tuple[str, Predict], ...]
    threshold: float  #: a pixel is lit above it
    rewards: bool = False  #: whether it predicts any
    #: from the same to the expected frame in [0, 1]; None: what is believed
    picture: Callable[..., jax.Array] | None = None
