"""The two environments that planners and policies are compared in, and who is compared there."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from jaxdyna.dyna import Dyna, DynaState, make_train
from jaxdyna.envs import Maze
from jaxdyna.experiments import cartpole, maze_train
from jaxdyna.experiments.cartpole_options import LEAN as CARTPOLE
from jaxdyna.experiments.cartpole_planners import random_episodes
from jaxdyna.experiments.maze_planners import by_values
from jaxdyna.experiments.maze_train_options import LEAN as MAZE
from jaxdyna.experiments.maze_train_options import QUICK, agent_config
from jaxdyna.experiments.planner_arms import MakeGuide, on_model, without_guide
from jaxdyna.experiments.planning_budgets import Contender, Ground
from jaxdyna.experiments.run import Arm
from jaxdyna.planners import (
    Guide,
    Planner,
    SearchConfig,
    ShootingConfig,
    muzero,
    random_shooting,
    rollout_value,
    solve_maze,
)
from jaxdyna.sweep import sweep

GREEDY = {"epsilon_first": 0.0, "epsilon_last": 0.0}
FAR = 1.5
"""Steps that shooting without a value looks ahead in the Maze, as a multiple of the way to the
goal: a sequence with a drift towards the goal makes detours."""


@dataclass(frozen=True)
class Sizes:
    """How much is played and tried.

    Attributes:
        runs: that learn a model and a policy, by environment.
        episodes: real episodes of each.
        played: episodes that a contender plays with what each has learned.
        candidates: sequences of random shooting.
        simulations: nodes of tree search.
        far_candidates: sequences of shooting in the true Maze, which is looked at to the goal.
        batch: environments that are decided for at once.
        small_maze: a Maze of 6x6 cells.
    """

    runs: tuple[int, int] = (8, 2)
    episodes: tuple[int, int] = (30, 25)
    played: tuple[int, int] = (3, 5)
    candidates: tuple[int, ...] = (8, 32)
    simulations: tuple[int, ...] = (8, 48)
    far_candidates: tuple[int, ...] = (16, 256)
    batch: int = 16
    small_maze: bool = False


def learned(arm: Arm, key: jax.Array, runs: int) -> DynaState:
    """So many runs of the arm to their end, ``[runs, ...]``; without keys: nothing follows."""
    train = make_train(arm.dyna._replace(diagnose=None, watch=None), arm.config)
    states: Any = sweep(train, jax.random.split(key, runs), arm.hparams, block=1)[0]
    ended = replace(states, key=None)
    return jax.device_put(jax.tree.map(lambda leaf: leaf[0], ended), jax.devices()[0])


def cartpole_ground(key: jax.Array, sizes: Sizes) -> tuple[Ground, Iterator[Contender]]:
    """CartPole, and what was learned there by `dyna` of the ``lean`` preset."""
    key_learn, key_play = jax.random.split(key)
    options = replace(CARTPOLE, episodes=sizes.episodes[0])
    arm = cartpole.make_arms(options)["dyna"]
    env_params = arm.hparams.env
    ground = Ground(
        "CartPole", arm.dyna.env, env_params, learned(arm, key_learn, sizes.runs[0]),
        options.num_steps, lambda start, params: jnp.float32(options.num_steps), key_play,
        sizes.played[0], sizes.batch,
    )  # fmt: skip
    depth, discount, env = options.mcts_rollout, options.mcts.discount, arm.dyna.env

    def tried() -> Iterator[Contender]:
        yield policy(arm)
        for count in sizes.candidates:
            config = replace(options.mpc, candidates=count)
            steps = count * config.horizon
            make: Any = partial(random_shooting, config=config)
            yield in_true("MPC", env, env_params, make, steps, untold)
            yield in_model("MPC", arm, make, steps, without_guide)
        for count in sizes.simulations:
            make = partial(muzero, config=replace(options.mcts, simulations=count))
            steps = count * (1 + depth)
            told = Guide(value=rollout_value(env, env_params, depth, discount))
            yield in_true("MCTS", env, env_params, make, steps, always(told))
            guided = random_episodes(arm.dyna, discount, depth)
            yield in_model("MCTS", arm, make, steps, guided)

    return ground, tried()


def maze_ground(key: jax.Array, sizes: Sizes) -> tuple[Ground, Iterator[Contender]]:
    """The Maze, and what was learned there by `dyna` of the ``lean`` preset."""
    key_learn, key_play = jax.random.split(key)
    options = replace(QUICK["lean"] if sizes.small_maze else MAZE, episodes=sizes.episodes[1])
    arm = maze_train.make_arms(options)["dyna"]
    maze, env_params = Maze(options.size, options.obstacles), arm.hparams.env
    env: Any = arm.dyna.env

    def best(start: Any, params: Any) -> jax.Array:
        return solve_maze(maze, start.env, params, options.steps).best_return

    ground = Ground(
        "Maze", env, env_params, learned(arm, key_learn, sizes.runs[1]), options.steps, best,
        key_play, sizes.played[1], sizes.batch,
    )  # fmt: skip
    values = by_values(agent_config(options))

    def told(state: DynaState) -> Guide:
        return values(state, arm.hparams, None)

    discount = options.hparams.agent.discount
    far = ShootingConfig(int(FAR * 2 * (options.size - 1)), drift=3.0)
    near = replace(options.mpc, discount=discount)

    def tried() -> Iterator[Contender]:
        yield policy(arm, **GREEDY)
        for count in sizes.far_candidates:
            make: Any = partial(random_shooting, config=replace(far, candidates=count))
            yield in_true("MPC to the goal", env, env_params, make, count * far.horizon, untold)
        for count in sizes.candidates:
            make = partial(random_shooting, config=replace(near, candidates=count))
            steps = count * near.horizon
            yield in_true("MPC, learned values", env, env_params, make, steps, told)
            yield in_model("MPC, learned values", arm, make, steps, values)
        for count in sizes.simulations:
            config = SearchConfig(count, discount=discount)
            make = partial(muzero, config=config)
            yield in_true("MCTS, learned values", env, env_params, make, count, told)
            yield in_model("MCTS, learned values", arm, make, count, values)

    return ground, tried()


def policy(arm: Arm, **changes: Any) -> Contender:
    """The forward pass of what a run has learned."""
    hparams = replace(arm.hparams.agent, **changes)

    def act(state: DynaState, obs: jax.Array, true_state: Any, key: jax.Array) -> jax.Array:
        return arm.dyna.agent.act(state.agent, obs, key, hparams)

    return Contender("policy", "-", 0, act)


def always(guide: Guide) -> Callable[[DynaState], Guide]:
    """The same whatever a run has learned."""
    return lambda state: guide


def untold(state: DynaState) -> Guide:
    """Nothing of what a run has learned."""
    return Guide()


def in_true(
    who: str,
    env: Any,
    env_params: Any,
    make: Callable[[Any], Planner],
    steps: int,
    told: Callable[[DynaState], Guide],
) -> Contender:
    """A planner in the true environment, from the true state."""
    planner = make(env)

    def act(state: DynaState, obs: jax.Array, true_state: Any, key: jax.Array) -> jax.Array:
        return planner(env_params, obs, true_state, key, told(state)).action

    return Contender(who, "true", steps, act)


def in_model(
    who: str, arm: Arm, make: Callable[[Any], Planner], steps: int, guide: MakeGuide
) -> Contender:
    """A planner in the learned environment, from what is seen."""
    dyna: Dyna = arm.dyna
    assert dyna.dream is not None
    decide = on_model(dyna, make(dyna.dream.env), guide)

    def act(state: DynaState, obs: jax.Array, true_state: Any, key: jax.Array) -> jax.Array:
        return decide(state, obs, key, arm.hparams)

    return Contender(who, "learned", steps, act)
