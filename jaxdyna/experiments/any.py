"""``python -m jaxdyna.experiments.any --env WORLD``: any world (`jaxdyna.envs.named`) from the
command line. Agent, model and counts follow from its spaces.
"""

import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import tyro

from jaxdyna import agents, models, networks
from jaxdyna.actions import Box, actions_of, number_of
from jaxdyna.dyna import DynaConfig, DynaHParams
from jaxdyna.envs import FrameStack, Hosted
from jaxdyna.envs.named import FORMS, module_of, named
from jaxdyna.experiments import engine
from jaxdyna.experiments.cartpole.options import LEAN
from jaxdyna.experiments.engine import cli
from jaxdyna.experiments.report import frozen, sections as report
from jaxdyna.experiments.study import arms as study
from jaxdyna.fields import changed, setting
from jaxdyna.statistics import SolveRule
from jaxdyna.testing import ContractError, check_environment

PROG = "python -m jaxdyna.experiments.any"
SMALL = 32  #: cells a side up to which a frame is taken for a board


@dataclass(frozen=True)
class World:
    """What decides which settings there are."""

    env: str | None = setting(None, FORMS)
    agent: Literal["dqn", "reinforce"] | None = setting(None, "who acts; None: by the actions")
    from_: Annotated[Path | None, tyro.conf.arg(name="from")] = setting(None, "a results.json")


@dataclass(frozen=True, kw_only=True)
class AnyOptions(engine.Options):
    """A DQN, or REINFORCE, in any world, with and without fake episodes from a learned model.
    --env says which world: gymnasium:ID, jaxdyna:NAME or MODULE:NAME; --agent dqn or reinforce
    who acts, by default what suits its actions.
    """

    decided: ClassVar = {
        "env": "the world", "learner": "--agent", "dyna.num_episodes": "--episodes",
        "dyna.num_steps": "--hparams.env.max-steps"}  # fmt: skip
    world_settings: ClassVar = ("hparams.env", "env")

    env: str = setting(help="the world")
    learner: str = setting(help="who acts")
    frames: int = setting(1, "observations that are seen at a time, the newest last", at_least=1)
    solve_at: float | None = setting(
        None, "mean return of 100 episodes at which a run has solved; None: Gymnasium's own "
        "reward_threshold, if any", everyday=True)  # fmt: skip
    dyna: DynaConfig = setting()
    agent: Any = setting()
    model: Any = setting()
    hparams: DynaHParams = setting()

    @property
    def home(self) -> str:
        """The world's own module."""
        return module_of(self.env)

    def resolved(self) -> Self:
        """An episode is as long as the world says."""
        steps = self.hparams.env.max_steps
        dream = min(self.dyna.dream_steps or steps, steps)
        return changed(self, {
            "dyna.num_episodes": self.episodes, "dyna.num_steps": steps, "dyna.dream_steps": dream,
        })  # fmt: skip


def defaults(said: str, learner: str | None = None) -> AnyOptions:
    """The settings for a world, by its spaces; whatever carries over is of ``lean``. `ValueError`
    where there is no such world, or the agent cannot see it.
    """
    env = named(said)
    params = env.default_params
    shape, actions = env.observation_space(params).shape, actions_of(env)
    pictures, board = len(shape) == 3, max(shape[:2]) <= SMALL
    learner = learner or ("reinforce" if isinstance(actions, Box) and not pictures else "dqn")
    if learner == "dqn":
        number = number_of(actions, "--agent dqn", "let it be seen as a vector, by reinforce")
    dyna = DynaConfig(
        num_steps=params.max_steps, num_real_first=5, model_updates=300, model_batch=64,
        rare_share=0.25, dream_updates=2, dream_episodes=200, dream_steps=5, eval_every=20,
        eval_episodes=20)  # fmt: skip
    options = partial(
        AnyOptions, preset="lean", arms=("model_free", "dyna"), episodes=300, env=said,
        learner=learner, stop_after_solved=0)  # fmt: skip
    if pictures:
        if learner != "dqn":
            raise ValueError(f"--agent {learner} sees vectors, {said} frames: give --agent dqn")
        picture = (networks.LocalDynamics if board else networks.EncoderDecoder)(shape[-1])
        network = (networks.GlimpseQ if board else networks.ConvolutionalQ)(number)
        return options(
            frames=4, dyna=dyna, model=models.PixelConfig(picture, terminates=True),
            agent=agents.DQNConfig(network, updates=100, fake_updates=400, fake_capacity=8000),
            hparams=DynaHParams(
                agents.DQNHParams(epsilon_hold=5.0), models.PixelHParams(3e-3), params,
            ),
        )  # fmt: skip
    model = replace(LEAN.model, scale_reward=True)
    agent: Any = agents.DQNConfig(updates=0, updates_per_step=1.0, fake_updates=200, batch=64)
    own: Any = agents.DQNHParams(discount=0.99, epsilon_last=0.02)
    dream = models.DreamHParams(uncertainty_threshold=0.3)
    if learner == "reinforce":
        dyna = replace(dyna, dream_updates=20, dream_episodes=16, dream_steps=None)
        agent, own = LEAN.agent, agents.ReinforceHParams()
    if isinstance(actions, Box):  # chosen on Pendulum
        dyna = replace(dyna, dream_updates=10, dream_episodes=32)
        agent, own = replace(agent, hidden=(64,), epochs=10), agents.ReinforceHParams(1e-3, 0.98)
        dream = models.DreamHParams()  # where every step costs, a dream cut off is a gain
    hparams = DynaHParams(own, models.SupervisedHParams(3e-3), params, dream)
    return options(dyna=dyna, model=model, agent=agent, hparams=hparams)


