"""Episodes of Pong to learn frames from: who plays them, how they are kept, how they are seen.

An episode is kept as what its frames are drawn from, states of the pure game or frames of the real
one, so that a transition is put together only when it is drawn.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna.envs import Pong, PongParams, PongState
from jaxdyna.envs.pong_rules import BALL, PADDLE
from jaxdyna.experiments.pong.world import NUM_FRAMES
from jaxdyna.types import Key, Transition

NEAR = 10
"""Pixels off which a player lets the ball be before it moves: a step moves a paddle by more."""
FARTHEST_AIM = 9
FIRES = np.array([1, 1, 4, 5, 4, 5])
"""Each action with the button pressed."""


class Played(NamedTuple):
    """Whole episodes of equal length.

    Attributes:
        world: what frames are drawn from, leaves ``[N, T + 1, ...]``.
        action: int32 ``[N, T]``.
        reward: ``[N, T]``.
    """

    world: Any
    action: jax.Array
    reward: jax.Array


class View(NamedTuple):
    """How a moment of `Played.world` is seen.

    Attributes:
        frame: to the frame, uint8 ``[H, W, 3]``.
        objects: to what is there, bool ``[H, W, 3]``: opponent, own paddle and ball.
    """

    frame: Callable[[Any], jax.Array]
    objects: Callable[[Any], jax.Array]


class Player(NamedTuple):
    """Who plays an episode.

    Attributes:
        skill: share of the actions that follow the ball; the others are random. 0 is the random
            policy.
        aim: pixels below the paddle's middle with which it meets the ball.
    """

    skill: jax.Array
    aim: jax.Array


def draw_player(key: Key, mixed: jax.Array | bool) -> Player:
    """A random player, or of the mixed policy one whose skill is anywhere from 0 to 1."""
    key_skill, key_aim = jax.random.split(key)
    skill = jnp.where(mixed, jax.random.uniform(key_skill), 0.0)
    return Player(skill, jax.random.uniform(key_aim, minval=-FARTHEST_AIM, maxval=FARTHEST_AIM))


def choose(player: Player, ball: jax.Array, own: jax.Array, seen: jax.Array, key: Key) -> jax.Array:
    """An action, int32.

    Args:
        player: who acts.
        ball: the row of the ball's middle, in the game's pixels.
        own: that of the own paddle's.
        seen: bool, whether there is a ball.
        key: random key.
    """
    key_whether, key_any, key_fire = jax.random.split(key, 3)
    away = ball - own - player.aim
    follow = jnp.where(jnp.abs(away) < NEAR, 0, jnp.where(away > 0, 3, 2))
    follow = jnp.where(seen, follow, 0)
    follow = jnp.where(jax.random.bernoulli(key_fire), jnp.asarray(FIRES)[follow], follow)
    anything = jax.random.randint(key_any, (), 0, len(FIRES))
    skilled = jax.random.uniform(key_whether) < player.skill
    return jnp.where(skilled, follow, anything).astype(jnp.int32)


def play(
    game: Pong, params: PongParams, steps: int, episodes: int, mixed: jax.Array | bool, key: Key
) -> Played:
    """Episodes of the pure game by the random or the mixed policy."""

    def one(key: Key) -> Played:
        key_player, key_reset, key_steps = jax.random.split(key, 3)
        player = draw_player(key_player, mixed)
        _, first = game.reset(key_reset, params)

        def step(carry: tuple[PongState, Key], nothing: None) -> Any:
            del nothing
            state, key = carry
            key, key_act, key_step = jax.random.split(key, 3)
            ball, own = state.ball[0] + BALL[0] / 2, state.own + PADDLE[0] / 2
            action = choose(player, ball, own, state.wait == 0, key_act)
            _, new, reward, *_ = game.step(key_step, state, action, params)
            return (new, key), (new, action, reward)

        states, action, reward = jax.lax.scan(step, (first, key_steps), length=steps)[1]
        world = jax.tree.map(lambda one, more: jnp.concatenate([one[None], more]), first, states)
        return Played(world, action, reward)

    return jax.vmap(one)(jax.random.split(key, episodes))


def view_of(game: Pong) -> View:
    """How states of the pure game are seen."""

    def objects(state: PongState) -> jax.Array:
        masks = game.object_masks(state)
        return jnp.stack([masks.opponent, masks.own, masks.ball], axis=-1)

    return View(game.frame, objects)


def take(view: View, played: Played, episode: jax.Array, time: jax.Array) -> Transition:
    """Transitions ``[B]``, each with its stack of frames; an episode begins with its first frame
    repeated.

    Args:
        view: how the episodes are seen.
        played: the episodes.
        episode: int ``[B]``.
        time: step in it, int ``[B]``.
    """
    times = jnp.maximum(time[:, None] + jnp.arange(1 - NUM_FRAMES, 2), 0)
    seen = jax.tree.map(lambda leaf: leaf[episode[:, None], times], played.world)
    frames = jax.vmap(jax.vmap(view.frame))(seen)

    def stack(frames: jax.Array) -> jax.Array:
        moved = jnp.moveaxis(frames, 1, -2)
        return moved.reshape(*moved.shape[:-2], -1)

    no = jnp.zeros(time.shape, bool)
    return Transition(
        obs=stack(frames[:, :-1]),
        action=played.action[episode, time],
        reward=played.reward[episode, time],
        next_obs=stack(frames[:, 1:]),
        terminated=no,
        truncated=time == played.action.shape[1] - 1,
        mask=~no,
    )


def sample(view: View, played: Played, key: Key, size: int) -> Transition:
    """Transitions ``[size]`` drawn with replacement."""
    key_episode, key_time = jax.random.split(key)
    episodes, steps = played.action.shape
    episode = jax.random.randint(key_episode, (size,), 0, episodes)
    time = jax.random.randint(key_time, (size,), 0, steps)
    return take(view, played, episode, time)
