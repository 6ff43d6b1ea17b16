"""Records the real Pong frame by frame, for the test that compares the pure one with it.

``python -m jaxdyna.experiments.pong_trace tests/data/pong_trace.npz`` wrote the one in the tests;
it needs the ``atari`` extra.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from jaxdyna.envs.gymnasium import make_atari

BALL_COLUMN, BALL_ROW, OPPONENT, OWN = 49, 54, 50, 51
"""Where the game keeps them in its memory (Anand et al., 2019, and checked against the frames)."""
ORIGIN = {"ball_row": 48, "ball_column": 49, "own": 47, "opponent": 49}
"""Memory minus the position on the field of `jaxdyna.envs.pong_rules`."""


def record(frames: int, seed: int) -> dict[str, np.ndarray]:
    """Plays a shaky but decent player for so many frames.

    Returns:
        Int16 ``[frames]`` each: ``action`` and ``reward`` of a frame, and after it ``ball_row``
        (-48 without a ball), ``ball_column``, ``own`` and ``opponent``, in pixels of the field.
    """
    envs = make_atari("Pong", 1, frameskip=1, repeat_action_probability=0.0, obs_type="ram")
    generator = np.random.default_rng(seed)
    memory, _ = envs.reset(seed=seed)
    rows, action, offset = [], 0, 0
    for frame in range(frames):
        if frame % 300 == 0:
            offset = int(generator.integers(-9, 10))
        if frame % 2 == 0:
            ball, own = int(memory[0, BALL_ROW]), int(memory[0, OWN])
            away = ball - own - 8 + offset if ball else 0
            action = 0 if abs(away) < 4 else 3 if away > 0 else 2
            if generator.random() < 0.05:
                action = int(generator.integers(6))
        memory, reward, *_ = envs.step(np.array([action]))
        places = (int(memory[0, at]) for at in (BALL_ROW, BALL_COLUMN, OWN, OPPONENT))
        rows.append((action, int(reward[0]), *places))
    envs.close()
    columns = dict(zip(("action", "reward", *ORIGIN), np.array(rows, np.int16).T, strict=True))
    return {name: column - ORIGIN.get(name, 0) for name, column in columns.items()}


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("give the file to write: python -m jaxdyna.experiments.pong_trace FILE.npz")
    columns: dict[str, Any] = record(frames=12_000, seed=5)
    np.savez_compressed(Path(sys.argv[1]), **columns)