def arms(options: AnyOptions) -> dict[str, study.Made]:
    """The standard arms."""
    env = FrameStack(named(options.env), options.frames)
    return study.world_arms(
        env, options.agent, options.model, options.dyna, options.hparams,
        study.Hooks(piece=10, block=options.block))  # fmt: skip


def rule(options: AnyOptions) -> SolveRule | None:
    """When a run counts as solved."""
    own = getattr(named(options.env), "reward_threshold", None)
    at = own if options.solve_at is None else options.solve_at
    return None if at is None else SolveRule(100, float(at))


def experiment(said: str, learner: str | None) -> engine.Experiment:
    """A world's experiment."""
    options = defaults(said, learner)
    vectors = isinstance(options.model, models.SupervisedConfig)
    errors = {
        "model_error": "squared error of the next state over its change (1: as if nothing moved)"
    }
    return engine.Experiment(
        name="any-" + "".join(one if one.isalnum() else "-" for one in said).strip("-").lower(),
        title=said, presets={"lean": options}, arms=arms, rule=rule,
        quick={"lean": {"seeds": 2, "episodes": 120}}, describe=(frozen.describe(rule),),
        sections=(
            report.solving(rule), report.learning_curves(rule), report.area,
            report.thresholds(rule), frozen.frozen(rule), frozen.at_steps, report.endings(rule),
            report.behaviour(errors if vectors else report.WRONG, 10, log=vectors),
            report.arms_said(study.SAID), report.settings, report.spent,
        ),
    )  # fmt: skip


def command_parts(flags: Sequence[str]) -> tuple[list[engine.Experiment], list[str], str]:
    """See `jaxdyna.experiments.engine.record.command_of`; `ValueError` on an unknown world."""
    helping = [word for word in flags if word in ("-h", "--help", "--help-all")]
    asked = [word for word in flags if word not in helping]
    said, rest = cli.read(World, asked, PROG, return_unknown_args=True)
    earlier = cli.earlier(said.from_).get("config", {}) if said.from_ else {}
    rest = [*rest, *helping, *(("--from", str(said.from_)) if said.from_ else ())]
    env, agent = said.env or earlier.get("env"), said.agent or earlier.get("learner")
    if env is None and helping:
        return [experiment("jaxdyna:CartPole", agent)], rest, f"{PROG} --env WORLD"
    if env is None:
        raise ValueError(f"--env is missing: give {FORMS}")
    prog = f"{PROG} --env {shlex.quote(env)}" + f" --agent {agent}" * bool(agent)
    return [experiment(env, agent)], rest, prog


def main(argv: Sequence[str] | None = None) -> int:
    """Plays by the arguments, or the process's; see `jaxdyna.experiments.engine.main`."""
    argv = sys.argv[1:] if argv is None else argv
    with cli.refused(PROG, argv, (ValueError, ImportError, ContractError)):
        experiments, flags, prog = command_parts(argv)
        said = experiments[0].title
        if module_of(said) != "jaxdyna.envs" and not isinstance(named(said), Hosted):
            check_environment(named(said))  # a world of the user's own
    return engine.main(*experiments, argv=flags, prog=prog)


if __name__ == "__main__":
    sys.exit(main())
