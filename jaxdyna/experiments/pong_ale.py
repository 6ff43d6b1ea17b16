"""Episodes of the Atari 2600 game to learn frames from: a host loop over copies of it."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna.envs import Palette
from jaxdyna.envs.gymnasium import make_atari
from jaxdyna.envs.pong_screen import masks_by_colour
from jaxdyna.experiments.pong_data import (
    Played,
    Player,
    View,
    choose,
    draw_player,
    middle_row,
    stacked,
)
from jaxdyna.experiments.pong_judge import OBJECTS
from jaxdyna.experiments.pong_options import POLICIES, Options
from jaxdyna.types import Key

VIEW = View(frame=lambda frame: frame, objects=lambda frame: frame > 127)
"""The frames themselves; an object is where its colour is."""
COPIES = 8


def collect_all(options: Options) -> tuple[Played, Played]:
    """What every seed learns from, the episodes of one policy after those of the other, and its
    held-out episodes of the mixed one, with leading axes ``[1, seeds]``.
    """
    learned, held_out = [], []
    for number in range(options.seeds):
        key = jax.random.fold_in(jax.random.key(options.seed), number)
        key_random, key_mixed, key_new = jax.random.split(key, 3)
        by_policy = {"random": key_random, "mixed": key_mixed}
        parts = [
            collect(options, options.episodes, policy == "mixed", by_policy[policy])
            for policy in POLICIES
        ]
        learned.append(jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts))
        held_out.append(collect(options, options.held_out, True, key_new))

    def by_seed(episodes: list[Played]) -> Played:
        return jax.tree.map(lambda *leaves: np.stack(leaves)[None], *episodes)

    return by_seed(learned), by_seed(held_out)


def collect(options: Options, episodes: int, mixed: bool, key: Key) -> Played:
    """Episodes ``[N, T]`` by the random or the mixed policy, each from a new game's start, as many
    at a time as there are copies.

    Raises:
        ImportError: without the ``atari`` extra.
    """
    copies = min(COPIES, episodes)
    envs = make_atari(
        "Pong", copies, frameskip=options.frame_skip, repeat_action_probability=0.0, obs_type="rgb"
    )
    parts: list[Any] = []
    for batch in range(-(-episodes // copies)):
        key, key_batch = jax.random.split(key)
        parts.append(_play(envs, options, mixed, batch, key_batch))
    envs.close()
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:episodes], *parts)


def _play(envs: Any, options: Options, mixed: bool, seed: int, key: Key) -> Played:
    """One episode of every copy."""
    key_players, key_steps = jax.random.split(key)
    players = jax.vmap(draw_player, (0, None))(jax.random.split(key_players, envs.num_envs), mixed)
    screen, _ = envs.reset(seed=seed)
    frames, actions, rewards = [], [], []
    for key_step in jax.random.split(key_steps, options.steps):
        keys = jax.random.split(key_step, envs.num_envs)
        frame, action = _see_and_act(options.scale, screen, players, keys)
        frames.append(np.asarray(frame))
        actions.append(np.asarray(action))
        screen, reward, terminated, *_ = envs.step(actions[-1])
        rewards.append(np.asarray(reward, np.float32))
        if terminated.any():
            raise ValueError(
                f"--steps is {options.steps}: a game of 21 points ended within it, give fewer"
            )
    frames.append(np.asarray(reduced(screen, options.scale)))
    in_time: Any = (np.stack(leaves, axis=1) for leaves in (frames, actions, rewards))
    return Played(*in_time)


def reduced(screen: jax.Array, scale: int) -> jax.Array:
    """Screens uint8 ``[..., 210, 160, 3]`` as frames of the field ``[..., 160 / scale, 160 / scale,
    3]``, each object in a channel of its own.
    """
    return 255 * stacked(masks_by_colour(screen, scale, Palette())).astype(jnp.uint8)


@partial(jax.jit, static_argnums=0)
def _see_and_act(
    scale: int, screen: jax.Array, players: Player, keys: Key
) -> tuple[jax.Array, jax.Array]:
    """The frames ``[N, H, W, 3]`` and what the players do."""
    frames = reduced(screen, scale)

    def act(player: Player, frame: jax.Array, key: Key) -> jax.Array:
        ball, seen = middle_row(frame[..., OBJECTS["ball"]] > 0, scale)
        own, _ = middle_row(frame[..., OBJECTS["own paddle"]] > 0, scale)
        return choose(player, ball, own, seen, key)

    return frames, jax.vmap(act)(players, frames, keys)
