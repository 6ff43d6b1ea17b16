"""CartPole: REINFORCE with and without a learned model (§4.1, Figs. 5 and 6, Table 2).

``python -m jaxdyna.experiments.cartpole`` plays 10 runs of each arm and writes the report.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp

from jaxdyna import replay
from jaxdyna.agents import ReinforceConfig, ReinforceHParams, reinforce
from jaxdyna.agents.reinforce import per_step
from jaxdyna.dyna import Dream, Dyna, DynaConfig, DynaHParams, DynaState
from jaxdyna.envs import CartPole, CartPoleParams
from jaxdyna.experiments import cli
from jaxdyna.experiments.cartpole_report import CartPoleReport
from jaxdyna.experiments.run import Arm
from jaxdyna.experiments.session import Session
from jaxdyna.models import (
    LearnedEnvironment,
    LearnedParams,
    SupervisedConfig,
    SupervisedHParams,
    supervised,
    uniform_start,
)
from jaxdyna.models.evaluation import Predict, one_step_sums
from jaxdyna.statistics import SolveRule

PROG = "python -m jaxdyna.experiments.cartpole"
ArmName = Literal["model_free", "dyna", "placebo", "oracle"]
RULES = {"v0": (200, SolveRule(100, 195.0)), "v1": (500, SolveRule(100, 475.0))}


@dataclass(frozen=True)
class Options:
    """REINFORCE on CartPole, with and without fake episodes from a learned model."""

    preset: Literal["paper", "lean"] = "paper"
    """paper: the paper's protocol. lean: the fewest real episodes."""
    seeds: int = 10
    """Runs of every arm, all in one jitted program."""
    seed: int = 0
    """Base seed of all runs."""
    episodes: int = 1000
    """Real episodes of a run at the most."""
    arms: tuple[ArmName, ...] = ("model_free", "dyna")
    """model_free, dyna, and the controls: placebo never trains its model, oracle dreams in the true
    environment."""
    out: Path | None = None
    """Folder for the results; runs/cartpole-PRESET by default."""
    resume: bool = False
    """Go on with the run in that folder, bit for bit."""
    stop_after_solved: int | None = 100
    """Episodes an arm plays on once all its seeds have solved; None plays all of them."""
    env_version: Literal["v0", "v1"] = "v0"
    """v0: 200 steps, solved at 195. v1: 500 steps, solved at 475."""
    real_first: int = 100
    """N of the paper: real episodes before the first dream."""
    model_updates: int = 60
    """Gradient steps of the model after each real episode."""
    model_batch: int = 16
    """Transitions in each."""
    dream_updates: int = 2
    """Policy updates on dreams after each real episode."""
    dream_episodes: int = 8
    """Fake episodes in each."""
    dream_start: Literal["observed", "uniform"] = "observed"
    """Where dreams begin: first observations of real episodes, or the authors' uniform ±0.1."""
    authors_bug: bool = False
    """Overwrite the dreamed pole angle with the cart's velocity, as the authors' code does."""
    forget_every: int = 0
    """Empty the replay every so many real episodes, as the authors' code does; 0 never."""
    agent: ReinforceConfig = field(default_factory=lambda: ReinforceConfig(advantage=per_step))
    """REINFORCE's network."""
    model: SupervisedConfig = field(
        default_factory=lambda: SupervisedConfig(
            delta=True, normalise=True, spread=3.0, weight_variance=1 / 3
        )
    )
    """The dynamics model."""
    hparams: DynaHParams = field(
        default_factory=lambda: DynaHParams(
            agent=ReinforceHParams(),
            model=SupervisedHParams(),
            env=CartPoleParams(),
            termination_threshold=0.1,
        )
    )
    """Learning rates, discount, physics: what `jaxdyna.sweep` can sweep."""

    def __post_init__(self) -> None:
        for name in ("seeds", "episodes"):
            if getattr(self, name) < 1:
                raise ValueError(f"--{name} is {getattr(self, name)}: it must be at least 1")
        if not 0 <= self.seed < 2**32:
            raise ValueError(f"--seed is {self.seed}: it must lie between 0 and 2^32 - 1")
        if not self.arms:
            raise ValueError("--arms is empty: name at least one arm")
        if self.stop_after_solved is not None and self.stop_after_solved < 0:
            raise ValueError("--stop-after-solved is negative: give 0 or more, or None")
        for flag, value, high in (
            ("termination-threshold", self.hparams.termination_threshold, 1.0),
            ("agent.discount", self.hparams.agent.discount, 1.0),
            ("agent.learning-rate", self.hparams.agent.learning_rate, math.inf),
            ("model.learning-rate", self.hparams.model.learning_rate, math.inf),
            ("fake-weight", self.hparams.fake_weight, math.inf),
        ):
            if not 0 <= value <= high:
                raise ValueError(f"--hparams.{flag} is {value}: it must lie between 0 and {high:g}")
        dyna_config(self)


