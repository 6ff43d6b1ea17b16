"""What can be done in a world: one of so many actions, or a vector within bounds. What differs
between the two is here: what a policy says of them, how a model is told, what planners try.
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna.fields import check_counts
from jaxdyna.types import Key


def categorical(logits: jax.Array, action: jax.Array) -> jax.Array:
    """Log probabilities ``[...]`` of actions, int ``[...]``, by log odds ``[..., A]``."""
    chex.assert_type(action, int)
    return jnp.take_along_axis(jax.nn.log_softmax(logits), action[..., None], axis=-1)[..., 0]


@dataclass(frozen=True)
class Discrete:
    """One of ``n``: a whole number. A policy's outputs are log odds ``[..., n]``."""

    n: int
    shape: ClassVar[tuple[int, ...]] = ()
    dtype: ClassVar[Any] = jnp.int32
    log_prob: ClassVar[Any] = staticmethod(categorical)

    def __str__(self) -> str:
        return str(self.n)

    @property
    def outputs(self) -> tuple[int, int]:
        """How many a policy has that depend on what is seen, and how many that do not."""
        return self.n, 0

    def sample(self, key: Key, logits: jax.Array, shape: Any = None) -> jax.Array:
        """Actions ``[*shape]`` drawn by a policy's outputs; None: one by each."""
        return jax.random.categorical(key, logits, shape=shape)

    def mode(self, logits: jax.Array) -> jax.Array:
        """The likeliest actions ``[...]``."""
        return jnp.argmax(logits, axis=-1)

    def clip(self, action: jax.Array) -> jax.Array:
        """Within the bounds: itself."""
        return action

    def encode(self, action: jax.Array, one_hot: bool) -> jax.Array:
        """What a model is told of actions ``[...]``: ``[..., n]``, or the number itself."""
        return jax.nn.one_hot(action, self.n) if one_hot else action[..., None]

    def uniform(self, key: Key, shape: tuple[int, ...] = ()) -> jax.Array:
        """Actions ``[*shape]``, all as likely."""
        return jax.random.randint(key, shape, 0, self.n)

    def sequences(self, key: Key, shape: tuple[int, int], drift: float) -> jax.Array:
        """Actions ``[candidates, horizon]`` drawn without knowing anything, see
        `jaxdyna.planners.ShootingConfig`.
        """
        key_odds, key_actions = jax.random.split(key)
        odds = drift * jax.random.normal(key_odds, (shape[0], 1, self.n))
        return jax.random.categorical(key_actions, odds, shape=shape)

    def choices(self, tried: jax.Array) -> jax.Array:
        """Those among which a planner that tried ``[candidates]`` chooses: all."""
        return jnp.arange(self.n)

    def like(self, best: jax.Array, floor: float) -> jax.Array:
        """Outputs ``[horizon, n]`` of a policy that does, at each step, what the best sequences
        ``[elites, horizon]`` do, see `jaxdyna.planners.CrossEntropyConfig`.
        """
        frequency = jax.nn.one_hot(best, self.n).mean(0)
        return jnp.log((1 - floor) * frequency + floor / self.n)


LOG_STD = -5.0, 2.0  #: the least and the most that a policy's deviation is


