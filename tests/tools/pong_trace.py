"""A player for the real Pong and the pure one, and what either does frame by frame.

``python tests/tools/pong_trace.py tests/data/pong_trace.npz`` recorded the real one for the test
that compares the two; it needs the ``atari`` extra.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna.envs.gymnasium import check_atari
from jaxdyna.envs.pong_rules import (
    BALL,
    FIELD,
    NUM_ACTIONS,
    PADDLE,
    PongParams,
    advance,
    first_state,
)
from jaxdyna.types import Key

BALL_COLUMN, BALL_ROW, OPPONENT, OWN = 49, 54, 50, 51
"""Where the game keeps them in its memory (Anand et al., 2019, and checked against the frames)."""
ORIGIN = {"ball_row": 48, "ball_column": 49, "own": 47, "opponent": 49}
"""Memory minus the position on the field of `jaxdyna.envs.pong_rules`."""
AIM_FRAMES, DEAD_ZONE, SHAKY = 300, 4, 0.05
Trace = dict[str, np.ndarray]


class Script(NamedTuple):
    """What a shaky but decent player intends, whatever the game does.

    Attributes:
        offset: int32 ``[frames]``: how far above its paddle's middle it wants the ball, in pixels.
        action: int32 ``[frames]``: an action at random, held for two frames; -1 where it follows
            the ball.
    """

    offset: np.ndarray
    action: np.ndarray


def script(frames: int, seed: int, reach: int = 9) -> Script:
    """Decisions in every other frame: another offset of up to ``reach`` pixels every 300 frames, 5%
    of the actions at random.
    """
    generator = np.random.default_rng(seed)
    offsets, actions, offset = [], [], 0
    for frame in range(frames):
        if frame % AIM_FRAMES == 0:
            offset = int(generator.integers(-reach, reach + 1))
        shaky = frame % 2 == 0 and generator.random() < SHAKY
        actions.append(int(generator.integers(NUM_ACTIONS)) if shaky else -1)
        offsets.append(offset)
    return Script(np.array(offsets, np.int32), np.array(actions, np.int32))


def record(script: Script) -> Trace:
    """Plays the real game.

    Returns:
        Int16 ``[frames]`` each: ``action`` and ``reward`` of a frame, and after it ``ball_row``
        (-48 without a ball), ``ball_column``, ``own`` and ``opponent``, in pixels of the field.
    """
    check_atari()
    how = {"frameskip": 1, "repeat_action_probability": 0.0, "obs_type": "ram"}
    envs = gymnasium.make_vec("ALE/Pong-v5", 1, vectorization_mode="sync", **how)
    memory, _ = envs.reset(seed=0)
    rows, action = [], 0
    for frame, (offset, shaky) in enumerate(zip(*script, strict=True)):
        if frame % 2 == 0:
            ball, own = int(memory[0, BALL_ROW]), int(memory[0, OWN])
            away = ball - own - PADDLE[0] // 2 + offset if ball else 0
            action = 0 if abs(away) < DEAD_ZONE else 3 if away > 0 else 2
            action = int(shaky) if shaky >= 0 else action
        memory, reward, *_ = envs.step(np.array([action]))
        places = (int(memory[0, at]) for at in (BALL_ROW, BALL_COLUMN, OWN, OPPONENT))
        rows.append((action, int(reward[0]), *places))
    envs.close()
    columns = dict(zip(("action", "reward", *ORIGIN), np.array(rows, np.int16).T, strict=True))
    return {name: column - ORIGIN.get(name, 0) for name, column in columns.items()}


def play(script: Script, key: Key) -> Trace:
    """Plays the pure game: the same arrays as `record`."""
    params = PongParams(points_to_win=len(script.offset))
    lag = ORIGIN["ball_row"] - ORIGIN["own"]

    def frame(carry, now):
        (state, action), (number, offset, shaky, key) = carry, now
        away = state.ball[0] - state.own + lag - PADDLE[0] // 2 + offset
        away = jnp.where(state.wait == 0, away, 0)
        follows = jnp.where(jnp.abs(away) < DEAD_ZONE, 0, jnp.where(away > 0, 3, 2))
        action = jnp.where(number % 2 == 0, jnp.where(shaky >= 0, shaky, follows), action)
        before, state = state.score, advance(key, state, action, params)
        lost, won = state.score - before
        seen = (action, won - lost, state.ball[0], state.ball[1], state.own, state.opponent)
        return (state, action), seen

    frames = len(script.offset)
    inputs = (jnp.arange(frames), *script, jax.random.split(key, frames))
    begin = (first_state(params), jnp.int32(0))
    columns = jax.jit(lambda inputs: jax.lax.scan(frame, begin, inputs)[1])(inputs)
    names = ("action", "reward", *ORIGIN)
    return {name: np.asarray(part, np.int16) for name, part in zip(names, columns, strict=True)}


def samples(trace: Trace) -> Trace:
    """What is counted of a trace, with velocities in pixels a frame.

    Returns:
        ``rally``: frames from a serve to its point; ``point``: 1 won, -1 lost; ``across``: the
        ball's horizontal speed in each frame of flight; ``place`` and ``angle`` of each hit,
        ``own_`` and ``opponent_``: how far below the paddle's top the ball's top is, in pixels,
        and the degrees below the horizontal at which it leaves.
    """
    row, column, reward = (
        trace[name].astype(int) for name in ("ball_row", "ball_column", "reward")
    )
    in_play = row > -ORIGIN["ball_row"]
    serves, points = np.nonzero(in_play[1:] & ~in_play[:-1])[0] + 1, np.nonzero(reward)[0]
    ends = np.searchsorted(points, serves)
    whole = ends < len(points)
    flying = in_play[1:] & in_play[:-1]
    down, right = np.where(flying, np.diff(row), 0), np.where(flying, np.diff(column), 0)
    found = {
        "rally": points[ends[whole]] - serves[whole],
        "point": reward[points],
        "across": np.abs(right[(right != 0) & flying]),
    }
    inside = (row > BALL[0]) & (row < FIELD - 2 * BALL[0])  # no wall has a hand in it
    for name, sign in (("own", 1), ("opponent", -1)):
        turned = (sign * right[:-2] > 0) & (sign * right[1:-1] < 0) & inside[1:-2] & flying[2:]
        at = np.nonzero(turned)[0] + 1
        found[f"{name}_place"] = row[at] - trace[name].astype(int)[at]
        found[f"{name}_angle"] = np.degrees(np.arctan2(down[at + 1], np.abs(right[at + 1])))
    return found


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("give the file to write: python tests/tools/pong_trace.py FILE.npz")
    np.savez_compressed(Path(sys.argv[1]), **record(script(frames=12_000, seed=5)))  # type: ignore[arg-type]