def dyna_config(options: Options) -> DynaConfig:
    """The counts of a run."""
    return DynaConfig(
        num_episodes=options.episodes,
        num_real_first=options.real_first,
        num_steps=RULES[options.env_version][0],
        model_updates=options.model_updates,
        model_batch=options.model_batch,
        dream_updates=options.dream_updates,
        dream_episodes=options.dream_episodes,
        forget_every=options.forget_every,
    )


@cache
def make_dyna(
    agent_config: ReinforceConfig,
    model_config: SupervisedConfig,
    dream_start: str,
    authors_bug: bool,
) -> Dyna:
    """The parts of the ``dyna`` arm: one object, and so one program, for the same settings."""
    env = CartPole()
    agent = reinforce((4,), env.num_actions, agent_config)
    model = supervised(4, env.num_actions, model_config)
    observed = dream_start == "observed"

    def draw_observed(key, starts):
        return replay.sample(starts, key, ())

    learned = LearnedEnvironment(
        env,
        overwrite_angle(model.predict) if authors_bug else model.predict,
        draw_observed if observed else uniform_start(-0.1, 0.1),
    )

    def learned_params(state: DynaState, hparams: DynaHParams) -> LearnedParams:
        return LearnedParams(
            model=state.model.params,
            start=state.starts if observed else jnp.zeros(4),
            termination_threshold=hparams.termination_threshold,
            max_steps=hparams.env.max_steps,
        )

    return Dyna(env, agent, model, Dream(learned, learned_params), one_step_sums(model.predict))


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
    """The arms by name, each from the same parts; placebo is dyna with a learning rate of 0."""
    config = dyna_config(options)
    dyna = make_dyna(options.agent, options.model, options.dream_start, options.authors_bug)
    env_params = replace(options.hparams.env, max_steps=config.num_steps)
    hparams = replace(options.hparams, env=env_params)
    untrained = replace(hparams, model=replace(hparams.model, learning_rate=0.0))
    alone = Dyna(dyna.env, dyna.agent)
    oracle = alone._replace(dream=Dream(dyna.env, lambda _, hparams: hparams.env))
    return {
        "model_free": Arm(alone, config, hparams),
        "dyna": Arm(dyna, config, hparams),
        "placebo": Arm(dyna, config, untrained),
        "oracle": Arm(oracle, config, hparams),
    }


PRESETS = {"paper": Options(), "lean": replace(Options(), preset="lean")}


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the experiment from the command line; returns the exit code."""
    options = cli.parse(PRESETS, argv, PROG)
    out = options.out or Path("runs") / f"cartpole-{options.preset}"
    arms = make_arms(options)
    chosen: dict[str, Arm] = {name: arms[name] for name in dict.fromkeys(options.arms)}
    session = Session(
        experiment="cartpole",
        prog=PROG,
        argv=sys.argv[1:] if argv is None else argv,
        options=options,
        out=out,
        rule=RULES[options.env_version][1],
        keys=jax.random.split(jax.random.key(options.seed), options.seeds),
        report=CartPoleReport(options.preset, RULES[options.env_version][1], options.real_first),
    )
    return session.run(chosen)


if __name__ == "__main__":
    sys.exit(main())
