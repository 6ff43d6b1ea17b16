"""Training a frame model on a random policy's episodes, and judging it on new ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna import frame_replay
from jaxdyna.envs.maze import MOVES
from jaxdyna.experiments.maze_options import (
    DREAM_FROM,
    Options,
    Training,
    config_of,
    training_of,
    world,
)
from jaxdyna.frame_replay import FrameReplay
from jaxdyna.models import PixelConfig, PixelHParams, frame_probability, pixels
from jaxdyna.models.evaluation import open_loop
from jaxdyna.replay import share_weight
from jaxdyna.rollout import rollout
from jaxdyna.types import DynamicsModel, Key, Transition

CLASSES = {"agent": 2, "obstacles": 0, "goal": 1}
CHANNELS = np.array(list(CLASSES.values()))
THRESHOLDS = np.round(np.arange(0.05, 0.96, 0.05), 2)
REWARD_KINDS = ("collision", "goal", "neither")

Judgement = dict[str, jax.Array]


class Run(NamedTuple):
    """A run between two pieces of its training.

    Attributes:
        data: all its episodes, which a key gives again; None in a checkpoint.
        key: random key.
        state: the model's.
        done: int32, updates so far.
    """

    data: Any
    key: Key
    state: Any
    done: jax.Array


def random_act(obs: jax.Array, key: Key) -> jax.Array:
    """A uniformly random action."""
    return jax.random.randint(key, (), 0, len(MOVES))


def collect(options: Options, key: Key, episodes: int) -> FrameReplay:
    """A replay of so many of the random policy's episodes."""
    env, params = world(options)

    def play(key: Key) -> Transition:
        return rollout(env, random_act, key, params, 1, num_steps=options.steps)

    example = jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct(leaf.shape[2:], leaf.dtype), jax.eval_shape(play, key)
    )
    empty = frame_replay.init(episodes * options.steps, episodes, example)

    def more(carry: tuple[FrameReplay, Key], _: None) -> tuple[tuple[FrameReplay, Key], None]:
        held, key = carry
        key, key_play = jax.random.split(key)
        return (frame_replay.add(held, play(key_play)), key), None

    return jax.lax.scan(more, (empty, key), length=episodes)[0][0]


def first_episodes(held: FrameReplay, episodes: Any, steps: int) -> FrameReplay:
    """The replay as it was after so many (traced) episodes, which all lasted to their horizon."""
    count = jnp.asarray(episodes, jnp.int32)
    return replace(held, added=count * steps, episodes_added=count)


class Study(NamedTuple):
    """An arm's training at a stage, for `jaxdyna.sweep.make_pieces`. The stage, a number of
    episodes, and numbers of updates are traced: all stages are one program.

    Attributes:
        init: ``(key, hparams) -> run``: before its first update.
        train: ``(run, (stage, updates, total), hparams) -> (run, losses)``: so many more of the
            stage's ``total`` of updates, on the first ``stage`` episodes.
        judge: ``(run, stage, hparams) -> (run, judgement)``.
    """

    init: Callable[[Key, Any], Run]
    train: Callable[[Run, Any, Any], tuple[Run, Judgement]]
    judge: Callable[[Run, Any, Any], tuple[Run, Judgement]]


def make_study(options: Options, arm: str) -> Study:
    """A key gives every arm and stage the same episodes, and the same ones held out."""
    config, training = config_of(options, arm), training_of(options, arm)
    env, params = world(options)
    model = make_model(options, config)
    hparams = PixelHParams(training.learning_rate)

    def init(key: Key, _: Any) -> Run:
        key, key_init, key_data = jax.random.split(key, 3)
        data = collect(options, key_data, options.episodes)
        return Run(data, key, model.init(key_init, hparams), jnp.int32(0))

    def train(run: Run, work: Any, _: Any) -> tuple[Run, Judgement]:
        stage, updates, total = work
        key, _ = jax.random.split(jax.random.clone(run.key))
        held = first_episodes(run.data, stage, options.steps)
        span = (run.done, run.done + updates)
        state, loss = _train(model, training, held, run.state, key, (*span, total))
        return run._replace(state=state, done=span[1]), {"frame_loss": loss}

    def judged(run: Run, stage: Any, _: Any) -> tuple[Run, Judgement]:
        _, key = jax.random.split(jax.random.clone(run.key))
        key_new, key_judge = jax.random.split(key)
        new = rollout(env, random_act, key_new, params, options.held_out, num_steps=options.steps)
        now = jax.random.fold_in(key_judge, stage)
        return run, judge(options, arm, run.state.params, new, now)

    return Study(init, train, judged)


def make_model(options: Options, config: PixelConfig) -> DynamicsModel:
    """A model of the experiment's maze."""
    return pixels((options.size, options.size, 3), len(MOVES), config)


