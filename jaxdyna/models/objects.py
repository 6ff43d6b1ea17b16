"""A model of worlds that are seen as a rectangle a channel: categories for their edges.

It is a frame model like `jaxdyna.models.pixels`, frames in and frames out, that believes in places
instead of shades: every edge comes to lie somewhere, one of a few places, as the tokens of a
discrete world model do (Micheli et al. 2023).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import chex
import jax
import jax.numpy as jnp
import optax

from jaxdyna.fields import Checked, check_counts, check_shape, setting
from jaxdyna.networks import RectangleDynamics, Resolution
from jaxdyna.networks.objects import EdgeOdds, Rectangles, drawn, rectangles_of
from jaxdyna.optimizers import Optimizer, Trained, optimizer_setting
from jaxdyna.trees import where
from jaxdyna.types import DynamicsModel, Key, Prediction, Transition, check_transitions


@dataclass(frozen=True)
class RectangleConfig(Checked):
    """What decides the program."""

    told: Resolution = setting(
        Resolution(),
        help="How finely places and moves are told, and the most that a thing moves in a step.",
        at_least=1,
    )
    groups: tuple[tuple[int, ...], ...] = setting(
        ((0,), (1,), (2,)), "Channels that are decided together, one group after the other.",
        at_least=0)  # fmt: skip
    hidden: tuple[int, ...] = setting(
        (256, 256), "Widths of each group's perceptron.", at_least=1, everyday=True
    )
    dropout: float = setting(
        0.0, "Share of the features that a gradient step does without.", at_least=0, below=1
    )
    draws: bool = setting(
        False, "Draw one of the possible futures; False takes each edge's likeliest place."
    )
    rewards: tuple[float, ...] = setting((-1.0, 0.0, 1.0), "All that a step can earn.")
    reward_weight: float = setting(
        1.0, "Weight of the reward's cross-entropy beside the edges'.", at_least=0
    )
    optimizer: Optimizer = optimizer_setting(optax.adam)


def rectangles(
    frame_shape: tuple[int, int, int],
    num_actions: int,
    config: RectangleConfig,
    num_frames: int = 4,
) -> DynamicsModel:
    """A model of stacked frames in each of whose channels one rectangle is lit, or nothing;
    `ValueError` where ``config.groups`` are not the channels.

    The arguments are those of `jaxdyna.models.pixels`; a pixel is lit from 128 on.

    Returns:
        A `DynamicsModel` whose hparams have a ``learning_rate``. ``predict`` returns the next
        stack, its new frame with every channel 0 or 255, one of ``config.rewards``, no end, and for
        the uncertainty the number of edges that it expects to be wrong.
    """
    check_counts(num_actions=num_actions, num_frames=num_frames)
    module, (height, width, channels) = _module(frame_shape, config), frame_shape

    def init(key: Key, hparams: Any) -> Trained:
        stack = jnp.zeros((1, height, width, channels * num_frames), jnp.uint8)
        past = rectangles_of(stack, channels)
        variables = module.init(key, past, jnp.zeros((1, num_actions)), _likeliest)
        optimizer = config.optimizer(hparams.learning_rate)
        return Trained(variables, optimizer.init(variables["params"]))

    def predict(params: Any, obs: jax.Array, action: jax.Array, key: Key) -> Prediction:
        chex.assert_rank([obs, action], [3, 0])
        past = rectangles_of(obs[None], channels)
        one_hot = jax.nn.one_hot(jnp.array([action]), num_actions)
        settle = _drawing(key) if config.draws else _likeliest
        odds, then, outcome = module.apply(params, past, one_hot, settle)  # type: ignore[misc]
        frame = jnp.where(drawn(then, (height, width))[0], 255, 0).astype(obs.dtype)
        return Prediction(
            next_obs=jnp.concatenate([obs[..., channels:], frame], axis=-1),
            reward=jnp.array(config.rewards)[outcome.argmax(-1)[0]],
            terminated=jnp.float32(0),
            uncertainty=_expected_wrong(odds, then)[0],
        )

    return DynamicsModel(init, predict, _learner(module, num_actions, config), num_actions)


def rectangle_probability(
    frame_shape: tuple[int, int, int], num_actions: int, config: RectangleConfig
) -> Callable[[Any, jax.Array, jax.Array], jax.Array]:
    """What a model of `rectangles` with these arguments believes of each pixel, the things of
    earlier groups taken to be where they are likeliest:
    ``(params, obs [N, H, W, C * frames], action [N]) -> [N, H, W, C]`` in [0, 1].
    """
    module = _module(frame_shape, config)

    def lit(places: jax.Array) -> jax.Array:
        first, last = jnp.moveaxis(jnp.cumsum(jnp.exp(places), axis=-1), -2, 0)
        return jnp.clip(first - last + jnp.exp(places[..., 1, :]), 0, 1)

    def probability(params: Any, obs: jax.Array, action: jax.Array) -> jax.Array:
        past = rectangles_of(obs, frame_shape[-1])
        one_hot = jax.nn.one_hot(action, num_actions)
        odds: Any = module.apply(params, past, one_hot, _likeliest)[0]
        seen = jax.nn.sigmoid(odds.seen)
        return jnp.einsum("nc,nch,ncw->nhwc", seen, lit(odds.rows), lit(odds.columns))

    return probability


def _module(frame_shape: tuple[int, int, int], config: RectangleConfig) -> RectangleDynamics:
    check_shape(3, frame_shape=frame_shape)
    channels = frame_shape[-1]
    if sorted(channel for group in config.groups for channel in group) != list(range(channels)):
        raise ValueError(f"groups are {config.groups}: name each of the {channels} channels once")
    return RectangleDynamics(
        frame_shape[:2], config.told, config.groups, config.hidden, config.dropout,
        len(config.rewards))  # fmt: skip


def _learner(
    module: RectangleDynamics, num_actions: int, config: RectangleConfig
) -> Callable[..., tuple[Trained, dict[str, jax.Array]]]:
    """The model's ``update``."""

    def update(
        state: Trained, transitions: Transition, key: Key, hparams: Any
    ) -> tuple[Trained, dict[str, jax.Array]]:
        """One gradient step; ``metrics`` are the mean losses of a transition."""
        check_transitions(transitions)
        lead, channels = transitions.mask.ndim, len(sum(config.groups, ()))
        batch = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[lead:]), transitions)
        batch, weight = batch.blanked(), batch.weights
        past = rectangles_of(batch.obs, channels)
        after = rectangles_of(batch.next_obs[..., -channels:], channels)
        truth = Rectangles(after.edge[:, 0], after.seen[:, 0])
        one_hot = jax.nn.one_hot(batch.action, num_actions)

        def true(odds: EdgeOdds, group: Sequence[int]) -> Rectangles:
            at = jnp.array(group)
            return Rectangles(truth.edge[:, at], truth.seen[:, at])

        def loss_fn(params: Any) -> tuple[jax.Array, dict[str, jax.Array]]:
            odds, _, outcome = module.apply({"params": params}, past, one_hot, true, key)  # type: ignore[misc]
            apart = jnp.abs(batch.reward[:, None] - jnp.array(config.rewards))
            kind = apart.argmin(-1)
            parts = {
                "frame_loss": surprise(odds, truth).sum(-1),
                "reward_loss": optax.softmax_cross_entropy_with_integer_labels(outcome, kind),
            }
            scale = jnp.maximum(weight.sum(), 1e-6)
            means = {name: (weight * part).sum() / scale for name, part in parts.items()}
            return means["frame_loss"] + config.reward_weight * means["reward_loss"], means

        grads_of = jax.value_and_grad(loss_fn, has_aux=True)
        (loss, means), grads = grads_of(state.params["params"])
        optimizer = config.optimizer(hparams.learning_rate)
        updates, opt_state = optimizer.update(grads, state.opt_state, state.params["params"])
        trained = optax.apply_updates(state.params["params"], updates)
        new = Trained({"params": trained}, opt_state)
        return where((weight > 0).any(), new, state), {"loss": loss, **means}

    return update


