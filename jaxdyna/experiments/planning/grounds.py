"""The two environments that planners and policies are compared in, and who is compared there."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from jaxdyna.dyna import Dyna, DynaState
from jaxdyna.envs import Maze
from jaxdyna.experiments import cartpole, maze
from jaxdyna.experiments.cartpole.arms import Dreams, random_episodes
from jaxdyna.experiments.engine import Arm
from jaxdyna.experiments.maze.arms import agent_of, model_of
from jaxdyna.experiments.maze.planned import by_values
from jaxdyna.experiments.planning.budgets import Contender, Ground
from jaxdyna.experiments.planning.contenders import (
    always,
    by,
    in_model,
    in_true,
    policy,
    rounds,
    untold,
)
from jaxdyna.experiments.study.arms import greedy
from jaxdyna.experiments.study.planners import without_guide
from jaxdyna.fields import changed, check, setting
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
from jaxdyna.sweep import over_runs

FAR = 1.5
"""Steps that shooting without a value looks ahead in the Maze, as a multiple of the way to the
goal: a sequence with a drift towards the goal makes detours."""
OWN_MODELS = "MPC, its own models"
OWN = f"{OWN_MODELS} (learned world)"


@dataclass(frozen=True)
class Sizes:
    """How much is played and tried."""

    runs: tuple[int, int] = setting(
        (4, 2), "runs that learn a model and a policy, in CartPole and in the Maze", at_least=1
    )
    cartpole_episodes: int = setting(30, "real episodes that each learns from", at_least=1)
    maze_episodes: tuple[int, ...] = setting(
        (30,), "the same for the Maze: it is played after each of so many", at_least=1
    )
    played: tuple[int, int] = setting(
        (3, 5), "episodes that a contender plays with what each run has learned, by environment",
        at_least=1,
    )  # fmt: skip
    candidates: tuple[int, ...] = setting(
        (8, 32), "sequences of random shooting; the most of them also in the rounds of the "
        "cross-entropy method", at_least=1,
    )  # fmt: skip
    simulations: tuple[int, ...] = setting((4, 16), "nodes of tree search", at_least=1)
    far_candidates: tuple[int, ...] = setting(
        (256,), "sequences of shooting in the true Maze, which is looked at to the goal", at_least=1
    )
    batch: int = setting(16, "environments that are decided for at once", at_least=1)
    board: tuple[int, int, int] = setting(
        (8, 3, 60), "the Maze's cells a side, obstacles, steps of an episode", at_least=0
    )

    def __post_init__(self) -> None:
        check(self)
        if not self.maze_episodes:
            raise ValueError("maze_episodes is empty: give one number at least")
        Maze(*self.board[:2])


def learned(arm: Arm, key: jax.Array, runs: int, after: Sequence[int]) -> list[DynaState]:
    """So many runs of the arm, ``[runs, ...]``, after each of so many real episodes, in order;
    without keys: nothing follows.
    """
    hparams = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], arm.hparams)
    start = jax.jit(over_runs(arm.work.init, 1))

    @partial(jax.jit, donate_argnums=0)
    def proceed(state: Any, first: jax.Array, end: jax.Array, hparams: Any) -> Any:
        def one(state: Any, hparams: Any) -> Any:
            def episode(number: jax.Array, state: Any) -> Any:
                return arm.work.step(state, None, number, hparams)[0]

            return jax.lax.fori_loop(first, end, episode, state)

        return over_runs(one, 1)(state, hparams)

    stages: list[list[DynaState]] = [[] for _ in after]
    for one in jax.random.split(key, runs):
        state, done = start(one[None], hparams), 0
        for stage, episodes in zip(stages, after, strict=True):
            state, done = proceed(state, done, episodes, hparams), episodes
            stage.append(jax.tree.map(lambda leaf: jnp.copy(leaf[0]), replace(state, key=None)))
    return [jax.tree.map(lambda *leaves: jnp.stack(leaves), *stage) for stage in stages]


def cartpole_ground(
    key: jax.Array, sizes: Sizes, wanted: Collection[str]
) -> Iterator[tuple[Ground, Iterator[Contender]]]:
    """CartPole, and what was learned there in the ``lean`` preset by `dyna`, and, if it is wanted,
    by `mpc`, whose models know a planner's episodes.
    """
    keys = jax.random.split(key, 3)
    names = ("dyna", "mpc") if OWN in wanted else ("dyna",)
    lean, episodes = cartpole.CARTPOLE.presets["lean"], sizes.cartpole_episodes
    options = changed(lean, {"episodes": episodes}).resolved()
    arms = cartpole.CARTPOLE.arms(options)
    dreams = Dreams(options.dream_start, options.dream_noise, options.authors_bug)
    dyna, hparams = cartpole.arms.parts(options.agent, options.model, dreams), options.hparams
    env, env_params, steps = dyna.env, hparams.env, options.dyna.num_steps
    states = [
        learned(arms[name](), key, sizes.runs[0], [episodes])[0]
        for name, key in zip(names, keys, strict=False)
    ]
    ground = Ground(
        "CartPole", env, env_params, states, steps, lambda start, params: jnp.float32(steps),
        keys[2], sizes.played[0], sizes.batch,
    )  # fmt: skip
    depth, discount = options.mcts_rollout, options.mcts.discount
    dreamt, planned = (partial(by, which) for which in (0, 1))

    def tried() -> Iterator[Contender]:
        yield dreamt(policy(dyna, hparams.agent))
        for count in sizes.candidates:
            config = replace(options.mpc, candidates=count)
            steps = count * config.horizon
            make: Any = partial(random_shooting, config=config)
            yield in_true("MPC", env, env_params, make, steps, untold)
            yield dreamt(in_model("MPC", dyna, hparams, make, steps, without_guide))
            if count == max(sizes.candidates):
                yield planned(in_model(OWN_MODELS, dyna, hparams, make, steps, without_guide))
                yield dreamt(in_model("CEM", dyna, hparams, rounds(config), steps, without_guide))
        for count in sizes.simulations:
            search = replace(options.mcts, simulations=count)
            make = partial(muzero, config=search)
            steps = count * (1 + depth)
            told = Guide(value=rollout_value(env, env_params, depth, discount))
            yield in_true("MCTS", env, env_params, make, steps, always(told))
            guided = random_episodes(dyna, discount, depth)
            yield dreamt(in_model("MCTS", dyna, hparams, make, steps, guided))
            if count == max(sizes.simulations):
                make = partial(gumbel_muzero, config=search)
                yield dreamt(in_model("MCTS, Gumbel", dyna, hparams, make, steps, guided))

    yield ground, tried()


def maze_ground(
    key: jax.Array, sizes: Sizes, wanted: Collection[str]
) -> Iterator[tuple[Ground, Iterator[Contender]]]:
    """The Maze, and what was learned there by `dyna` of the ``lean`` preset, stage by stage."""
    key_learn, key_play = jax.random.split(key)
    size, obstacles, steps = sizes.board
    after = sorted(set(sizes.maze_episodes))
    board = {"episodes": after[-1], "size": size, "obstacles": obstacles, "steps": steps}
    options = changed(maze.MAZE.presets["lean"], board).resolved()
    world = Maze(size, obstacles)

    def best(start: Any, params: Any) -> jax.Array:
        return solve_maze(world, start.env, params, steps).best_return

    stages = learned(maze.MAZE.arms(options)["dyna"](), key_learn, sizes.runs[1], after)
    dyna = maze.arms.parts(world, agent_of(options), model_of(options))
    for episodes, state in zip(after, stages, strict=True):
        ground = Ground(
            f"Maze {size}x{size} after {episodes} episodes", dyna.env, options.hparams.env, state,
            steps, best, jax.random.clone(key_play), sizes.played[1], sizes.batch,
        )  # fmt: skip
        yield ground, maze_contenders(dyna, options, sizes)


def maze_contenders(dyna: Dyna, options: Any, sizes: Sizes) -> Iterator[Contender]:
    """Who is compared in the Maze."""
    env: Any = dyna.env
    hparams, env_params = options.hparams, options.hparams.env
    values = by_values(agent_of(options))

    def told(state: DynaState) -> Guide:
        return values(state, hparams, None)

    discount = options.hparams.agent.discount
    far = ShootingConfig(int(FAR * 2 * (options.size - 1)), drift=3.0)
    near = replace(options.mpc, discount=discount)

    yield policy(dyna, greedy(hparams.agent))
    for count in sizes.far_candidates:
        make: Any = partial(random_shooting, config=replace(far, candidates=count))
        yield in_true("MPC to the goal", env, env_params, make, count * far.horizon, untold)
    for count in sizes.candidates:
        config = replace(near, candidates=count)
        make, steps = partial(random_shooting, config=config), count * near.horizon
        yield in_true("MPC, learned values", env, env_params, make, steps, told)
        yield in_model("MPC, learned values", dyna, hparams, make, steps, values)
        if count == max(sizes.candidates):
            yield in_model("CEM, learned values", dyna, hparams, rounds(config), steps, values)
    for count in sizes.simulations:
        search = SearchConfig(count, discount=discount)
        make = partial(muzero, config=search)
        yield in_true("MCTS, learned values", env, env_params, make, count, told)
        yield in_model("MCTS, learned values", dyna, hparams, make, count, values)
        if count == max(sizes.simulations):
            make = partial(gumbel_muzero, config=search)
            yield in_model("MCTS, Gumbel, learned values", dyna, hparams, make, count, values)
