"""Steps of environments a second, many of them at once."""

import subprocess
from collections.abc import Iterable
from contextlib import ExitStack
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxdyna.envs import CartPole, Maze
from jaxdyna.envs.gymnasium import gymnasium
from jaxdyna.experiments.benchmark.timing import EXAMPLES, OURS, Work, compared, jitted, rival
from jaxdyna.experiments.engine import InputError, Results
from jaxdyna.trees import where
from jaxdyna.types import Environment, Key

STEPS = 32
"""Of a turn: pushed to and fro, no pole falls so soon."""



def measure(options: Any) -> Iterable[Results]:
    """CartPole against Gymnasium's vector environment and gymnax; the Maze against NumPy."""
    count, rounds = options.envs, options.rounds
    cartpole, maze, key = CartPole(), Maze(), jax.random.key(options.seed)
    key_play, key_maze = jax.random.split(key)
    numpy_maze = rival("numpy_maze")
    units, rng = count * STEPS, np.random.default_rng(options.seed)
    pushes = np.tile(np.arange(STEPS)[:, None] % 2, (1, count))
    moves = rng.integers(maze.num_actions, size=(STEPS, count))
    envs: Any = gymnasium.make_vec("CartPole-v1", count, "vector_entry_point")

    def gymnasiums(actions: Iterable[np.ndarray]) -> float:
        envs.reset(seed=options.seed)
        for action in actions:
            envs.step(action)
        return units

    def numpys() -> float:
        plain = numpy_maze.NumpyMaze(options.seed)
        plain.reset()
        for action in moves[:, 0]:
            plain.step(action)
        return STEPS

    yield from compared("CartPole, actions given", "steps/s", {
        OURS: jitted(partial(given, cartpole), key_play, pushes, units=units),
        "Gymnasium": lambda: gymnasiums(pushes),
    }, rounds)  # fmt: skip
    with ExitStack() as stack:
        other = options.gymnax and {"gymnax": _gymnax(options.gymnax, count, stack)}
        yield from compared("CartPole, actions and resets at random", "steps/s", {
            OURS: jitted(partial(at_random, cartpole, count), key_play, units=units),
            "Gymnasium": lambda: gymnasiums(rng.integers(2, size=count) for _ in range(STEPS)),
            **(other or {}),
        }, rounds)  # fmt: skip
    yield from compared("Maze, frames", "steps/s", {
        OURS: jitted(partial(given, maze), key_maze, moves, units=units), "NumPy": numpy_maze and numpys,
    }, rounds)  # fmt: skip


def given(env: Environment, key: Key, actions: jax.Array) -> Any:
    """What is seen and earned after a reset by actions ``[T, N]``, of deterministic steps."""
    params, count = env.default_params, actions.shape[1]
    key_step, key_reset = jax.random.split(key)

    def step(state: Any, action: jax.Array) -> Any:
        obs, state, *rest, _ = jax.vmap(env.step, (None, 0, 0, None))(
            key_step, state, action, params
        )
        return state, (obs, rest)

    _, state = jax.vmap(env.reset, (0, None))(jax.random.split(key_reset, count), params)
    return jax.lax.scan(step, state, actions)[1]


def at_random(env: Environment, count: int, key: Key) -> Any:
    """The same by actions at random, those that are over reset: numbers are drawn for all steps at
    once.
    """
    params = env.default_params
    key_step, key_actions, key_resets = jax.random.split(key, 3)
    actions = jax.random.randint(key_actions, (STEPS, count), 0, env.num_actions)
    keys = jax.random.split(key_resets, (STEPS + 1, count))
    _, states = jax.vmap(jax.vmap(env.reset, (0, None)), (0, None))(keys, params)
    first, fresh = (jax.tree.map(itemgetter(rows), states) for rows in (0, slice(1, None)))

    def step(state: Any, drawn: Any) -> Any:
        action, new = drawn
        obs, state, reward, terminated, truncated, _ = jax.vmap(env.step, (None, 0, 0, None))(
            key_step, state, action, params
        )
        over = terminated | truncated
        return jax.vmap(where)(over, new, state), (obs, reward, terminated, truncated)

    return jax.lax.scan(step, first, (actions, fresh))[1]


def _gymnax(python: Path, count: int, stack: ExitStack) -> Work:
    """Work of another interpreter, which plays a turn whenever it is sent a line."""
    process: Any = stack.enter_context(subprocess.Popen(
        [python, EXAMPLES / "gymnax_cartpole.py", str(count), str(STEPS)], text=True, stdin=subprocess.PIPE,
        stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
    ))  # fmt: skip
    stack.callback(process.stdin.close)

    def work() -> float:
        print(file=process.stdin, flush=True)
        if not process.stdout.readline():
            raise InputError(f"--gymnax {python}: it cannot play; install gymnax there")
        return count * STEPS

    return work