@dataclass(frozen=True)
class Box:
    """A vector within bounds, float32 ``[n]``; a world takes what is beyond them as clipped. A
    policy's outputs ``[..., 2 n]`` are the means of a Gaussian, and the logarithms of its standard
    deviations (Williams 1992), in units in which the bounds are -1 and 1; shapes as of `Discrete`.
    """

    low: tuple[float, ...]
    high: tuple[float, ...]
    dtype: ClassVar[Any] = jnp.float32

    def __post_init__(self) -> None:
        """Makes the bounds tuples; `ValueError` where they are none."""
        low, high = np.atleast_1d(self.low, self.high)
        if low.shape != high.shape or low.ndim != 1 or not _bounded(low, high):
            raise ValueError(f"a Box from {self.low} to {self.high}: give as many finite bounds "
                             "low as high, each low one below its high one")  # fmt: skip
        object.__setattr__(self, "low", tuple(low.tolist()))
        object.__setattr__(self, "high", tuple(high.tolist()))

    @property
    def shape(self) -> tuple[int, ...]:
        return (len(self.low),)

    @property
    def outputs(self) -> tuple[int, int]:
        """The means depend on what is seen, the deviations do not."""
        return len(self.low), len(self.low)

    @property
    def _units(self) -> tuple[np.ndarray, np.ndarray]:
        """The middle, and half the width."""
        low, high = np.array([self.low, self.high], np.float32)
        return (low + high) / 2, (high - low) / 2

    def _gaussian(self, outputs: jax.Array) -> tuple[Any, Any]:
        """Means and standard deviations, of the actions themselves."""
        middle, half = self._units
        mean, log_std = jnp.split(outputs, 2, axis=-1)
        return middle + half * mean, half * jnp.exp(jnp.clip(log_std, *LOG_STD))

    def log_prob(self, outputs: jax.Array, action: jax.Array) -> jax.Array:
        """Log densities ``[...]`` of actions ``[..., n]``, clipped by nobody yet."""
        mean, std = self._gaussian(outputs)
        chex.assert_equal_shape([mean, action])
        return jax.scipy.stats.norm.logpdf(action, mean, std).sum(-1)

    def sample(self, key: Key, outputs: jax.Array, shape: Any = None) -> jax.Array:
        """Drawn by a policy's outputs, bounds or not."""
        mean, std = self._gaussian(outputs)
        shape = mean.shape[:-1] if shape is None else shape
        return mean + std * jax.random.normal(key, (*shape, *self.shape), self.dtype)

    def mode(self, outputs: jax.Array) -> jax.Array:
        return self.clip(self._gaussian(outputs)[0])

    def clip(self, action: jax.Array) -> jax.Array:
        return jnp.clip(action, jnp.array(self.low), jnp.array(self.high)).astype(self.dtype)

    def encode(self, action: jax.Array, one_hot: bool) -> jax.Array:
        """As the world takes it, in a policy's units."""
        middle, half = self._units
        return (self.clip(action) - middle) / half

    def uniform(self, key: Key, shape: tuple[int, ...] = ()) -> jax.Array:
        middle, half = self._units
        return middle + half * jax.random.uniform(key, (*shape, *self.shape), self.dtype, -1, 1)

    def sequences(self, key: Key, shape: tuple[int, int], drift: float) -> jax.Array:
        """Uniform, each candidate moved by a vector of its own."""
        key_moves, key_actions = jax.random.split(key)
        moves = drift * jax.random.normal(key_moves, (shape[0], 1, *self.shape), self.dtype)
        return self.clip(self.uniform(key_actions, shape) + self._units[1] * moves)

    def choices(self, tried: jax.Array) -> jax.Array:
        return tried

    def like(self, best: jax.Array, floor: float) -> jax.Array:
        """With their mean, and their deviation or the floor."""
        scaled = self.encode(best, one_hot=False)
        std = jnp.maximum(scaled.std(0), floor)
        return jnp.concatenate([scaled.mean(0), jnp.log(std)], axis=-1)


Actions = Discrete | Box


def as_actions(num_actions: int | Actions) -> Actions:
    """Numbered ones where it is a count, or a space's; `SettingError` where it is neither."""
    if isinstance(num_actions, Discrete | Box):
        return num_actions
    if hasattr(num_actions, "contains"):
        return actions_in(num_actions)
    check_counts(num_actions=num_actions)
    return Discrete(num_actions)


def actions_in(space: Any) -> Actions:
    """Those of a ``gymnasium.spaces`` space. `ValueError` where they are neither numbered nor
    vectors within bounds.
    """
    if hasattr(space, "n") and space.shape == ():
        return Discrete(int(space.n))
    low, high = (np.asarray(getattr(space, end, 0)) for end in ("low", "high"))
    if low.ndim != 1 or low.dtype.kind != "f" or not _bounded(low, high):
        wanted = "give Discrete ones, or vectors of floats in a bounded Box"
        raise ValueError(f"actions are {space}: {wanted} (gymnasium.wrappers.TransformAction)")
    return Box(tuple(low.tolist()), tuple(high.tolist()))


def _bounded(low: np.ndarray, high: np.ndarray) -> bool:
    """Whether these are ends of something, in single precision."""
    with np.errstate(over="ignore"):
        width = np.float32(high) - np.float32(low)
    return bool(low.size and ((width > 0) & (width < np.inf)).all())


def actions_of(env: Any) -> Actions:
    """A world's: so many as its ``num_actions``, or those of its ``action_space``. `ValueError`
    where it has neither, or as in `actions_in`.
    """
    if hasattr(env, "num_actions"):
        return Discrete(env.num_actions)
    if not hasattr(env, "action_space"):
        name = type(env).__name__
        raise ValueError(f"env is a {name}: give one that has num_actions, or an action_space")
    return actions_in(env.action_space(env.default_params))


def number_of(actions: Actions, who: str, instead: str) -> int:
    """How many there are. `ValueError` where they cannot be numbered, as who chooses wants them."""
    if not isinstance(actions, Discrete):
        raise ValueError(f"{who} takes numbered actions, not a {actions}: {instead}")
    return actions.n
