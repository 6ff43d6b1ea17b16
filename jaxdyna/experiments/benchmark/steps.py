"""Steps of environments a second, many of them at once."""

import subprocess
from collections.abc import Iterable
from contextlib import ExitStack, suppress
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna.actions import actions_of
from jaxdyna.envs import CartPole, Maze
from jaxdyna.envs.gymnasium import gymnasium
from jaxdyna.experiments.benchmark.others import EXAMPLES, rival
from jaxdyna.experiments.benchmark.timing import OURS, Work, compared, in_units, jitted
from jaxdyna.experiments.engine import InputError, Results
from jaxdyna.trees import where
from jaxdyna.types import Environment, Key

STEPS = 16  #: of a turn. Pushed so for so long, no pole falls.
EPISODE = 200  #: of one Maze in NumPy, of which a reset takes as long as ten
EPISODES = 16  #: of each environment in one call of ours, so that a call is long
SHORTEST = 8  #: steps, of all CartPole's episodes
PUSHES = np.resize([0, 1, 1, 0], STEPS)


def measure(options: Any) -> Iterable[Results]:
    """CartPole against Gymnasium's vector environment and gymnax; the Maze against NumPy."""
    count, rounds, numpys = options.envs, options.rounds, rival("numpy_maze")
    cartpole, maze, key = CartPole(), Maze(), jax.random.key(options.seed)
    units, rng = count * STEPS, np.random.default_rng(options.seed)
    pushes = np.tile(PUSHES[:, None], (1, count))
    moves = rng.integers(maze.num_actions, size=(STEPS, count))
    envs: Any = gymnasium.make_vec("CartPole-v1", count, "vector_entry_point")

    def ours(env: Environment, actions: np.ndarray) -> Work:
        reset = jax.vmap(jax.vmap(env.reset, (0, None)), (0, None))
        key_step, key_reset = jax.random.split(jax.random.key(options.seed))
        starts = reset(jax.random.split(key_reset, (EPISODES, count)), env.default_params)
        return jitted(partial(given, env), key_step, starts, actions, units=EPISODES * units)

    def gymnasiums(actions: Iterable[np.ndarray]) -> None:
        envs.reset(seed=options.seed)
        for action in actions:
            envs.step(action)

    plain = numpys and numpys.NumpyMaze(options.seed)

    def one_maze() -> None:
        plain.reset()
        for action in np.resize(moves, EPISODE):
            plain.step(action)

    yield from compared("CartPole, actions given", "steps/s", {
        OURS: ours(cartpole, pushes),
        "Gymnasium": in_units(lambda: gymnasiums(pushes), units),
    }, rounds)  # fmt: skip
    with ExitStack() as stack:
        other = {"gymnax": gymnax(options.gymnax, count, stack)} if options.gymnax else {}
        yield from compared("CartPole, actions and resets at random", "steps/s", {
            OURS: jitted(partial(at_random, cartpole, count), key, units=units),
            "Gymnasium": in_units(lambda: gymnasiums(rng.integers(2, size=pushes.shape)), units),
            **other,
        }, rounds)  # fmt: skip
    yield from compared("Maze, frames", "steps/s", {
        OURS: ours(maze, moves),
        "NumPy, one core": numpys and in_units(one_maze, EPISODE),
    }, rounds)  # fmt: skip


def given(env: Environment, key: Key, starts: Any, actions: jax.Array) -> Any:
    """What is seen in the end, and earned on the way, by actions ``[T, N]`` from observations and
    states ``[E, N]`` of so many episodes, one after the other. What is seen is carried, so that it
    is made in every step, but not kept.
    """

    def step(carry: Any, action: jax.Array) -> Any:
        played = jax.vmap(env.step, (None, 0, 0, None))(key, carry[1], action, env.default_params)
        obs, state, *earned, _ = played
        return (obs, state), earned

    return jax.lax.map(lambda start: jax.lax.scan(step, start, actions), starts)


def at_random(env: Environment, count: int, key: Key) -> Any:
    """The same by actions at random, those that are over reset. Numbers are drawn for all steps at
    once, a start for as many steps as no episode is shorter than.
    """
    params, (key_step, key_actions, key_resets) = env.default_params, jax.random.split(key, 3)
    actions = actions_of(env).uniform(key_actions, (STEPS, count))
    keys = jax.random.split(key_resets, (1 + STEPS // SHORTEST, count))
    resets = jax.vmap(jax.vmap(env.reset, (0, None)), (0, None))(keys, params)
    first = jax.tree.map(itemgetter(0), resets)
    fresh = jax.tree.map(lambda leaf: jnp.repeat(leaf[1:], SHORTEST, axis=0), resets)

    def step(carry: Any, drawn: Any) -> Any:
        action, new = drawn
        played = jax.vmap(env.step, (None, 0, 0, None))(key_step, carry[1], action, params)
        obs, state, reward, terminated, truncated, _ = played
        over = terminated | truncated
        return jax.vmap(where)(over, new, (obs, state)), (reward, terminated, truncated)

    return jax.lax.scan(step, first, (actions, fresh))


def gymnax(python: Path, count: int, stack: ExitStack) -> Work:
    """Work of another interpreter, which plays a turn whenever it is sent a line."""
    words = [str(python), str(EXAMPLES / "gymnax_cartpole.py"), str(count), str(STEPS)]
    pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    process: Any = stack.enter_context(subprocess.Popen(words, bufsize=0, **pipes))
    stack.callback(process.stdin.close)

    def turn() -> None:
        with suppress(BrokenPipeError):
            process.stdin.write(b"\n")
        if not process.stdout.readline():
            raise InputError(f"--gymnax {python} cannot play: install gymnax there")

    return in_units(turn, count * STEPS)
