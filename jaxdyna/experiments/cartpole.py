"""CartPole: REINFORCE with and without a learned model (§4.1, Figs. 5 and 6, Table 2).

``python -m jaxdyna.experiments.cartpole`` plays 10 runs of each arm and writes the report.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxdyna import replay
from jaxdyna.agents import ReinforceConfig, reinforce
from jaxdyna.dyna import Dream, Dyna, DynaHParams, DynaState
from jaxdyna.envs import CartPole, CartPoleParams
from jaxdyna.experiments import cli
from jaxdyna.experiments.cartpole_options import PRESETS, Options, dyna_config
from jaxdyna.experiments.cartpole_planners import planner_arms
from jaxdyna.experiments.cartpole_report import CartPoleReport
from jaxdyna.experiments.run import Arm
from jaxdyna.experiments.session import Session
from jaxdyna.models import (
    LearnedEnvironment,
    LearnedParams,
    SupervisedConfig,
    supervised,
    uniform_start,
)
from jaxdyna.models.evaluation import Predict, one_step_sums
from jaxdyna.replay import Replay

PROG = "python -m jaxdyna.experiments.cartpole"


@cache
def make_dyna(agent_config: ReinforceConfig, model_config: SupervisedConfig, dream: Dreams) -> Dyna:
    """The parts of the ``dyna`` arm: one object, and so one program, for the same settings."""
    env = CartPole()
    agent = reinforce((4,), env.num_actions, agent_config)
    model = supervised(4, env.num_actions, model_config)
    predict = overwrite_angle(model.predict) if dream.authors_bug else model.predict
    predict = add_noise(predict, dream.noise) if dream.noise else predict
    learned = LearnedEnvironment(env, predict, START_STATES[dream.start])

    def learned_params(state: DynaState, hparams: DynaHParams) -> LearnedParams:
        sources = {"observed": state.starts, "uniform": jnp.zeros(4), "branched": state.replay}
        return LearnedParams(
            model=state.model.params,
            start=sources[dream.start],
            termination_threshold=hparams.termination_threshold,
            disagreement_threshold=hparams.disagreement_threshold,
            max_steps=dream.steps or hparams.env.max_steps,
        )

    return Dyna(env, agent, model, Dream(learned, learned_params), one_step_sums(predict))


class Dreams(NamedTuple):
    """What decides the world of the dreams beside the model, see `Options`."""

    start: str
    steps: int | None
    noise: float
    authors_bug: bool


def draw_observed(key: jax.Array, starts: Replay) -> jax.Array:
    """One of the first observations of real episodes."""
    return replay.sample(starts, key, ())


def draw_branched(key: jax.Array, held: Replay) -> jax.Array:
    """One of all real observations."""
    return replay.sample(held, key, ()).obs


START_STATES = {
    "observed": draw_observed,
    "uniform": uniform_start(-0.1, 0.1),
    "branched": draw_branched,
}


def add_noise(predict: Predict, scale: float) -> Predict:
    """Gaussian noise on the predicted state, in standard deviations of the model's targets."""

    def noisy(params, obs, action, key):
        key_predict, key_noise = jax.random.split(key)
        prediction = predict(params, obs, action, key_predict)
        noise = scale * params.targets.std * jax.random.normal(key_noise, obs.shape)
        return prediction._replace(next_obs=prediction.next_obs + noise)

    return noisy


def overwrite_angle(predict: Predict) -> Predict:
    """The slip in the authors' code behind "it struggled to make correct predictions for pole
    angle": after every fake step the angle becomes the cart's velocity, clipped to the angles that
    can be observed.
    """

    def slipped(params, obs, action, key):
        prediction = predict(params, obs, action, key)
        limit = 2 * CartPoleParams().theta_threshold
        angle = jnp.clip(prediction.next_obs[1], -limit, limit)
        return prediction._replace(next_obs=prediction.next_obs.at[2].set(angle))

    return slipped


def make_arms(options: Options) -> dict[str, Arm]:
    """The arms by name, each from the same parts. The placebo's model computes its updates and
    discards them; its dreams last to the horizon, because an untrained model would end each at
    once, and it never rests, because a dream without an end says nothing there. The planners are
    made where ``options.arms`` names them.
    """
    config = dyna_config(options)
    dream = Dreams(
        options.dream_start, options.dream_steps, options.dream_noise, options.authors_bug
    )
    dyna = make_dyna(options.agent, options.model, dream)
    hparams = with_horizon(options).hparams
    untrained = replace(
        hparams, model_trains=False, termination_threshold=1.0, disagreement_threshold=math.inf
    )
    alone = Dyna(dyna.env, dyna.agent)
    oracle = alone._replace(dream=Dream(dyna.env, lambda _, hparams: hparams.env))
    planners = planner_arms(options, dyna, hparams)
    return {
        "model_free": Arm(alone, config, hparams),
        "dyna": Arm(dyna, config, hparams),
        "placebo": Arm(dyna, replace(config, rest_when_safe=False), untrained),
        "oracle": Arm(oracle, config, hparams),
        **{name: make() for name, make in planners.items() if name in options.arms},
    }


def with_horizon(options: Options) -> Options:
    """The options with the episode's length that ``--env-version`` says."""
    env_params = replace(options.hparams.env, max_steps=options.num_steps)
    return replace(options, hparams=replace(options.hparams, env=env_params))


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the experiment from the command line; returns the exit code."""
    options = with_horizon(cli.parse(PRESETS, argv, PROG))
    try:
        arms = make_arms(options)
    except ImportError as error:
        cli.fail(str(error), PROG)
    chosen: dict[str, Arm] = {name: arms[name] for name in dict.fromkeys(options.arms)}
    session = Session(
        experiment="cartpole",
        prog=PROG,
        argv=sys.argv[1:] if argv is None else argv,
        options=options,
        out=options.out or Path("runs") / f"cartpole-{options.preset}",
        rule=options.rule,
        keys=jax.random.split(jax.random.key(options.seed), options.seeds),
        report=CartPoleReport(options),
        block=options.block,
    )
    return session.run(chosen)


if __name__ == "__main__":
    sys.exit(main())
