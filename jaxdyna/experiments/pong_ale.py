"""Episodes of the Atari 2600 game to learn frames from."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna.envs import AtariParams, AtariPong, Palette
from jaxdyna.envs.pong_screen import picture_of
from jaxdyna.experiments.pong_data import Played, View, choose, draw_player, middle_row
from jaxdyna.experiments.pong_judge import OBJECTS
from jaxdyna.experiments.pong_options import POLICIES, Options
from jaxdyna.types import Key

BITS = np.arange(3, dtype=np.uint8)
COPIES = 32


class GameOver(ValueError):
    """A game was over before the episode was."""


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

    return View(frame, objects, palette)


def collect_all(options: Options) -> tuple[Played, Played]:
    """What every seed learns from, the episodes of one policy after those of the other (zeros where
    nobody asks for them), and its held-out episodes of the mixed one, with leading axes ``[1,
    seeds]``.
    """
    learned, held_out = [], []
    for number in range(options.seeds):
        key = jax.random.fold_in(jax.random.key(options.seed), number)
        key_random, key_mixed, key_new = jax.random.split(key, 3)
        by_policy = {"random": key_random, "mixed": key_mixed}
        asked = {
            policy: collect(options, options.episodes, policy == "mixed", by_policy[policy])
            for policy in dict.fromkeys(options.policies)
        }
        nothing = jax.tree.map(np.zeros_like, next(iter(asked.values())))
        parts = [asked.get(policy, nothing) for policy in POLICIES]
        learned.append(jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts))
        held_out.append(collect(options, options.held_out, True, key_new))

    def by_seed(episodes: list[Played]) -> Played:
        return jax.tree.map(lambda *leaves: np.stack(leaves)[None], *episodes)

    return by_seed(learned), by_seed(held_out)


def collect(options: Options, episodes: int, mixed: bool, key: Key) -> Played:
    """Episodes ``[N, T]`` by the random or the mixed policy, each from a new game's start.

    Raises:
        ImportError: without the ``atari`` extra.
        GameOver: where a game is over before an episode is.
    """
    game, parts = AtariPong(options.frame_skip, options.scale), []
    copies = min(COPIES, episodes)
    for _ in range(-(-episodes // copies)):
        key, key_now = jax.random.split(key)
        played, over = _play(game, options.steps, copies, mixed, key_now)
        if over.any():
            raise GameOver(
                f"--steps is {options.steps}: a game of 21 points ended within it, give fewer"
            )
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
