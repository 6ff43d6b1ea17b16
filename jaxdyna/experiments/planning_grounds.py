"""The two environments that planners and policies are compared in, and who is compared there."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from jaxdyna.dyna import DynaState, make_advance, make_init
from jaxdyna.envs import Maze, MazeParams
from jaxdyna.experiments import cartpole, maze_train
from jaxdyna.experiments.cartpole_options import LEAN as CARTPOLE
from jaxdyna.experiments.cartpole_planners import random_episodes
from jaxdyna.experiments.maze_planners import by_values
from jaxdyna.experiments.maze_train_options import LEAN as MAZE
from jaxdyna.experiments.maze_train_options import agent_config
from jaxdyna.experiments.planner_arms import without_guide
from jaxdyna.experiments.planning_budgets import Contender, Ground
from jaxdyna.experiments.planning_contenders import (
    always,
    by,
    in_model,
    in_true,
    policy,
    rounds,
    untold,
)
from jaxdyna.experiments.run import Arm
from jaxdyna.planners import (
    Guide,
    SearchConfig,
    ShootingConfig,
    gumbel_muzero,
    muzero,
    random_shooting,
    rollout_value,
    solve_maze,
)
from jaxdyna.sweep import AXES, make_pieces

GREEDY = {"epsilon_first": 0.0, "epsilon_last": 0.0}
FAR = 1.5
"""Steps that shooting without a value looks ahead in the Maze, as a multiple of the way to the
goal: a sequence with a drift towards the goal makes detours."""
OWN_MODELS = "MPC, its own models"
OWN = f"{OWN_MODELS} (learned world)"


@dataclass(frozen=True)
class Sizes:
    """How much is played and tried.

    Attributes:
        runs: that learn a model and a policy, in CartPole and in the Maze.
        cartpole_episodes: real episodes that each learns from.
        maze_episodes: the same for the Maze: it is played after each of so many.
        played: episodes that a contender plays with what each run has learned, by environment.
        candidates: sequences of random shooting; the most of them also in the rounds of the
            cross-entropy method.
        simulations: nodes of tree search.
        far_candidates: sequences of shooting in the true Maze, which is looked at to the goal.
        batch: environments that are decided for at once.
        board: the Maze's cells a side, obstacles, steps of an episode.
    """

    runs: tuple[int, int] = (4, 2)
    cartpole_episodes: int = 30
    maze_episodes: tuple[int, ...] = (30,)
    played: tuple[int, int] = (3, 5)
    candidates: tuple[int, ...] = (8, 32)
    simulations: tuple[int, ...] = (4, 16)
    far_candidates: tuple[int, ...] = (256,)
    batch: int = 16
    board: tuple[int, int, int] = (8, 3, 60)

    def check(self) -> None:
        """Raises ValueError where a number is no count."""
        for name, value in vars(self).items():
            numbers = value if isinstance(value, tuple) else (value,)
            flag = f"--sizes.{name.replace('_', '-')}"
            if min(numbers, default=1) < (0 if name == "board" else 1):
                raise ValueError(f"{flag}: give numbers of at least 1")
        if not self.maze_episodes:
            raise ValueError("--sizes.maze-episodes is empty: give one number at least")
        Maze(*self.board[:2])
        MazeParams(max_steps=self.board[2])


def learned(arm: Arm, key: jax.Array, runs: int, after: Sequence[int]) -> list[DynaState]:
    """So many runs of the arm, ``[runs, ...]``, after each of so many real episodes, in order;
    without keys: nothing follows.
    """
    dyna = arm.dyna._replace(diagnose=None, watch=None)
    config = replace(arm.config, num_episodes=after[-1])
    parts = make_init(dyna, config), make_advance(dyna, config, AXES)
    start, proceed = make_pieces(*parts, block=1)
    state: Any = start(jax.random.split(key, runs), arm.hparams)
    piece, stages = math.gcd(*after), []
    for begun in range(0, after[-1], piece):
        state, _ = proceed(state, jnp.arange(begun, begun + piece), arm.hparams)
        if begun + piece in after:
            one = jax.tree.map(lambda leaf: jnp.copy(leaf[0]), replace(state, key=None))
            stages.append(jax.device_put(one, jax.devices()[0]))
    return stages


def cartpole_ground(
    key: jax.Array, sizes: Sizes, wanted: Collection[str]
) -> Iterator[tuple[Ground, Iterator[Contender]]]:
    """CartPole, and what was learned there in the ``lean`` preset by `dyna`, and, if it is wanted,
    by `mpc`, whose models know a planner's episodes.
    """
    keys = jax.random.split(key, 3)
    names: Any = ("dyna", "mpc") if OWN in wanted else ("dyna",)
    options = replace(CARTPOLE, episodes=sizes.cartpole_episodes, arms=names)
    arms = cartpole.make_arms(options)
    arm = arms["dyna"]
    env_params = arm.hparams.env
    states = [
        learned(arms[name], key, sizes.runs[0], [options.episodes])[0]
        for name, key in zip(names, keys, strict=False)
    ]
    ground = Ground(
        "CartPole", arm.dyna.env, env_params, states, options.num_steps,
        lambda start, params: jnp.float32(options.num_steps), keys[2], sizes.played[0], sizes.batch,
    )  # fmt: skip
    depth, discount, env = options.mcts_rollout, options.mcts.discount, arm.dyna.env
    dreamt, planned = (partial(by, which) for which in (0, 1))

    def tried() -> Iterator[Contender]:
        yield dreamt(policy(arm))
        for count in sizes.candidates:
            config = replace(options.mpc, candidates=count)
            steps = count * config.horizon
            make: Any = partial(random_shooting, config=config)
            yield in_true("MPC", env, env_params, make, steps, untold)
            yield dreamt(in_model("MPC", arm, make, steps, without_guide))
            if count == max(sizes.candidates):
                yield planned(in_model(OWN_MODELS, arm, make, steps, without_guide))
                yield dreamt(in_model("CEM", arm, rounds(config), steps, without_guide))
        for count in sizes.simulations:
            search = replace(options.mcts, simulations=count)
            make = partial(muzero, config=search)
            steps = count * (1 + depth)
            told = Guide(value=rollout_value(env, env_params, depth, discount))
            yield in_true("MCTS", env, env_params, make, steps, always(told))
            guided = random_episodes(arm.dyna, discount, depth)
            yield dreamt(in_model("MCTS", arm, make, steps, guided))
            if count == max(sizes.simulations):
                make = partial(gumbel_muzero, config=search)
                yield dreamt(in_model("MCTS, Gumbel", arm, make, steps, guided))

    yield ground, tried()


def maze_ground(
    key: jax.Array, sizes: Sizes, wanted: Collection[str]
) -> Iterator[tuple[Ground, Iterator[Contender]]]:
    """The Maze, and what was learned there by `dyna` of the ``lean`` preset, stage by stage."""
    key_learn, key_play = jax.random.split(key)
    size, obstacles, steps = sizes.board
    after = sorted(set(sizes.maze_episodes))
    options = replace(MAZE, episodes=after[-1], size=size, obstacles=obstacles, steps=steps)
    arm = maze_train.make_arms(options)["dyna"]
    maze = Maze(size, obstacles)

    def best(start: Any, params: Any) -> jax.Array:
        return solve_maze(maze, start.env, params, steps).best_return

    stages = learned(arm, key_learn, sizes.runs[1], after)
    for episodes, state in zip(after, stages, strict=True):
        ground = Ground(
            f"Maze {size}x{size} after {episodes} episodes", arm.dyna.env, arm.hparams.env, state,
            steps, best, jax.random.clone(key_play), sizes.played[1], sizes.batch,
        )  # fmt: skip
        yield ground, maze_contenders(arm, options, sizes)


def maze_contenders(arm: Arm, options: Any, sizes: Sizes) -> Iterator[Contender]:
    """Who is compared in the Maze."""
    env: Any = arm.dyna.env
    env_params = arm.hparams.env
    values = by_values(agent_config(options))

    def told(state: DynaState) -> Guide:
        return values(state, arm.hparams, None)

    discount = options.hparams.agent.discount
    far = ShootingConfig(int(FAR * 2 * (options.size - 1)), drift=3.0)
    near = replace(options.mpc, discount=discount)

    yield policy(arm, **GREEDY)
    for count in sizes.far_candidates:
        make: Any = partial(random_shooting, config=replace(far, candidates=count))
        yield in_true("MPC to the goal", env, env_params, make, count * far.horizon, untold)
    for count in sizes.candidates:
        config = replace(near, candidates=count)
        make, steps = partial(random_shooting, config=config), count * near.horizon
        yield in_true("MPC, learned values", env, env_params, make, steps, told)
        yield in_model("MPC, learned values", arm, make, steps, values)
        if count == max(sizes.candidates):
            yield in_model("CEM, learned values", arm, rounds(config), steps, values)
    for count in sizes.simulations:
        search = SearchConfig(count, discount=discount)
        make = partial(muzero, config=search)
        yield in_true("MCTS, learned values", env, env_params, make, count, told)
        yield in_model("MCTS, learned values", arm, make, count, values)
        if count == max(sizes.simulations):
            make = partial(gumbel_muzero, config=search)
            yield in_model("MCTS, Gumbel, learned values", arm, make, count, values)
