"""Training a frame model of Pong on the episodes of a random or a mixed policy."""

from __future__ import annotations

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp

from jaxdyna.envs.pong_screen import mixture_of, shares_of
from jaxdyna.experiments import pong_ale
from jaxdyna.experiments.frame_study import Run, Study
from jaxdyna.experiments.pong_colours import in_channels, in_colours
from jaxdyna.experiments.pong_data import Played, View, play, sample, view_of
from jaxdyna.experiments.pong_judge import Asked, Judgement, judge
from jaxdyna.experiments.pong_options import (
    PALETTES,
    POLICIES,
    Options,
    adversary_config,
    config_of,
    game_of,
    params_of,
    training_of,
)
from jaxdyna.models import (
    AdversarialHParams,
    PixelHParams,
    RectangleConfig,
    discriminator,
    frame_probability,
    pixels,
    rectangle_probability,
    rectangles,
)
from jaxdyna.types import DynamicsModel, Key


def make_study(options: Options, arm: str) -> Study:
    """Training on the episodes of one policy, the stage, a position in `POLICIES`. A key gives
    every arm the same episodes, and the same ones held out.
    """
    model, asked = make_model(options, arm)
    if options.game == "ale":
        return _real_study(options, arm, model, asked)
    view = view_of(game_of(options))

    def collect(key: Key) -> tuple[Played, Played]:
        game, params, steps = game_of(options), params_of(options), options.steps
        key_random, key_mixed, key_new = jax.random.split(key, 3)

        def episodes(count: int, policy: str, key: Key) -> Played:
            return play(game, params, steps, count, policy == "mixed", key)

        by_policy = {"random": key_random, "mixed": key_mixed}
        parts = [episodes(options.episodes, policy, by_policy[policy]) for policy in POLICIES]
        joined = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
        return joined, episodes(options.held_out, "mixed", key_new)

    def init(key: Key, _: Any) -> Run:
        key, key_init, key_data = jax.random.split(key, 3)
        state = model.init(key_init, _hparams(options, arm, 0.0))
        return Run(collect(key_data), key, state, jnp.int32(0))

    return Study(init, *make_phases(options, arm, model, asked, view))


def _real_study(options: Options, arm: str, model: DynamicsModel, asked: Asked) -> Study:
    """The same on the real game's episodes, which a host collects."""

    def init(key: Key, _: Any) -> Run:
        key, key_init = jax.random.split(key)
        state = model.init(key_init, _hparams(options, arm, 0.0))
        return Run(None, key, state, jnp.int32(0))

    phases = make_phases(options, arm, model, asked, pong_ale.view_in(PALETTES[options.frames]))
    return Study(init, *phases, data=lambda: real_episodes(options))


@cache
def real_episodes(options: Options) -> Any:
    """The real game's episodes, collected once for all arms."""
    return pong_ale.collect_all(options)


def make_phases(
    options: Options, arm: str, model: DynamicsModel, asked: Asked, view: View
) -> tuple[Any, Any]:
    """`Study.train` and `Study.judge` where `Run.data` is all episodes to learn from, those of the
    first of `POLICIES` before those of the next, and the held-out ones.
    """
    training = training_of(options, arm)

    def train(run: Run, work: Any, _: Any) -> tuple[Run, Judgement]:
        stage, updates, whole = work
        key, _ = jax.random.split(jax.random.clone(run.key))
        played, end = run.data[0], run.done + updates

        def update(number: jax.Array, carry: Any) -> Any:
            state, total = carry
            key_sample, key_update = jax.random.split(jax.random.fold_in(key, number))
            first = stage * options.episodes
            batch = sample(view, played, first, options.episodes, key_sample, training.batch)
            rate = 0.5 * (1 + jnp.cos(jnp.pi * number / whole)) * training.learning_rate
            state, losses = model.update(state, batch, key_update, _hparams(options, arm, rate))
            return state, total + losses["frame_loss"]

        state, total = jax.lax.fori_loop(run.done, end, update, (run.state, jnp.float32(0)))
        loss = total / jnp.maximum(updates, 1)
        return run._replace(state=state, done=end), {"frame_loss": loss}

    def judged(run: Run, stage: Any, _: Any) -> tuple[Run, Judgement]:
        _, key = jax.random.split(jax.random.clone(run.key))
        key, new = jax.random.fold_in(key, stage), run.data[1]
        starts, horizon = options.dream_starts, options.horizon
        return run, judge(asked, run.state.params, view, new, starts, horizon, key)

    return train, judged


def make_model(options: Options, arm: str) -> tuple[DynamicsModel, Asked]:
    """The arm's model, and what is asked of it."""
    game, config = game_of(options), config_of(options, arm)
    shape, actions = game.frame_shape, game.num_actions
    if isinstance(config, RectangleConfig):
        knows = rectangle_probability(shape, actions, config)
        model = in_colours(rectangles(shape, actions, config), game.palette)

        def believe(params: Any, obs: jax.Array, action: jax.Array) -> jax.Array:
            return knows(params, in_channels(obs, game.palette), action)

        def expect(*args: Any) -> jax.Array:
            return mixture_of(believe(*args), game.palette)

        return model, Asked(believe, expect, model.predict, 0.5)
    adversary = discriminator(shape, adversary_config(shape[0])) if arm == "adversarial" else None
    model = pixels(shape, actions, config, adversary=adversary)
    threshold = 0.5 if config.threshold is None else config.threshold
    frame = frame_probability(actions, config)

    def picture(*args: Any) -> jax.Array:
        return 255 * frame(*args)

    def seen(*args: Any) -> jax.Array:
        return shares_of(picture(*args), game.palette)

    return model, Asked(seen, picture, model.predict, threshold)


def _hparams(options: Options, arm: str, rate: Any) -> Any:
    if arm == "adversarial":
        return AdversarialHParams(rate, options.adversarial_weight, rate)
    return PixelHParams(rate)
