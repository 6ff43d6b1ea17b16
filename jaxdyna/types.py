"""What every part speaks: transitions, environments, agents and dynamics models.

Shapes are written ``[axis, ...]``; the axis order is hparams, seed, episode, time, features.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import chex
import jax
import jax.numpy as jnp

Key = jax.Array  #: a typed random key (``jax.random.key``), used once

PyTree = Any
#: what a step of an `Environment` returns
Stepped = tuple[jax.Array, Any, jax.Array, jax.Array, jax.Array, dict[str, Any]]


def check_key(key: Any, rank: int = 0) -> None:
    """Raises `ValueError` for what is no typed key, or with a rank of 1 no array of them."""
    typed = jax.dtypes.issubdtype(getattr(key, "dtype", None), jax.dtypes.prng_key)
    if not typed or key.ndim != rank:
        what = f"{key.dtype}{list(key.shape)}" if hasattr(key, "shape") else f"{key!r}"
        make = "jax.random.split(jax.random.key(0), seeds)" if rank else "jax.random.key(0)"
        raise ValueError(f"{'keys are' if rank else 'key is'} {what}: make typed ones by {make}")


def check_part(name: str, part: Any, *functions: str) -> None:
    """Raises `ValueError` for what has not the functions of such a part."""
    if isinstance(part, type) or not all(hasattr(part, function) for function in functions):
        kind = (
            f"the class {part.__name__}" if isinstance(part, type) else f"a {type(part).__name__}"
        )
        raise ValueError(f"{name} is {kind}: give one that has {', '.join(functions)}")


class Transition(NamedTuple):
    """One step of experience, or with leading axes a batch of them (``[N, T]`` from `rollout`).

    ``terminated`` says that the world ended; ``truncated`` that only the recording did, never both.
    A learner bootstraps from ``next_obs`` unless ``terminated``.

    Attributes:
        obs: what was seen before acting, ``[..., *obs]``.
        action: what was done, int ``[...]``, or in a Box float ``[..., n]`` as it was chosen,
            clipped to the bounds by the world alone.
        reward: what it earned, ``[...]``.
        next_obs: what was seen after, ``[..., *obs]``; never the first frame of a new episode.
        terminated: bool ``[...]``.
        truncated: bool ``[...]``.
        mask: bool ``[...]``, False on padding after the end of an episode: what is there counts
            for nothing, whatever it is.
        weight: float ``[...]``, of each transition in a learner's loss; None: 1.
    """

    obs: jax.Array
    action: jax.Array
    reward: jax.Array
    next_obs: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    mask: jax.Array
    weight: jax.Array | None = None

    @property
    def valid(self) -> jax.Array:
        """The mask; `AssertionError` where it is not bool."""
        meaning = "a mask says which steps there are; how much each counts is its weight"
        chex.assert_type(self.mask, bool, custom_message=meaning)
        return self.mask

    @property
    def weights(self) -> jax.Array:
        """Float32 ``[...]``, 0 where masked out."""
        weight = jnp.float32(1) if self.weight is None else self.weight
        return jnp.where(self.valid, weight, 0).astype(jnp.float32)

    def blanked(self) -> Transition:
        """With zeros where masked out, so that nothing there, not even NaN, reaches a gradient."""

        def blank(leaf: jax.Array) -> jax.Array:
            mask = self.mask.reshape(self.mask.shape + (1,) * (leaf.ndim - self.mask.ndim))
            return jnp.where(mask, leaf, jnp.zeros((), leaf.dtype))

        return jax.tree.map(blank, self)


def check_transitions(transitions: Transition, rank: int | None = None) -> None:
    """Refuses, by an `AssertionError`, transitions whose arrays disagree about the leading axes,
    which are those of the bool mask, and actions that are neither integers nor vectors of numbers.
    ``rank`` is how many axes there have to be, 2 of episodes ``[N, T]``; None: any number.
    """
    mask, action = transitions.valid, transitions.action
    ends = [transitions.terminated, transitions.truncated]
    chex.assert_rank(mask, mask.ndim if rank is None else rank)
    chex.assert_type(action, float if action.ndim > mask.ndim else int)
    chex.assert_equal_shape([mask, transitions.reward, *ends])
    chex.assert_equal_shape_prefix([mask, action, transitions.obs, transitions.next_obs], mask.ndim)


class Environment(Protocol):
    """A pure environment: everything random comes from ``key``, everything that can be swept from
    ``params``, everything that decides a shape from the (hashable) object itself. It never resets
    by itself. The argument order is gymnax's. Where actions are numbered it has ``num_actions``,
    else they are a Box, whose bounds are the object's, not of its params, and an action beyond them
    is taken as clipped to them. One that people can watch also has ``render(state, params)``, a
    uint8 frame ``[height, width, 3]``.
    """

    @property
    def default_params(self) -> Any:
        """A pytree of what can be swept; it has a field ``max_steps``."""

    def reset(self, key: Key, params: Any) -> tuple[jax.Array, Any]:
        """Returns the first ``obs`` and ``state`` of an episode."""

    def step(self, key: Key, state: Any, action: jax.Array, params: Any) -> Stepped:
        """Returns ``obs, state, reward, terminated, truncated, info``."""

    def observation_space(self, params: Any) -> Any:
        """The ``gymnasium.spaces`` space of one observation."""

    def action_space(self, params: Any) -> Any:
        """The ``gymnasium.spaces`` space of one action."""


Act = Callable[[Any, jax.Array, Key, Any], jax.Array]
Update = Callable[[Any, Transition, Key, Any], tuple[Any, dict[str, jax.Array]]]


class Agent(NamedTuple):
    """A learner of behaviour, as three pure functions.

    Attributes:
        init: ``(key, hparams) -> state``.
        act: ``(state, obs, key, hparams) -> action`` for one observation ``[*obs]``.
        update: ``(state, transitions, key, hparams) -> (state, metrics)`` from whole episodes
            ``[N, T]``, real or fake alike, weighed by ``transitions.weight``. Where all weigh
            nothing, nothing is learned; where all are masked out, the state comes back as it was.
        act_fake: as ``act`` but in dreams, where exploring costs nothing; None: as ``act``.
        update_fake: as ``update`` from fake episodes, for a learner that keeps the two apart;
            None: as ``update``.
        update_expert: as ``update`` from real episodes that another acted in
            (`jaxdyna.dyna.Expert`), None: as ``update``.
        num_actions: how many actions it chooses from, or which (`jaxdyna.actions`), so that it is
            not put into a world of others; None: not said.
        hparams: the class of its hparams, or a tuple of those it takes; None: not said.
        act_greedy: as ``act`` without exploring, as it is evaluated; None: as ``act``.
    """

    init: Callable[[Key, Any], Any]
    act: Act
    update: Update
    act_fake: Act | None = None
    update_fake: Update | None = None
    update_expert: Update | None = None
    num_actions: Any = None
    hparams: Any = None
    act_greedy: Act | None = None


class Memory(NamedTuple):
    """How real transitions are kept for the model: `jaxdyna.replay.memory.transitions`,
    `jaxdyna.replay.memory.frames`.

    Attributes:
        init: ``(capacity, episodes, example, recorded) -> memory``: an empty one for so many
            transitions and episodes like the example ``[...]`` and what is recorded of one.
        add: ``(memory, transitions, recorded, number) -> memory`` with whole episodes ``[N, T]``,
            what was recorded of their steps (`jaxdyna.dyna.Dyna.record`) and the first's number.
        draw: ``(memory, key, shape, rare_share) -> numbers`` of transitions, int ``shape``, a share
            of them, or more, of rare ones (the memory knows which); None draws all alike.
        take: ``(memory, numbers) -> transitions`` with the numbers' axes leading.
        forget: ``(memory, when) -> memory``: emptied where ``when`` is true.
        shared: ``agent_state -> memory``: where the agent has a replay of its real episodes that
            serves as this one, so that they are remembered once; None: it has none.
    """

    init: Callable[[int, int, Any, Any], Any]
    add: Callable[[Any, Transition, Any, jax.Array], Any]
    draw: Callable[[Any, Key, tuple[int, ...], float | None], jax.Array]
    take: Callable[[Any, jax.Array], Transition]
    forget: Callable[[Any, jax.Array], Any]
    shared: Callable[[Any], Any] | None = None

    def of(self, state: Any) -> Any:
        """The memory of a `jaxdyna.dyna.DynaState`."""
        if self.shared is None or state.replay is not None:
            return state.replay
        return self.shared(state.agent)


class Prediction(NamedTuple):
    """What a dynamics model expects of one step.

    Attributes:
        next_obs: ``[*obs]``.
        reward: scalar.
        terminated: probability that the step ends the episode, a scalar in [0, 1].
        uncertainty: how far from the truth the model expects to be, a scalar, in units that the
            model says; 0 of one that does not know.
    """

    next_obs: jax.Array
    reward: jax.Array
    terminated: jax.Array
    uncertainty: jax.Array


class DynamicsModel(NamedTuple):
    """A learner of the world, as three pure functions.

    Attributes:
        init: ``(key, hparams) -> state``; ``state.params`` is what ``predict`` takes.
        predict: ``(params, obs, action, key) -> Prediction`` for one observation and action.
        update: ``(state, transitions, key, hparams) -> (state, metrics)``: one gradient step on
            transitions with any leading axes, weighed by their ``weight``.
        num_actions: as an agent's.
        hparams: likewise.
    """

    init: Callable[[Key, Any], Any]
    predict: Callable[[Any, jax.Array, jax.Array, Key], Prediction]
    update: Update
    num_actions: Any = None
    hparams: Any = None
