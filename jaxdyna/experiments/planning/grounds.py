"""The two environments that planners and policies are compared in, and who is compared there."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from jaxdyna.dyna import Dyna, DynaConfig, DynaHParams, DynaState, experts, make_train
from jaxdyna.envs import Maze
from jaxdyna.experiments import cartpole, maze
from jaxdyna.experiments.maze.arms import agent_of, model_of
from jaxdyna.experiments.planning.budgets import Contender, Ground
from jaxdyna.experiments.study.arms import greedy
from jaxdyna.fields import changed, check, setting
from jaxdyna.planners import ShootingConfig, muzero, random_shooting, solve_maze
from jaxdyna.sweep import sweep
from jaxdyna.types import Key

#: steps that shooting without a value looks ahead in the Maze, as a multiple of the way to the
#: goal: a sequence with a drift towards the goal makes detours
FAR = 1.5
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
        at_least=1)  # fmt: skip
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


def cartpole_ground(key: Key, sizes: Sizes) -> Grounds:
    """CartPole, and what was learned there by `dyna` of the ``lean`` preset."""
    key_learn, _, key_play = jax.random.split(key, 3)
    episodes = {"episodes": sizes.cartpole_episodes}
    options = changed(cartpole.CARTPOLE.presets["lean"], episodes).resolved()
    dyna, steps = cartpole.arms.parts(options), options.dyna.num_steps
    state = learned(dyna, options.dyna, options.hparams, key_learn, sizes.runs[0])
    ground = Ground(
        "CartPole", dyna.env, options.hparams.env, state, steps,
        lambda start, params: jnp.float32(steps), key_play, sizes.played[0], sizes.batch,
    )  # fmt: skip
    yield ground, cartpole_contenders(dyna, options, sizes)


def cartpole_contenders(dyna: Dyna, options: Any, sizes: Sizes) -> Iterator[Contender]:
    """Who is compared in CartPole."""
    of, depth = partial(planner, dyna, options.hparams), options.mcts_rollout
    at_leaves = partial(experts.random_episodes, discount=options.mcts.discount, steps=depth)

    yield policy(dyna, options.hparams.agent)
    for count in sizes.candidates:
        near = replace(options.mpc, candidates=count)
        yield from of("MPC", count * near.horizon, random_shooting, near)
    for count in sizes.simulations:
        search = replace(options.mcts, simulations=count)
        yield from of("MCTS", count * (1 + depth), muzero, search, at_leaves)


def maze_ground(key: Key, sizes: Sizes) -> Grounds:
    """The Maze, likewise: after fewer episodes it is the same runs, not as far."""
    key_learn, key_play = jax.random.split(key)
    size, obstacles, steps = sizes.board
    after = sorted(set(sizes.maze_episodes))
    board = {"episodes": after[-1], "size": size, "obstacles": obstacles, "steps": steps}
    options = changed(maze.MAZE.presets["lean"], board).resolved()
    world = Maze(size, obstacles)

    def best(start: Any, params: Any) -> jax.Array:
        return solve_maze(world, start.env, params, steps).best_return

    dyna = maze.arms.parts(world, agent_of(options), model_of(options))
    for episodes in after:
        config, key = replace(options.dyna, num_episodes=episodes), jax.random.clone(key_learn)
        state = learned(dyna, config, options.hparams, key, sizes.runs[1])
        ground = Ground(
            f"Maze {size}x{size} after {episodes} episodes", dyna.env, options.hparams.env, state,
            steps, best, jax.random.clone(key_play), sizes.played[1], sizes.batch)  # fmt: skip
        yield ground, maze_contenders(dyna, options, sizes)


def maze_contenders(dyna: Dyna, options: Any, sizes: Sizes) -> Iterator[Contender]:
    """Who is compared in the Maze."""
    of = partial(planner, dyna, options.hparams)
    ahead, values = int(FAR * 2 * (options.size - 1)), experts.by_values(agent_of(options))

    yield policy(dyna, greedy(options.hparams.agent))
    for count in sizes.far_candidates:
        far = ShootingConfig(ahead, count, drift=3.0)
        yield of("MPC to the goal", count * ahead, random_shooting, far)[0]
    for count in sizes.candidates:
        near = replace(options.mpc, candidates=count)
        steps = count * near.horizon
        yield from of("MPC, learned values", steps, random_shooting, near, lambda _: values)
    for count in sizes.simulations:
        search = replace(options.mcts, simulations=count)
        yield from of("MCTS, learned values", count, muzero, search, lambda _: values)


def policy(dyna: Dyna, hparams: Any) -> Contender:
    """The forward pass of what a run has learned, with these hparams of the agent."""

    def act(state: DynaState, obs: jax.Array, true_state: Any, key: Key) -> jax.Array:
        return dyna.agent.act(state.agent, obs, key, hparams)

    return Contender("policy", "-", 0, act)


def planner(
    dyna: Dyna, hparams: DynaHParams, who: str, steps: int, make: experts.MakePlanner, config: Any,
    guide_in: Callable[[Any], experts.MakeGuide] = lambda world: experts.without_guide,
) -> tuple[Contender, Contender]:  # fmt: skip
    """One plans in the true environment from its state, one in the learned from what is seen."""
    assert dyna.dream is not None
    true, dreamed = dyna.env, dyna.dream.env
    plan, guide = make(true, config), guide_in(true)
    imagine = experts.on_model(dyna, make(dreamed, config), guide_in(dreamed))

    def knowing(state: DynaState, obs: jax.Array, true_state: Any, key: Key) -> jax.Array:
        told = guide(state, hparams, hparams.env)
        return plan(hparams.env, obs, true_state, key, told).action

    def seeing(state: DynaState, obs: jax.Array, true_state: Any, key: Key) -> jax.Array:
        return imagine(state, obs, key, hparams)

    return Contender(who, "true", steps, knowing), Contender(who, "learned", steps, seeing)


def learned(dyna: Dyna, config: DynaConfig, hparams: DynaHParams, key: Key, runs: int) -> DynaState:
    """Runs ``[runs, ...]`` after all their episodes, on one device, without keys: they are over."""
    states, _ = sweep(make_train(dyna, config), jax.random.split(key, runs), hparams, block=1)
    whole = jax.tree.map(lambda leaf: leaf[0], replace(states, key=None))
    return jax.device_put(whole, jax.devices()[0])