def surprise(odds: EdgeOdds, truth: Rectangles) -> jax.Array:
    """The cross-entropy of each thing, in nats: whether it is there and, where it is, of its four
    edges; what is believed, what there is and the outcome are all ``[N, C]``.
    """
    places = jnp.concatenate(
        [-_at(odds.rows, truth.edge[..., :2]), -_at(odds.columns, truth.edge[..., 2:])], axis=-1
    )
    there = truth.seen.astype(jnp.float32)
    unseen = optax.sigmoid_binary_cross_entropy(odds.seen, there)
    return unseen + there * places.sum(-1)


def _at(places: jax.Array, edge: jax.Array) -> jax.Array:
    """The logarithms ``[..., size]`` at these places ``[...]``."""
    return jnp.take_along_axis(places, edge[..., None], axis=-1)[..., 0]


def _expected_wrong(odds: EdgeOdds, then: Rectangles) -> jax.Array:
    """How many edges are expected elsewhere than they have been put, ``[N]``; a thing that is not
    there has one.
    """
    rows, columns = _at(odds.rows, then.edge[..., :2]), _at(odds.columns, then.edge[..., 2:])
    wrong = (1 - jnp.exp(rows)).sum(-1) + (1 - jnp.exp(columns)).sum(-1)
    unsure = jax.nn.sigmoid(jnp.where(then.seen, -odds.seen, odds.seen))
    return (unsure + then.seen * wrong).sum(-1)


def _likeliest(odds: EdgeOdds, group: Sequence[int]) -> Rectangles:
    edge = jnp.concatenate([odds.rows.argmax(-1), odds.columns.argmax(-1)], axis=-1)
    return _tidy(edge, odds.seen > 0)


def _drawing(key: Key) -> Callable[[EdgeOdds, Sequence[int]], Rectangles]:
    """Draws; the two edges of an axis by the same number, so that they move together."""

    def settle(odds: EdgeOdds, group: Sequence[int]) -> Rectangles:
        keys = jax.random.split(jax.random.fold_in(key, group[0]), 3)

        def place(key: Key, places: jax.Array) -> jax.Array:
            number = jax.random.uniform(key, (*places.shape[:-2], 1, 1))
            below = (jnp.cumsum(jnp.exp(places), axis=-1) < number).sum(-1)
            return jnp.minimum(below, places.shape[-1] - 1)

        edge = jnp.concatenate([place(keys[0], odds.rows), place(keys[1], odds.columns)], axis=-1)
        return _tidy(edge, jax.random.uniform(keys[2], odds.seen.shape) < jax.nn.sigmoid(odds.seen))

    return settle


def _tidy(edge: jax.Array, seen: jax.Array) -> Rectangles:
    """No last edge before the first; zeros where there is nothing."""
    first, last = edge[..., ::2], edge[..., 1::2]
    edge = jnp.stack([first, jnp.maximum(first, last)], axis=-1).reshape(edge.shape)
    return Rectangles(jnp.where(seen[..., None], edge, 0).astype(jnp.int32), seen)
