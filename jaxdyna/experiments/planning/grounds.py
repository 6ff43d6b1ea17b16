"""The two environments that planners and policies are compared in, and who is compared there."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import itemgetter
from typing import Any

import jax
import jax.numpy as jnp

from jaxdyna import planners
from jaxdyna.dyna import Dyna, DynaHParams, DynaState
from jaxdyna.envs import Maze
from jaxdyna.experiments import cartpole, maze
from jaxdyna.experiments.engine import Arm
from jaxdyna.experiments.maze.arms import agent_of, model_of
from jaxdyna.experiments.planning.budgets import Contender, Ground
from jaxdyna.experiments.study import planners as guides
from jaxdyna.experiments.study.arms import greedy
from jaxdyna.fields import changed, check, setting
from jaxdyna.sweep import over_runs

FAR = 1.5
"""Steps that shooting without a value looks ahead in the Maze, as a multiple of the way to the
goal: a sequence with a drift towards the goal makes detours."""
Grounds = Iterator[tuple[Ground, Iterator[Contender]]]


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
    candidates: tuple[int, ...] = setting((8, 32), "sequences of random shooting", at_least=1)
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
        Maze(*self.board[:2])


def cartpole_ground(key: jax.Array, sizes: Sizes) -> Grounds:
    """CartPole, and what was learned there by `dyna` of the ``lean`` preset."""
    key_learn, _, key_play = jax.random.split(key, 3)
    episodes = {"episodes": sizes.cartpole_episodes}
    options = changed(cartpole.CARTPOLE.presets["lean"], episodes).resolved()
    dyna, steps = cartpole.arms.parts(options), options.dyna.num_steps
    arm = cartpole.CARTPOLE.arms(options)["dyna"]()
    [state] = learned(arm, key_learn, sizes.runs[0], [sizes.cartpole_episodes])
    ground = Ground(
        "CartPole", dyna.env, options.hparams.env, state, steps,
        lambda start, params: jnp.float32(steps), key_play, sizes.played[0], sizes.batch,
    )  # fmt: skip
    yield ground, cartpole_contenders(dyna, options, sizes)


def cartpole_contenders(dyna: Dyna, options: Any, sizes: Sizes) -> Iterator[Contender]:
    """Who is compared in CartPole."""
    depth, discount = options.mcts_rollout, options.mcts.discount
    of = partial(planner, dyna, options.hparams)

    yield policy(dyna, options.hparams.agent)
    for count in sizes.candidates:
        shooting = replace(options.mpc, candidates=count)
        for world, env in worlds(dyna).items():
            plan, steps = planners.random_shooting(env, shooting), count * shooting.horizon
            yield of("MPC", world, steps, plan, guides.without_guide)
    for count in sizes.simulations:
        search = replace(options.mcts, simulations=count)
        for world, env in worlds(dyna).items():
            plan, steps = planners.muzero(env, search), count * (1 + depth)
            guide = guides.random_episodes(env, discount, depth)
            yield of("MCTS", world, steps, plan, guide)


def maze_ground(key: jax.Array, sizes: Sizes) -> Grounds:
    """The Maze, and what was learned there by `dyna` of the ``lean`` preset, stage by stage."""
    key_learn, key_play = jax.random.split(key)
    size, obstacles, steps = sizes.board
    after = sorted(set(sizes.maze_episodes))
    board = {"episodes": after[-1], "size": size, "obstacles": obstacles, "steps": steps}
    options = changed(maze.MAZE.presets["lean"], board).resolved()
    world = Maze(size, obstacles)

    def best(start: Any, params: Any) -> jax.Array:
        return planners.solve_maze(world, start.env, params, steps).best_return

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
    discount, values = options.hparams.agent.discount, guides.by_values(agent_of(options))
    far = planners.ShootingConfig(int(FAR * 2 * (options.size - 1)), drift=3.0)
    of = partial(planner, dyna, options.hparams)

    yield policy(dyna, greedy(options.hparams.agent))
    for count in sizes.far_candidates:
        plan = planners.random_shooting(dyna.env, replace(far, candidates=count))
        yield of("MPC to the goal", "true", count * far.horizon, plan, guides.without_guide)
    for count in sizes.candidates:
        near = replace(options.mpc, candidates=count, discount=discount)
        for world, env in worlds(dyna).items():
            plan, steps = planners.random_shooting(env, near), count * near.horizon
            yield of("MPC, learned values", world, steps, plan, values)
    for count in sizes.simulations:
        search = planners.SearchConfig(count, discount=discount)
        for world, env in worlds(dyna).items():
            yield of("MCTS, learned values", world, count, planners.muzero(env, search), values)


def worlds(dyna: Dyna) -> dict[str, Any]:
    """What can be planned in."""
    assert dyna.dream is not None
    return {"true": dyna.env, "learned": dyna.dream.env}


def policy(dyna: Dyna, hparams: Any) -> Contender:
    """The forward pass of what a run has learned, with these hparams of the agent."""

    def act(state: DynaState, obs: jax.Array, true_state: Any, key: jax.Array) -> jax.Array:
        return dyna.agent.act(state.agent, obs, key, hparams)

    return Contender("policy", "-", 0, act)


def planner(
    dyna: Dyna, hparams: DynaHParams, who: str, world: str, steps: int, plan: planners.Planner,
    guide: guides.MakeGuide,
) -> Contender:  # fmt: skip
    """Plans in the true environment from the true state, in the learned one from what is seen."""
    decide = guides.on_model(dyna, plan, guide)

    def act(state: DynaState, obs: jax.Array, true_state: Any, key: jax.Array) -> jax.Array:
        if world == "learned":
            return decide(state, obs, key, hparams)
        told = guide(state, hparams, hparams.env)
        return plan(hparams.env, obs, true_state, key, told).action

    return Contender(who, world, steps, act)


def learned(arm: Arm, key: jax.Array, runs: int, after: Sequence[int]) -> list[DynaState]:
    """So many runs of the arm, ``[runs, ...]``, after each of so many real episodes, in order;
    without keys: nothing follows.
    """
    ends = jnp.array([(0, *after[:-1]), after]).T

    def whole(key: jax.Array, hparams: Any) -> Any:
        def episode(number: jax.Array, state: Any) -> Any:
            return arm.work.step(state, None, number, hparams)[0]

        def stage(state: Any, end: jax.Array) -> tuple[Any, Any]:
            state = jax.lax.fori_loop(end[0], end[1], episode, state)
            return state, replace(state, key=None)

        return jax.lax.scan(stage, arm.work.init(key, hparams), ends)[1]

    hparams = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], arm.hparams)
    run = jax.jit(over_runs(whole, 1))
    states = [run(one[None], hparams) for one in jax.random.split(key, runs)]
    stages = jax.tree.map(lambda *leaves: jnp.concatenate(leaves).swapaxes(0, 1), *states)
    return [jax.tree.map(itemgetter(number), stages) for number in range(len(after))]
