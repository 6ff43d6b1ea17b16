"""Dreams of Pong in which the true game runs beside the model and shows some of what is seen: all
of it for the oracle, one object where the question is which object's error does the harm.
"""

from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxdyna.dyna import Dream, Dyna, DynaHParams, DynaState
from jaxdyna.envs import Pong, PongParams, PongState, Replayed, ReplayedParams, StackState
from jaxdyna.envs.pong_rules import BALL, FIELD, LEFT, PADDLE, RIGHT, first_state
from jaxdyna.experiments.pong.world import NUM_FRAMES, OBJECTS, middles
from jaxdyna.experiments.study.frames import draw_stack
from jaxdyna.models.evaluation import Predict
from jaxdyna.types import Key


def read_state(game: Pong, stack: jax.Array, params: PongParams, key: Key) -> PongState:
    """A state that a stack of frames, uint8 ``[H, W, 3 * frames]``, an object a channel, can show,
    at step 0 and without points. The key draws what cannot be told: where within its pixels an
    object is, when the opponent rests, whether a ball that is out has been counted, how long a
    missing one stays away.
    """
    keys = jax.random.split(key, 8)
    key_row, key_column, key_own, key_wait, key_opponent, key_clock, key_lost, key_over = keys
    frames = stack.reshape(*stack.shape[:2], NUM_FRAMES, 3) > 127
    opponent, own, ball = (frames[..., channel] for channel in range(3))
    scale, skip = game.scale, game.frame_skip
    middle = jnp.stack([middles(ball, axis) for axis in (0, 1)], -1) * scale
    seen = ball.any((0, 1))
    sides = ((0, key_row), (1, key_column))
    place = jnp.stack([_first_pixel(ball, axis, BALL, scale, key) for axis, key in sides])
    own_row = _first_pixel(own, 0, PADDLE, scale, key_own)
    own_row = own_row + own_row % 2 * jnp.where(own_row % scale == scale - 1, -1, 1)  # shown evenly
    moved = scale * jnp.diff(middles(own, 0)[-2:])[0]
    out = (place[1] >= RIGHT) | (place[1] <= LEFT)  # shown for a frame before it counts, and after
    counted = seen[-1] & out & jax.random.bernoulli(key_over)
    in_play, last = seen[-1] & ~counted, middle[NUM_FRAMES - 1 - jnp.argmax(seen[::-1]), 1]
    lost = jnp.where(seen.any(), last > FIELD / 2, jax.random.bernoulli(key_lost))
    unserved = jnp.stack([0, jnp.where(lost, 1, -1)])  # towards who lost the point
    velocity = jnp.where(in_play, _velocity(middle, seen, place, skip), unserved)
    delay, empty = jnp.maximum(params.serve_delay, 1), first_state(params)
    waits = jnp.where(counted, delay, jax.random.randint(key_wait, (), 1, delay + 1))
    return replace(
        empty,
        ball=jnp.where(seen[-1], place, empty.ball),
        ball_velocity=velocity.astype(jnp.int32),
        own=own_row,
        own_target=(own_row + _on_its_way(moved, params.paddle_speed)).astype(jnp.float32),
        opponent=_first_pixel(opponent, 0, PADDLE, scale, key_opponent),
        wait=jnp.where(in_play, 0, waits).astype(jnp.int32),
        clock=skip * jax.random.randint(key_clock, (), 0, jnp.maximum(params.opponent_rest, 1)),
    )


def _first_pixel(
    masks: jax.Array, axis: int, size: tuple[int, int], scale: int, key: Key
) -> jax.Array:
    """The row or column at which a thing of this size begins that is so in the newest of the frames
    ``[H, W, frames]``; it may reach beyond the edge.
    """
    lit, length = masks[..., -1].any(1 - axis), size[axis]
    cells = lit.shape[0]
    first, last = jnp.argmax(lit), cells - 1 - jnp.argmax(lit[::-1])
    from_last, within_first = scale * last - length + 1, scale * first + scale - 1
    low = jnp.where(first == 0, from_last, jnp.maximum(scale * first, from_last))
    high = jnp.where(last == cells - 1, within_first, from_last + scale - 1)
    high = jnp.maximum(jnp.minimum(within_first, high), low)
    return jax.random.randint(key, (), low, high + 1)


def _velocity(middle: jax.Array, seen: jax.Array, place: jax.Array, skip: int) -> jax.Array:
    """Pixels a frame, from the middles ``[frames, 2]``; after a serve from where that is; where
    the ball has just turned, away from the nearer side.
    """
    now, before = (middle[-1] - middle[-2]) / skip, (middle[-2] - middle[-3]) / skip
    turned = seen[-3] & (jnp.round(now[1]) != jnp.round(before[1]))
    fastest = jnp.maximum(jnp.abs(now[1]), jnp.abs(before[1]))
    away = jnp.where(place[1] < FIELD / 2, 1.0, -1.0)
    right = jnp.where(turned, fastest * away, now[1])
    right = jnp.where(jnp.abs(right) < 0.5, away, jnp.round(right))
    served = jnp.where(place >= FIELD // 2, 1.0, -1.0)
    velocity = jnp.stack([jnp.clip(jnp.round(now[0]), -3, 3), jnp.clip(right, -3, 3)])
    return jnp.where(seen[-2], velocity, served)


def _on_its_way(moved: jax.Array, speed: jax.Array | float) -> jax.Array:
    """How far the own paddle still has to go, from how far it came in the last step of four frames
    (twice half of the way): further where the stick was held.
    """
    held = jnp.where(jnp.abs(moved) > 2 * speed, jnp.sign(moved) * speed, 0.0)
    return (moved - 2.5 * held) / 3 + 1.5 * held


@struct.dataclass
class GuidedParams(ReplayedParams):
    """The model's beside."""

    model: Any = None


@dataclass(frozen=True)
class Guided(Replayed):
    """A dream from any real stack of frames with the true game beside it.

    Attributes:
        predict: a model's ``predict``; None for the oracle, whose frames and rewards are the true
            game's.
        truth: channels of each frame that are the true game's.
    """

    predict: Predict | None = None
    truth: tuple[int, ...] = ()

    def step(
        self, key: Key, state: StackState, action: jax.Array, params: Any
    ) -> tuple[jax.Array, StackState, jax.Array, jax.Array, jax.Array, dict[str, Any]]:
        """One step of both; the reward is the model's, the oracle's the game's."""
        key_game, key_predict = jax.random.split(key)
        obs, new, reward, terminated, truncated, _ = super().step(key_game, state, action, params)
        if self.predict is not None:
            said = self.predict(params.model, state.obs, action, key_predict)
            true = np.isin(np.arange(obs.shape[-1]) % len(OBJECTS), self.truth)
            obs, reward = jnp.where(true, obs, said.next_obs), said.reward
        return obs, replace(new, obs=obs), reward, terminated, truncated, {}


@cache
def guided(dyna: Dyna, things: tuple[str, ...] = ()) -> Dream:
    """Dreams of the same model with these of the true game's objects; without any, all of the true
    game's, rewards as well.
    """
    predict = dyna.model.predict if things and dyna.model else None
    env: Any = dyna.env

    def params(state: DynaState, hparams: DynaHParams) -> GuidedParams:
        weights = state.model.params if predict else None
        return GuidedParams(hparams.env, state.replay, hparams.env.max_steps, weights)

    truth = tuple(OBJECTS[thing] for thing in things)
    return Dream(Guided(env, draw_stack, partial(read_state, env.env), predict, truth), params)
