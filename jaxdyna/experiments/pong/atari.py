"""Episodes of the Atari 2600 game to learn frames from."""

from __future__ import annotations

from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna.envs import AtariParams, AtariPong, Palette
from jaxdyna.envs.pong_rules import FIELD
from jaxdyna.envs.pong_screen import picture_of
from jaxdyna.experiments.engine import InputError
from jaxdyna.experiments.pong.data import Played, View, choose, draw_player
from jaxdyna.experiments.pong.world import OBJECTS
from jaxdyna.types import Key

BITS = np.arange(3, dtype=np.uint8)
COPIES = 32


class Episodes(NamedTuple):
    """What is played for each run.

    Attributes:
        game: which.
        steps: of each episode.
        episodes: to learn from.
        held_out: new ones of the mixed policy.
    """

    game: AtariPong
    steps: int
    episodes: int
    held_out: int


def packed(frame: jax.Array) -> jax.Array:
    """A frame ``[..., 3]`` whose channels are 0 or 255 in one byte a pixel: a thousand episodes of
    40x40 are 0.3 GB.
    """
    return ((frame > 127).astype(jnp.uint8) << BITS).sum(-1, dtype=jnp.uint8)


def objects(world: jax.Array) -> jax.Array:
    """Where its objects are, bool ``[..., 3]``: where its colour is."""
    return ((world[..., None] >> BITS) & 1).astype(bool)


def view_in(palette: Palette) -> View:
    """How packed frames are seen in these colours."""

    def frame(world: jax.Array) -> jax.Array:
        return picture_of(objects(world), palette)

    return View(frame, objects)


@cache
def collected(
    asked: Episodes, runs: tuple[tuple[int, bool], ...], base: int
) -> tuple[Played, Played]:
    """What every run learns from and is judged on, with the axis of runs in front; ``runs`` are
    their numbers, and whether they learn from the mixed policy. The same for all models.
    """
    first = jax.random.key(base)
    parts = [_of_a_run(asked, mixed, jax.random.fold_in(first, seed)) for seed, mixed in runs]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *parts)


def _of_a_run(asked: Episodes, mixed: bool, key: Key) -> tuple[Played, Played]:
    key_random, key_mixed, key_new = jax.random.split(key, 3)
    key_learn = key_mixed if mixed else key_random
    return (
        collect(asked.game, asked.steps, asked.episodes, mixed, key_learn),
        collect(asked.game, asked.steps, asked.held_out, True, key_new),
    )


def collect(game: AtariPong, steps: int, episodes: int, mixed: bool, key: Key) -> Played:
    """Episodes ``[N, T]`` by the random or the mixed policy, each from a new game's start.

    Raises:
        InputError: where a game is over before an episode is.
    """
    parts, copies = [], min(COPIES, episodes)
    for _ in range(-(-episodes // copies)):
        key, key_now = jax.random.split(key)
        played, over = _play(game, steps, copies, mixed, key_now)
        if over.any():
            raise InputError(f"--steps is {steps}: a game of 21 points ended within it, give fewer")
        parts.append(jax.tree.map(np.asarray, played))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:episodes], *parts)


@partial(jax.jit, static_argnums=(0, 1, 2))
def _play(game: AtariPong, steps: int, copies: int, mixed: Any, key: Key) -> tuple[Played, Any]:
    """One episode of every copy, and whether a game has ended in it."""
    params = AtariParams(steps)

    def one(key: Key) -> tuple[Played, jax.Array]:
        key_player, key_reset, key_steps = jax.random.split(key, 3)
        player = draw_player(key_player, mixed)
        first, state = game.reset(key_reset, params)

        def step(carry: Any, nothing: None) -> Any:
            del nothing
            frame, state, key = carry
            key, key_act, key_step = jax.random.split(key, 3)
            ball, seen = middle_row(frame[..., OBJECTS["ball"]] > 0, game.scale)
            own, _ = middle_row(frame[..., OBJECTS["own paddle"]] > 0, game.scale)
            action = choose(player, ball, own, seen, key_act)
            frame, state, reward, over, *_ = game.step(key_step, state, action, params)
            return (frame, state, key), (packed(frame), action, reward, over)

        start = (first, state, key_steps)
        frames, action, reward, over = jax.lax.scan(step, start, length=steps)[1]
        whole = jnp.concatenate([packed(first)[None], frames])
        return Played(whole, action, reward), over.any()

    return jax.vmap(one)(jax.random.split(key, copies))


def middle_row(mask: jax.Array, scale: int) -> tuple[jax.Array, jax.Array]:
    """The row of an object's middle in the game's pixels, and whether it is seen.

    Args:
        mask: bool ``[H, W]``.
        scale: the game's pixels a pixel.
    """
    size = mask.sum()
    rows = jnp.arange(FIELD // scale) + 0.5
    return scale * (mask.sum(1) @ rows) / jnp.maximum(size, 1), size > 0
