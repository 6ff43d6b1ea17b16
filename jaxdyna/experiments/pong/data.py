"""Episodes of Pong to learn frames from: who plays them, how they are kept, how they are seen.

An episode is kept as what its frames are drawn from, states of the pure game or frames of the real
one, so that a transition is put together only when it is drawn.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna.envs import CHANNELS, AtariParams, AtariPong, Palette, Pong, PongParams, PongState
from jaxdyna.envs.pong_rules import BALL, PADDLE
from jaxdyna.envs.pong_screen import middles, picture_of
from jaxdyna.experiments.pong.world import NUM_FRAMES, OBJECTS
from jaxdyna.types import Key, Transition

#: pixels off which a player lets the ball be before it moves: a step moves a paddle by more
NEAR = 10
FARTHEST_AIM = 9
FIRES = np.array([1, 1, 4, 5, 4, 5])  #: each action with the button pressed
BITS = np.arange(3, dtype=np.uint8)
COPIES = 32  # of the real game, side by side


class Source(NamedTuple):
    """A game whose frames are learned, and what is kept of a moment of it."""

    env: Any  #: the game
    params: Any  #: its params
    palette: Palette  #: the colours in which its frames are seen
    keep: Callable[[jax.Array, Any], Any]  #: ``(frame, state) -> moment``
    #: from a moment to the rows, in the game's pixels, of the ball's middle and of the own
    #: paddle's, and whether there is a ball
    rows: Callable[[Any], tuple[jax.Array, jax.Array, jax.Array]]
    #: to what is there, bool ``[H, W, 3]``: opponent, own paddle and ball
    objects: Callable[[Any], jax.Array]


def states(game: Pong, params: PongParams) -> Source:
    """The pure game, kept as its states."""

    def rows(state: PongState) -> Any:
        return state.ball[0] + BALL[0] / 2, state.own + PADDLE[0] / 2, state.wait == 0

    def objects(state: PongState) -> jax.Array:
        masks = game.object_masks(state)
        return jnp.stack([masks.opponent, masks.own, masks.ball], axis=-1)

    return Source(game, params, game.palette, lambda frame, state: state, rows, objects)


@cache
def screens(game: AtariPong, steps: int) -> Source:
    """The real game, a byte a pixel, a bit an object: a thousand episodes of 40x40 are 0.3 GB."""

    def keep(frame: jax.Array, state: Any) -> jax.Array:
        return ((frame > 127).astype(jnp.uint8) << BITS).sum(-1, dtype=jnp.uint8)

    def objects(moment: jax.Array) -> jax.Array:
        return ((moment[..., None] >> BITS) & 1).astype(bool)

    def rows(moment: jax.Array) -> Any:
        there = objects(moment)
        row = middles(there, 0, game.scale)
        return row[OBJECTS["ball"]], row[OBJECTS["own paddle"]], there[..., OBJECTS["ball"]].any()

    env = replace(game, palette=CHANNELS)
    return Source(env, AtariParams(steps), game.palette, keep, rows, objects)


class Played(NamedTuple):
    """Whole episodes of equal length."""

    world: Any  #: moments, leaves ``[N, T + 1, ...]``
    action: jax.Array  #: int32 ``[N, T]``
    reward: jax.Array  #: ``[N, T]``


def choose(
    skill: jax.Array, aim: jax.Array, ball: jax.Array, own: jax.Array, seen: jax.Array, key: Key
) -> jax.Array:
    """A player's action, int32: it follows the ball with a share ``skill`` of its actions, the
    others are random, and meets it ``aim`` pixels below its middle; the rest is `Source.rows`.
    """
    key_whether, key_any, key_fire = jax.random.split(key, 3)
    away = ball - own - aim
    follow = jnp.where(jnp.abs(away) < NEAR, 0, jnp.where(away > 0, 3, 2))
    follow = jnp.where(seen, follow, 0)
    follow = jnp.where(jax.random.bernoulli(key_fire), jnp.asarray(FIRES)[follow], follow)
    anything = jax.random.randint(key_any, (), 0, len(FIRES))
    skilled = jax.random.uniform(key_whether) < skill
    return jnp.where(skilled, follow, anything).astype(jnp.int32)


def play(source: Source, steps: int, episodes: int, mixed: Any, key: Key) -> Played:
    """Episodes, each a new game, of the random policy, or the mixed one: players of any skill."""

    def one(key: Key) -> Played:
        key_player, key_reset, key_steps = jax.random.split(key, 3)
        key_skill, key_aim = jax.random.split(key_player)
        skill = jnp.where(mixed, jax.random.uniform(key_skill), 0.0)
        aim = jax.random.uniform(key_aim, minval=-FARTHEST_AIM, maxval=FARTHEST_AIM)
        frame, state = source.env.reset(key_reset, source.params)
        first = source.keep(frame, state)

        def step(carry: Any, nothing: None) -> Any:
            moment, state, key = carry
            key, key_act, key_step = jax.random.split(key, 3)
            action = choose(skill, aim, *source.rows(moment), key_act)
            frame, state, reward, *_ = source.env.step(key_step, state, action, source.params)
            moment = source.keep(frame, state)
            return (moment, state, key), (moment, action, reward)

        rest, action, reward = jax.lax.scan(step, (first, state, key_steps), length=steps)[1]
        world = jax.tree.map(lambda one, more: jnp.concatenate([one[None], more]), first, rest)
        return Played(world, action, reward)

    return jax.vmap(one)(jax.random.split(key, episodes))


_play = jax.jit(play, static_argnums=(0, 1, 2))


def collect(source: Source, steps: int, episodes: int, mixed: bool, key: Key) -> Played:
    """The same by the host, so many copies of a game at a time."""
    parts, copies = [], min(COPIES, episodes)
    for _ in range(-(-episodes // copies)):
        key, key_now = jax.random.split(key)
        parts.append(jax.tree.map(np.asarray, _play(source, steps, copies, mixed, key_now)))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:episodes], *parts)


def take(source: Source, played: Played, episode: jax.Array, time: jax.Array) -> Transition:
    """The transitions ``[B]`` of these steps of these episodes, both int ``[B]``, each with its
    stack of frames; an episode begins with its first frame repeated.
    """
    times = jnp.maximum(time[:, None] + jnp.arange(1 - NUM_FRAMES, 2), 0)
    seen = jax.tree.map(lambda leaf: leaf[episode[:, None], times], played.world)
    frames = picture_of(jax.vmap(jax.vmap(source.objects))(seen), source.palette)
    stacks = jnp.moveaxis(frames, 1, -2).reshape(len(time), *frames.shape[2:4], -1)
    no = jnp.zeros(time.shape, bool)
    return Transition(
        obs=stacks[..., :-3], action=played.action[episode, time],
        reward=played.reward[episode, time], next_obs=stacks[..., 3:], terminated=no,
        truncated=time == played.action.shape[1] - 1, mask=~no)  # fmt: skip
