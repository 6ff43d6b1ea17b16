"""The Maze: DQN with and without fake episodes from a learned model (§4.2, Fig. 8, Table 2)."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxdyna.agents import DQNConfig, dqn
from jaxdyna.dyna import Dream, Dyna, DynaHParams, DynaState, Metrics
from jaxdyna.envs import FrameStack, Maze, MazeParams
from jaxdyna.envs.stack import StackState
from jaxdyna.experiments import cli
from jaxdyna.experiments.frame_dyna import frame_dyna
from jaxdyna.experiments.maze_oracle import ReplayedMaze, ReplayedParams
from jaxdyna.experiments.maze_planners import planner_arms
from jaxdyna.experiments.maze_train_options import (
    PRESETS,
    QUICK,
    Options,
    agent_config,
    dyna_config,
    model_config,
)
from jaxdyna.experiments.maze_train_report import MazeReport
from jaxdyna.experiments.run import Arm
from jaxdyna.experiments.session import Session
from jaxdyna.models import PixelConfig, pixels
from jaxdyna.planners import solve_maze
from jaxdyna.types import Transition

PROG = "python -m jaxdyna.experiments.maze"


class Parts(NamedTuple):
    """What decides the parts of an arm."""

    maze: Maze
    agent: DQNConfig
    model: PixelConfig
    steps: int


@cache
def make_dyna(parts: Parts) -> Dyna:
    """The parts of the ``dyna`` arm: one object, and so one program, for the same settings."""
    env = FrameStack(parts.maze)
    shape = (parts.maze.size, parts.maze.size, 3)
    agent = dqn(shape, env.num_actions, parts.agent)
    model = pixels(shape, env.num_actions, parts.model)

    def watch(real: Transition, begun: StackState, params: MazeParams) -> Metrics:
        return behaviour(parts.maze, parts.steps, real, begun, params)

    return frame_dyna(env, agent, model, watch)


def behaviour(
    maze: Maze, steps: int, real: Transition, begun: StackState, params: MazeParams
) -> Metrics:
    """What a real episode was like, and what was to be had in it.

    Args:
        maze: the true one.
        steps: of an episode, static.
        real: one episode ``[1, T]``.
        begun: the state it began in ``[1]``.
        params: the maze's.

    Returns:
        ``oracle_return``; ``collisions``; ``time_to_goal``, the steps until it is first reached,
        one more than the episode has where it is not; ``film_...``: what a film of it needs.
    """
    red, green, blue = jnp.moveaxis(real.next_obs[0, ..., -3:] > 0, -1, 0)
    collision, at_goal = ((one & blue).any((-1, -2)) for one in (red, green))
    reached = jnp.where(at_goal.any(), jnp.argmax(at_goal), steps) + 1
    start = jax.tree.map(lambda leaf: leaf[0], begun.env)
    return {
        "oracle_return": solve_maze(maze, start, params, steps).best_return,
        "collisions": collision.sum().astype(jnp.float32),
        "time_to_goal": reached.astype(jnp.float32),
        "film_action": real.action[0].astype(jnp.int8),
        "film_obstacles": start.obstacles.astype(jnp.int8),
        "film_directions": start.directions.astype(jnp.int8),
    }


def make_arms(options: Options) -> dict[str, Arm]:
    """The arms by name, each from the same parts. The oracle's dreams begin where those of ``dyna``
    do and are as many and as long, but the true maze goes on from there. The planners are made
    where ``options.arms`` names them.
    """
    maze = Maze(options.size, options.obstacles)
    dyna = make_dyna(Parts(maze, agent_config(options), model_config(options), options.steps))
    config, hparams = dyna_config(options), options.hparams
    hparams = replace(hparams, env=replace(hparams.env, max_steps=options.steps))
    untrained = replace(hparams, model_trains=False, disagreement_threshold=math.inf)
    all_real = replace(untrained, agent=replace(hparams.agent, fake_share=0.0))
    alone = dyna._replace(model=None, dream=None, diagnose=None)
    oracle = dyna._replace(dream=true_dream(maze), diagnose=None)
    planners = planner_arms(options, dyna, hparams)
    return {
        "model_free": Arm(alone, config, hparams),
        "dyna": Arm(dyna, config, hparams),
        "placebo": Arm(dyna, config, untrained),
        "more_updates": Arm(dyna._replace(diagnose=None), config, all_real),
        "oracle": Arm(oracle, replace(config, model_updates=0), hparams),
        **{name: make() for name, make in planners.items() if name in options.arms},
    }


@cache
def true_dream(maze: Maze) -> Dream:
    """The oracle's dreams."""

    def params(state: DynaState, hparams: DynaHParams) -> ReplayedParams:
        return ReplayedParams(hparams.env, state.replay, hparams.env.max_steps)

    return Dream(ReplayedMaze(FrameStack(maze)), params)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the experiment from the command line; returns the exit code."""
    arguments: Any = sys.argv[1:] if argv is None else argv
    options = cli.parse(QUICK if "--quick" in arguments else PRESETS, arguments, PROG)
    try:
        arms = make_arms(options)
    except ImportError as error:
        cli.fail(str(error), PROG)
    session = Session(
        experiment="maze",
        prog=PROG,
        argv=arguments,
        options=options,
        out=options.out or Path("runs") / f"maze-{options.preset}",
        rule=options.rule,
        keys=jax.random.split(jax.random.key(options.seed), options.seeds),
        report=MazeReport(options),
        block=1,
        piece=10,
    )
    return session.run({name: arms[name] for name in dict.fromkeys(options.arms)})