def _train(
    model: DynamicsModel,
    training: Training,
    held: FrameReplay,
    state: Any,
    key: Key,
    span: tuple[jax.Array, jax.Array, jax.Array],
) -> tuple[Any, jax.Array]:
    """The updates from a number up to another, that one left out, of so many in all (traced);
    returns the model's state and their mean loss.
    """
    first, end, whole = span
    weight = None
    if training.rare_share is not None:
        weight = share_weight(held.held, held.rest["reward"] != 0, training.rare_share)

    def update(number: jax.Array, carry: Any) -> Any:
        state, total = carry
        key_sample, key_update = jax.random.split(jax.random.fold_in(key, number))
        batch = frame_replay.sample(held, key_sample, (training.batch,), weight)
        rate = 0.5 * (1 + jnp.cos(jnp.pi * number / whole)) * training.learning_rate
        hparams: Any = {"learning_rate": rate}
        state, losses = model.update(state, batch, key_update, PixelHParams(**hparams))
        return state, total + losses["frame_loss"]

    state, total = jax.lax.fori_loop(first, end, update, (state, jnp.float32(0)))
    return state, total / jnp.maximum(end - first, 1)


def judge(options: Options, arm: str, params: Any, new: Transition, key: Key) -> Judgement:
    """Counts over new episodes, from which `scores` follow.

    Args:
        options: the experiment's.
        arm: whose model it is.
        params: the model's.
        new: episodes ``[N, T]``.
        key: random key.

    Returns:
        ``one_step`` ``[thresholds, classes, 3]``: pixels rightly lit, lit, and to be lit; ``mass``
        ``[classes, 2]``: sums of a belief and of its square; ``reward`` ``[kinds, 2]``: rewards
        right to within 0.5, and all; ``dream_lit`` and ``dream_drawn`` ``[horizon, classes, 3]``
        as ``one_step`` for open-loop dreams; ``seen``, ``truth`` and ``belief`` of two steps;
        ``film_truth`` and ``film_dream`` ``[horizon, H, W, 3]``.
    """
    key_reward, key_lit, key_drawn = jax.random.split(key, 3)
    config = config_of(options, arm)
    model = make_model(options, config)
    drawing = make_model(options, replace(config, threshold=None))
    believe = frame_probability(len(MOVES), config)

    def one_by_one(key: Key, episode: Transition) -> tuple[Key, Judgement]:
        key, key_now = jax.random.split(key)
        return key, _one_step(model, believe, params, episode, key_now)

    totals = jax.lax.scan(one_by_one, key_reward, new)[1]
    judgement = jax.tree.map(lambda leaf: leaf.sum(0), totals)
    span = slice(DREAM_FROM, DREAM_FROM + options.horizon)
    truth = new.next_obs[:, span, ..., -3:]

    def dream(kind: DynamicsModel, key: Key) -> jax.Array:
        def one(obs: jax.Array, action: jax.Array, key: Key) -> jax.Array:
            return open_loop(kind.predict, params, obs, action, key).next_obs[..., -3:]

        keys = jax.random.split(key, options.held_out)
        return jax.vmap(one)(new.obs[:, DREAM_FROM], new.action[:, span], keys)

    lit, drawn = dream(model, key_lit), dream(drawing, key_drawn)
    shown = jax.tree.map(lambda leaf: leaf[0, DREAM_FROM - 2 : DREAM_FROM], new)
    return judgement | {
        "dream_lit": _counts(lit > 0, truth > 0, (0, 2, 3)),
        "dream_drawn": _counts(drawn > 0, truth > 0, (0, 2, 3)),
        "seen": shown.obs,
        "truth": shown.next_obs[..., -3:],
        "belief": believe(params, shown.obs, shown.action),
        "film_truth": truth[0],
        "film_dream": lit[0],
    }


def _one_step(
    model: DynamicsModel, believe: Callable[..., jax.Array], params: Any, one: Transition, key: Key
) -> Judgement:
    """The counts of one episode ``[T]``."""
    belief = believe(params, one.obs, one.action)
    lit = belief > THRESHOLDS[:, None, None, None, None]
    keys = jax.random.split(key, one.action.shape[0])
    reward = jax.vmap(model.predict, (None, 0, 0, 0))(params, one.obs, one.action, keys).reward
    right = jnp.abs(reward - one.reward) < 0.5
    kinds = jnp.stack([one.reward < 0, one.reward > 0, one.reward == 0])
    mass = jnp.stack([belief.sum((0, 1, 2)), jnp.square(belief).sum((0, 1, 2))], axis=-1)
    return {
        "one_step": _counts(lit, one.next_obs[..., -3:] > 0, (1, 2, 3)),
        "mass": mass[CHANNELS],
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
