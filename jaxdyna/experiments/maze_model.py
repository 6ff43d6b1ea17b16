"""Training a frame model on a random policy's episodes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp

from jaxdyna import frame_replay
from jaxdyna.envs.maze import MOVES
from jaxdyna.experiments.frame_study import Run, Study
from jaxdyna.experiments.maze_judge import Judgement, judge, make_model, predictor
from jaxdyna.experiments.maze_options import Options, Training, config_of, training_of, world
from jaxdyna.frame_replay import FrameReplay
from jaxdyna.models import PixelHParams
from jaxdyna.replay import share_weight
from jaxdyna.rollout import rollout
from jaxdyna.types import DynamicsModel, Key, Transition


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


def make_study(options: Options, arm: str) -> Study:
    """Training on the first so many episodes, the stage. A key gives every arm and stage the same
    episodes, and the same ones held out.
    """
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
        return run, judge(options, predictor(options, config), run.state.params, new, now)

    return Study(init, train, judged)


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
        reward = held.rest["reward"]
        weight = share_weight(held.held, jnp.stack([reward < 0, reward > 0]), training.rare_share)

    def update(number: jax.Array, carry: Any) -> Any:
        state, total = carry
        key_sample, key_update = jax.random.split(jax.random.fold_in(key, number))
        batch = frame_replay.sample(held, key_sample, (training.batch,), weight)
        rate = 0.5 * (1 + jnp.cos(jnp.pi * number / whole)) * training.learning_rate
        state, losses = model.update(state, batch, key_update, PixelHParams(rate))
        return state, total + losses["frame_loss"]

    state, total = jax.lax.fori_loop(first, end, update, (state, jnp.float32(0)))
    return state, total / jnp.maximum(end - first, 1)
