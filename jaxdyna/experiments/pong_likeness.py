"""The pure Pong beside the Atari 2600's, played alike: rallies, speeds, bounces, random players.

``python -m jaxdyna.experiments.pong_likeness`` (the ``atari`` extra).
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console

from jaxdyna.envs import CHANNELS, Pong
from jaxdyna.envs.gymnasium import make_atari
from jaxdyna.envs.pong_rules import BALL, FIELD, NUM_ACTIONS, PADDLE, PongParams
from jaxdyna.experiments import cli, plots_likeness, report
from jaxdyna.experiments.pong_trace import ORIGIN, Trace, play, record, script
from jaxdyna.experiments.storage import plain, write_json, write_text
from jaxdyna.rollout import rollout
from jaxdyna.statistics import bootstrap_interval

PROG = "python -m jaxdyna.experiments.pong_likeness"
LONGEST = 1_500
"""Steps after which a game of random players is broken off: they take about 935."""
REAL, PURE = "Atari 2600", "pure"
Samples = dict[str, np.ndarray]


@dataclass(frozen=True)
class Options:
    """Plays both games by the same script, and with random players, and compares them."""

    frames: int = 120_000
    """Frames of a shaky but decent player in each game."""
    games: int = 24
    """Whole games of random players of each, frame skip 4."""
    seed: int = 0
    """Of what the players draw, and of the pure game."""
    out: Path = Path("runs/pong-likeness")
    """Folder for the results."""

    def __post_init__(self) -> None:
        cli.check_common(self)
        if self.frames < 3_000 or self.games < 2:
            raise ValueError("--frames must be at least 3,000 and --games at least 2")


def samples(trace: Trace) -> Samples:
    """What is counted of a trace of `pong_trace`, with velocities in pixels a frame.

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


def random_in_real(games: int, seed: int) -> Samples:
    """Scores and lengths of whole games, and steps between points, of random players."""
    settings = {"frameskip": 4, "repeat_action_probability": 0.0, "obs_type": "ram"}
    envs, generator = make_atari("Pong", games, **settings), np.random.default_rng(seed)
    envs.reset(seed=seed)
    rewards: list[np.ndarray] = []
    alive, running = [], np.ones(games, bool)
    while running.any() and len(rewards) < LONGEST:
        _, reward, ended, _, _ = envs.step(generator.integers(NUM_ACTIONS, size=games))
        rewards.append(np.where(running, reward, 0))
        alive.append(running)
        running = running & ~ended
    envs.close()
    return _of_games(np.stack(rewards, 1), np.stack(alive, 1))


def random_in_pure(games: int, seed: int) -> Samples:
    """The same of `Pong`."""
    env = Pong(scale=8, palette=CHANNELS)

    def act(obs: jax.Array, key: jax.Array) -> jax.Array:
        return jax.random.randint(key, (), 0, NUM_ACTIONS)

    def played(key: jax.Array) -> Any:
        return rollout(env, act, key, PongParams(), games, num_steps=LONGEST)

    steps = jax.jit(played)(jax.random.key(seed))
    return _of_games(np.asarray(steps.reward), np.asarray(steps.mask))


def _of_games(reward: np.ndarray, mask: np.ndarray) -> Samples:
    gaps = [np.diff(np.nonzero(game)[0]) for game in reward * mask]
    score, steps = (reward * mask).sum(1), mask.sum(1)
    return {"score": score, "steps": steps, "gap": np.concatenate(gaps)}


def main(argv: Sequence[str] | None = None) -> int:
    """Compares the two from the command line; returns the exit code."""
    options = cli.parse({"paper": Options()}, argv, PROG)
    try:
        cli.check_writable(options.out)
        found = compared(options)
    except (ValueError, ImportError) as error:
        cli.fail(str(error), PROG)
    arguments = sys.argv[1:] if argv is None else argv
    results = {
        "experiment": "pong_likeness",
        "command": f"{PROG} {shlex.join(arguments)}".strip(),
        "config": plain(options),
        **report.environment(),
        "games": {name: _described(values) for name, values in found.items()},
    }
    plots_likeness.beside(options.out / "likeness.png", found, PADDLE[0])
    write_json(options.out / "results.json", results)
    write_text(options.out / "report.md", _markdown(results, options))
    console = Console(highlight=False)
    report.print_table(console, "Pong beside Pong", *_table(results))
    console.print(f"Report: {options.out / 'report.md'}")
    return 0


def compared(options: Options) -> dict[str, Samples]:
    """The samples of both games."""
    players = script(options.frames, options.seed)
    real = samples(record(players)) | random_in_real(options.games, options.seed)
    key = jax.random.fold_in(jax.random.key(options.seed), 1)
    pure = samples(play(players, key)) | random_in_pure(options.games, options.seed)
    return {REAL: real, PURE: pure}


def _described(found: Samples) -> report.Results:
    said: report.Results = {}
    for name in ("rally", "point", "score", "steps", "gap"):
        values = found[name].astype(float)
        ends = bootstrap_interval(values, lambda rows: rows.mean(-1))
        said[name] = {"mean": float(values.mean()), "ci95": ends, "count": len(values)}
    said["speed_shares"] = [float((found["across"] == speed).mean()) for speed in (1, 2, 3)]
    for side in ("own", "opponent"):
        place, angle = found[f"{side}_place"], found[f"{side}_angle"]
        parts = [angle[(place >= low) & (place < low + BALL[0])] for low in _PARTS]
        said[f"{side}_angles"] = [float(np.median(part)) if len(part) else None for part in parts]
        said[f"{side}_hits"] = len(place)
    return said


_PARTS = range(-BALL[0], PADDLE[0], BALL[0])
_WORDS = {
    "rally": "frames from a serve to its point, mean",
    "point": "points won less lost, a point",
    "score": "random players: score of a game, mean",
    "steps": "random players: steps of a game, mean",
    "gap": "random players: steps from point to point, mean",
}


def _table(results: report.Results) -> tuple[list[str], list[list[str]]]:
    games = results["games"]
    rows = []
    for name, words in _WORDS.items():
        said = [games[game][name] for game in games]
        digits = 2 if name == "point" else 1
        means = (
            f"{one['mean']:.{digits}f} ({report.interval(one['ci95'], digits)})" for one in said
        )
        rows.append([words, *means])
    shares = ["/".join(f"{share:.3f}" for share in games[game]["speed_shares"]) for game in games]
    rows.append(["share of the flight at 1/2/3 pixels a frame across", *shares])
    for side in ("own", "opponent"):
        angles = [games[game][f"{side}_angles"] for game in games]
        cells = ["/".join("-" if at is None else f"{at:.0f}" for at in one) for one in angles]
        title = {"own": "own paddle", "opponent": "opponent"}[side]
        rows.append([f"{title}: degrees down, by part of it from above, median", *cells])
    return ["", *games], rows


def _markdown(results: report.Results, options: Options) -> str:
    parts = [
        "# Pong beside Pong",
        f"`{results['command']}`",
        f"The same player in both games, {options.frames:,} frames: it follows the ball with "
        "another part of its paddle every 300 frames, 5% of its actions at random; and "
        f"{options.games} whole games of random players, 4 frames a step. Nothing is learned. "
        "Mean and 95% interval over rallies, points, games.",
        report.markdown_table(*_table(results)).rstrip(),
        "![rallies, speeds, bounces and random players of both games](likeness.png)",
    ]
    return "\n\n".join(parts) + "\n"


if __name__ == "__main__":
    sys.exit(main())
