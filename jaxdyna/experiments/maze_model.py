"""Training a frame model on a random policy's episodes, and judging it on new ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna import frame_replay
from jaxdyna.envs import FrameStack, Maze, MazeParams
from jaxdyna.experiments.maze_options import Options, Training, config_of, training_of
from jaxdyna.frame_replay import FrameReplay
from jaxdyna.models import PixelHParams, frame_probability, pixels
from jaxdyna.models.evaluation import open_loop
from jaxdyna.replay import share_weight
from jaxdyna.rollout import rollout
from jaxdyna.types import DynamicsModel, Key, Transition

CLASSES = {"agent": 2, "obstacles": 0, "goal": 1}
CHANNELS = np.array(list(CLASSES.values()))
THRESHOLDS = np.round(np.arange(0.05, 0.96, 0.05), 2)
REWARD_KINDS = ("collision", "goal", "neither")
DREAM_FROM = 10
SHOWN = 4

ENV = FrameStack(Maze())
Judgement = dict[str, jax.Array]


def random_act(obs: jax.Array, key: Key) -> jax.Array:
    """A uniformly random action."""
    return jax.random.randint(key, (), 0, ENV.num_actions)


def collect(key: Key, episodes: int, steps: int) -> FrameReplay:
    """A replay of so many of the random policy's episodes."""
    params = MazeParams(max_steps=steps)

    def play(key: Key) -> Transition:
        return rollout(ENV, random_act, key, params, 1, num_steps=steps)

    example = jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct(leaf.shape[2:], leaf.dtype), jax.eval_shape(play, key)
    )
    empty = frame_replay.init(episodes * steps, episodes, example)

    def more(carry: tuple[FrameReplay, Key], _: None) -> tuple[tuple[FrameReplay, Key], None]:
        held, key = carry
        key, key_play = jax.random.split(key)
        return (frame_replay.add(held, play(key_play)), key), None

    return jax.lax.scan(more, (empty, key), length=episodes)[0][0]


class Study(NamedTuple):
    """An arm's training from stage to stage, for `jaxdyna.sweep.make_pieces`.

    Attributes:
        init: ``(key, hparams) -> state``: a run before its first stage.
        advance: ``(state, stage, hparams) -> (state, judgement)``: goes on training the model on
            the first ``stage`` episodes (traced: every stage is the same program), and judges it.
    """

    init: Callable[[Key, Any], Any]
    advance: Callable[[Any, Any, Any], tuple[Any, Judgement]]


def make_study(options: Options, arm: str) -> Study:
    """A key gives the same episodes, and the same ones held out, to every arm and stage."""
    config, training = config_of(options, arm), training_of(options, arm)
    model = pixels((16, 16, 3), ENV.num_actions, config)
    hparams = PixelHParams(training.learning_rate)

    def init(key: Key, _: Any) -> Any:
        key, key_init = jax.random.split(key)
        return key, model.init(key_init, hparams)

    def advance(run: Any, stage: Any, _: Any) -> Any:
        key, state = run
        key_data, key_new, key_stage = jax.random.split(jax.random.clone(key), 3)
        key_train, key_judge = jax.random.split(jax.random.fold_in(key_stage, stage))
        held = collect(key_data, options.episodes, options.steps)
        # Every episode lasts to its horizon: this is the replay as it was after so many of them.
        held = replace(
            held, added=stage * options.steps, episodes_added=jnp.asarray(stage, jnp.int32)
        )
        state, losses = _train(model, training, hparams, held, state, key_train)
        params = MazeParams(max_steps=options.steps)
        new = rollout(ENV, random_act, key_new, params, options.held_out, num_steps=options.steps)
        return (key, state), judge(options, arm, state.params, new, key_judge) | losses

    return Study(init, advance)


def _train(
    model: DynamicsModel,
    training: Training,
    hparams: PixelHParams,
    held: FrameReplay,
    state: Any,
    key: Key,
) -> tuple[Any, Judgement]:
    """The updates of one stage; returns the model's state and its loss at the end."""
    weight = None
    if training.rare_share is not None:
        weight = share_weight(held.held, held.rest["reward"] != 0, training.rare_share)

    def update(carry: Any, _: Any) -> Any:
        state, key = carry
        key, key_sample, key_update = jax.random.split(key, 3)
        batch = frame_replay.sample(held, key_sample, (training.batch,), weight)
        state, losses = model.update(state, batch, key_update, hparams)
        return (state, key), losses["frame_loss"]

    (state, _), losses = jax.lax.scan(update, (state, key), length=training.updates)
    return state, {"last_loss": losses[-min(100, training.updates) :].mean()}


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
        as ``one_step`` for open-loop dreams; ``seen``, ``truth`` and ``belief`` of a few steps;
        ``film_truth`` and ``film_dream`` ``[horizon, H, W, 3]``.
    """
    key_reward, key_lit, key_drawn = jax.random.split(key, 3)
    config = config_of(options, arm)
    model = pixels((16, 16, 3), ENV.num_actions, config)
    drawing = pixels((16, 16, 3), ENV.num_actions, replace(config, threshold=None))
    believe = frame_probability(ENV.num_actions, config)

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
    shown = jax.tree.map(lambda leaf: leaf[0, DREAM_FROM + 10 * np.arange(SHOWN)], new)
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
