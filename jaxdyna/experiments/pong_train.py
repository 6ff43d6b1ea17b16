"""Pong: DQN with and without fake episodes from learned models (§4.3)."""

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

from jaxdyna.agents import DQNConfig
from jaxdyna.dyna import Dream, Dyna, DynaHParams, DynaState, Metrics
from jaxdyna.envs import AtariPong, FrameStack, GreyFrames, Pong
from jaxdyna.envs.stack import StackState
from jaxdyna.experiments import cli
from jaxdyna.experiments.frame_dyna import frame_dyna
from jaxdyna.experiments.pong_colours import in_colours
from jaxdyna.experiments.pong_guided import GuidedDream, GuidedParams
from jaxdyna.experiments.pong_judge import OBJECTS
from jaxdyna.experiments.pong_options import adversary_config
from jaxdyna.experiments.pong_train_options import PRESETS, QUICK, Options
from jaxdyna.experiments.pong_train_parts import (
    TRUE_OBJECTS,
    agent_config,
    busier,
    dyna_config,
    env_params,
    make_agent,
    model_config,
    world_of,
)
from jaxdyna.experiments.pong_train_report import PongReport
from jaxdyna.experiments.run import Arm
from jaxdyna.experiments.session import Session
from jaxdyna.models import (
    AdversarialHParams,
    AdversaryConfig,
    PixelConfig,
    RectangleConfig,
    discriminator,
    pixels,
    rectangles,
)
from jaxdyna.types import Transition

PROG = "python -m jaxdyna.experiments.pong"


class Parts(NamedTuple):
    """What decides the parts of an arm."""

    game: Pong | AtariPong | GreyFrames
    agent: DQNConfig
    model: PixelConfig | RectangleConfig
    adversary: AdversaryConfig | None


@cache
def make_dyna(parts: Parts) -> Dyna:
    """The parts of an arm that dreams: one object, and so one program, for the same settings."""
    env, shape = FrameStack(parts.game), parts.game.frame_shape
    agent = make_agent(shape, env.num_actions, parts.agent)
    if isinstance(parts.model, RectangleConfig):
        assert not isinstance(parts.game, GreyFrames)
        model = in_colours(rectangles(shape, env.num_actions, parts.model), parts.game.palette)
    else:
        judge = None if parts.adversary is None else discriminator(shape, parts.adversary)
        model = pixels(shape, env.num_actions, parts.model, adversary=judge)
    return frame_dyna(env, agent, model, points)


def points(real: Transition, begun: StackState, params: Any) -> Metrics:
    """Points of either side in one real episode ``[1, T]``."""
    del begun, params
    reward = real.reward * real.mask
    return {"won": (reward > 0).sum(dtype=jnp.float32), "lost": (reward < 0).sum(dtype=jnp.float32)}


@cache
def guided(dyna: Dyna, truth: tuple[int, ...] | None) -> Dream:
    """Dreams of the same model with the true game's objects in these channels; None: all of the
    true game's.
    """
    predict = dyna.model.predict if truth is not None and dyna.model is not None else None
    env: Any = dyna.env

    def params(state: DynaState, hparams: DynaHParams) -> GuidedParams:
        weights = state.model.params if predict is not None else None
        return GuidedParams(weights, hparams.env, state.replay, hparams.env.max_steps)

    return Dream(GuidedDream(env, predict, truth or tuple(OBJECTS.values())), params)


def make_arms(options: Options) -> dict[str, Arm]:
    """The arms by name, each from the same parts. Dreams of all arms begin where those of ``dyna``
    do and are as many and as long.
    """
    game, agent = world_of(options), agent_config(options)

    def of(model: str) -> Dyna:
        other = adversary_config(game.frame_shape[0]) if model == "adversarial" else None
        return make_dyna(Parts(game, agent, model_config(options, model), other))

    blurred, config = of("l2"), dyna_config(options)
    hparams = replace(options.hparams, env=env_params(options))
    rate, weight = options.paper_rate, options.adversarial_weight
    theirs = replace(hparams, model=AdversarialHParams(rate, weight, rate))
    alone = blurred._replace(model=None, dream=None, diagnose=None)
    more = make_dyna(Parts(game, busier(agent), model_config(options, "l2"), None))
    arms = {
        "model_free": Arm(alone, config, hparams),
        "more_updates": Arm(alone._replace(agent=more.agent), config, hparams),
        "dyna_l2": Arm(blurred, config, theirs),
        "dyna_adversarial": Arm(of("adversarial"), config, theirs),
    }
    if options.frames == "grey":
        return arms
    ours = of("ours")
    untrained = replace(hparams, model_trains=False, disagreement_threshold=math.inf)
    arms |= {"dyna": Arm(ours, config, hparams), "placebo": Arm(ours, config, untrained)}
    if options.game == "ale" or options.frames == "rgb":
        return arms
    oracle = ours._replace(dream=guided(ours, None), diagnose=None)
    arms["oracle"] = Arm(oracle, replace(config, model_updates=0), hparams)
    for name, things in TRUE_OBJECTS.items():
        mended = blurred._replace(dream=guided(blurred, tuple(OBJECTS[thing] for thing in things)))
        arms[name] = Arm(mended, config, theirs)
    return arms


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the experiment from the command line; returns the exit code."""
    arguments: Any = sys.argv[1:] if argv is None else argv
    options = cli.parse(QUICK if "--quick" in arguments else PRESETS, arguments, PROG)
    arms = make_arms(options)
    session = Session(
        experiment="pong",
        prog=PROG,
        argv=arguments,
        options=options,
        out=options.out or Path("runs") / f"pong-{options.preset}",
        rule=options.rule,
        keys=jax.random.split(jax.random.key(options.seed), options.seeds),
        report=PongReport(options),
        block=1,
        piece=10,
    )
    return session.run({name: arms[name] for name in dict.fromkeys(options.arms)})
