"""The rules of `jaxdyna.envs.Pong`, one frame at a time, as measured on the Atari 2600 game.

Positions are the upper left pixel of an object on a field of 160 by 160 pixels, as (row, column),
and reach a little outside; velocities are in pixels a frame.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxdyna.fields import setting
from jaxdyna.types import Key

FIELD = 160
BALL, PADDLE = (4, 2), (16, 4)  #: heights and widths
OPPONENT_COLUMN, OWN_COLUMN = 16, 140

_ABSENT = -48  #: the ball's row while there is none; the opponent runs after it there as well
_SERVE = (80, 79)
_TOP, _BOTTOM = -3, 158  #: the rows at which the ball turns around
LEFT, RIGHT = 3, 156  #: the columns at which a point is won and lost
_OWN_ROWS, _TARGETS = (-9, 156), (-34, 160)
FASTEST = 3
_DIRECTION = np.array([0, 0, -1, 1, -1, 1])
_FIRES = np.array([False, True, False, False, True, True])
NUM_ACTIONS = len(_DIRECTION)  #: nothing, fire, up, down, up and fire, down and fire


@struct.dataclass
class PongParams:
    """What can be swept."""

    points_to_win: int = setting(
        21, "Points of either side; reaching them terminates the episode.", at_least=1
    )
    max_steps: int = setting(27_000, "Steps until truncation.", at_least=1)
    first_serve_delay: int = setting(59, "Frames until the first serve; 0 counts as 1.", at_least=0)
    serve_delay: int = setting(63, "Frames from a point to the serve; 0 counts as 1.", at_least=0)
    opponent_speed: int = setting(2, "The opponent's speed, pixels a frame.", at_least=0)
    opponent_rest: int = setting(8, "The opponent rests in one frame of so many.", at_least=1)
    paddle_speed: float = setting(
        5.8, "Pixels a frame that the player moves where the own paddle is to go.", at_least=0
    )
    repeat_action_probability: float = setting(
        0.0, 'Probability that a frame repeats the last frame\'s action instead ("sticky actions"; '
        "0.25 in ALE/Pong-v5, 0 in PongNoFrameskip-v4).", at_least=0, at_most=1)  # fmt: skip


@struct.dataclass
class PongState:
    """Int32 where not said."""

    ball: jax.Array  #: ``[2]`` (row, column)
    ball_velocity: jax.Array  #: ``[2]``
    own: jax.Array  #: the own paddle's row
    own_target: jax.Array  #: the row that it is on its way to, float32
    opponent: jax.Array  #: the opponent's row
    score: jax.Array  #: ``[2]``, the opponent's points and the own
    wait: jax.Array  #: frames until the serve; 0 while the ball is in play
    last_action: jax.Array  #: of the last frame
    clock: jax.Array  #: the number of frames played
    time: jax.Array  #: the number of steps taken


def first_state(params: PongParams) -> PongState:
    """An empty field; the first serve will go to the opponent."""
    zero = jnp.int32(0)
    return PongState(
        ball=jnp.array([_ABSENT, 0], jnp.int32), ball_velocity=jnp.array([0, -1], jnp.int32),
        own=jnp.int32(62), own_target=jnp.float32(63), opponent=jnp.int32(-29),
        score=jnp.zeros(2, jnp.int32),
        wait=jnp.maximum(params.first_serve_delay, 1).astype(jnp.int32), last_action=zero,
        clock=zero, time=zero)  # fmt: skip


def advance(key: Key, state: PongState, action: jax.Array, params: PongParams) -> PongState:
    """The state after one frame with ``action``, int in [0, 6); ``time`` is left to the caller."""
    key_sticky, key_serve = jax.random.split(key)
    sticky = jax.random.bernoulli(key_sticky, params.repeat_action_probability)
    action = jnp.where(sticky, state.last_action, action)
    upwards = jax.random.bernoulli(key_serve)

    in_play = state.wait == 0
    lost, won = in_play & (state.ball[1] >= RIGHT), in_play & (state.ball[1] <= LEFT)
    out = lost | won
    delay = jnp.maximum(params.serve_delay, 1)
    wait = jnp.where(out, delay, jnp.maximum(state.wait - 1, 0)).astype(jnp.int32)
    served = ~in_play & (wait == 0)

    bounced = _bounce(state, jnp.array(_FIRES)[state.last_action])
    serve = jnp.stack([jnp.where(upwards, -1, 1), state.ball_velocity[1]])
    velocity = jnp.where(served, serve, jnp.where(in_play, bounced, state.ball_velocity))
    velocity = jnp.where(out, jnp.stack([0, jnp.where(lost, 1, -1)]), velocity)
    origin = jnp.where(served, jnp.array(_SERVE), state.ball.at[0].add(_rebound(state)))
    ball = jnp.where(out, state.ball, origin + velocity)
    ball = jnp.where(in_play | served, ball, jnp.array([_ABSENT, 0])).astype(jnp.int32)
    clock = state.clock + 1
    own, own_target = _move_own(state, action, clock, params)
    return replace(
        state, ball=ball, ball_velocity=velocity.astype(jnp.int32), own=own, own_target=own_target,
        opponent=_move_opponent(state, ball, served, clock, params),
        score=state.score + jnp.stack([lost, won]), wait=wait, last_action=action.astype(jnp.int32),
        clock=clock)  # fmt: skip


def _bounce(state: PongState, fires: jax.Array) -> jax.Array:
    """The ball's velocity after what it touches now: a paddle that it flies towards, or a wall."""
    (row, column), (down, right) = state.ball, state.ball_velocity

    def touches(paddle_row, paddle_column):
        return (
            (row + BALL[0] - 1 > paddle_row)
            & (row > _TOP)
            & (row < FIELD - 1)
            & (row < paddle_row + PADDLE[0])
            & (column + BALL[1] > paddle_column)
            & (column < paddle_column + PADDLE[1])
        )

    own = touches(state.own - state.own % 2, OWN_COLUMN)
    opponent = touches(state.opponent - 1, OPPONENT_COLUMN)
    below = jnp.where(own, row - state.own, row - state.opponent - 2)
    slope = jnp.clip(jnp.floor_divide(below, 4) - 1, -3, 2)
    slope = jnp.where(own | opponent, slope, down)
    down = jnp.where(row <= _TOP, jnp.abs(down), jnp.where(row >= _BOTTOM, -jnp.abs(down), slope))
    speed = jnp.minimum(jnp.abs(right) + (own & fires), FASTEST)
    right = jnp.where(own, -speed, jnp.where(opponent, speed, right))
    return jnp.stack([down, right])


def _rebound(state: PongState) -> jax.Array:
    """A wall pushes the ball back by a pixel."""
    row = state.ball[0]
    return jnp.where(row <= _TOP, 1, jnp.where(row >= _BOTTOM, -1, 0))


def _move_own(state, action, clock, params):
    """The stick moves a target; every other frame the paddle goes half of the way there."""
    target = state.own_target + jnp.array(_DIRECTION)[action] * params.paddle_speed
    target = jnp.clip(target, *_TARGETS).astype(jnp.float32)
    half = jnp.floor((target - state.own) / 2).astype(jnp.int32)
    own = jnp.clip(state.own + half, *_OWN_ROWS)
    return jnp.where(clock % 2 == 0, own, state.own), target


def _move_opponent(state, ball, served, clock, params):
    """After the ball, but for one frame in some; before a serve it is where the ball will be."""
    aim = ball[0] - 1
    step = jnp.sign(aim - state.opponent) * params.opponent_speed
    rests = clock % params.opponent_rest == 0
    moved = state.opponent + jnp.where(rests, 0, step)
    ready = jnp.array(_SERVE)[0] - 1 + 2 * jnp.sign(ball[0] - _SERVE[0])
    return jnp.where(served, ready, moved).astype(jnp.int32)
