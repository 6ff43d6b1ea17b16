"""Learning to catch: settings, arms, report."""

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, Self

from jaxdyna.agents import DQNConfig, DQNHParams
from jaxdyna.dyna import Dyna, DynaConfig, DynaHParams, Metrics
from jaxdyna.envs import Catch, CatchParams, FrameStack
from jaxdyna.experiments.engine import Experiment, Options
from jaxdyna.experiments.report import frozen, sections as report
from jaxdyna.experiments.report.tables import markdown_table, with_interval
from jaxdyna.experiments.study import arms as study
from jaxdyna.fields import LARGEST, changed, setting
from jaxdyna.models import PixelConfig, PixelHParams
from jaxdyna.networks import GlimpseQ, LocalDynamics, LocalReward
from jaxdyna.rollout import rollout
from jaxdyna.statistics import SolveRule, mean_of_runs

JUDGED = 200


@dataclass(frozen=True, kw_only=True)
class CatchOptions(Options):
    """DQN on the frames of Catch, with and without fake episodes from a learned model."""

    decided: ClassVar = {
        "dyna.num_episodes": "--episodes",
        "dyna.num_steps": "--rows",
        "hparams.env.max_steps": "--rows",
        "agent.network": "--glimpse and --hidden",
    }
    world_settings: ClassVar = ("hparams.env", "rows", "columns")

    rows: int = setting(10, "of the board", at_least=3, at_most=1000)
    columns: int = setting(5, "of the board", at_least=2, at_most=1000)
    glimpse: Literal[3, 5] = setting(3, "cells a side of what the agent's network looks at")
    hidden: tuple[int, ...] = setting((64, 64), "widths of its hidden layers", at_least=1)
    widths: tuple[int, ...] = setting((16, 16), "channels of the model's 3x3 convolutions",
                                      at_least=1)  # fmt: skip
    reward_around: bool = setting(
        True, "whether the model judges a cell's reward by what is around it too, not by its "
        "colours alone")  # fmt: skip
    reward_weight: float = setting(
        5.0, "weight of the reward's loss beside the summed one of the pixels", at_least=0
    )
    dyna: DynaConfig = setting(factory=lambda: DynaConfig(
        num_episodes=LARGEST, num_steps=1,  # until they are decided, in nobody's way
        num_real_first=10, model_updates=40, model_batch=16, dream_updates=1, dream_episodes=32,
        dream_steps=9, rare_share=0.5))  # fmt: skip
    agent: DQNConfig = setting(factory=lambda: DQNConfig(
        updates=20, fake_updates=40, fake_capacity=10_000, n_step=3))  # fmt: skip
    hparams: DynaHParams = setting(factory=lambda: DynaHParams(
        DQNHParams(epsilon_hold=5.0, epsilon_episodes=20.0, discount=0.97, target_rate=0.02),
        PixelHParams(5e-3), CatchParams()))  # fmt: skip

    def resolved(self) -> Self:
        """Episodes last as long as the ball falls."""
        steps = self.rows - 1
        return changed(self, {
            "dyna.num_episodes": self.episodes, "dyna.num_steps": steps,
            "dyna.dream_steps": min(self.dyna.dream_steps or steps, steps),
            "hparams.env.max_steps": steps})  # fmt: skip


def rule(options: CatchOptions) -> SolveRule:
    """When a run counts as solved."""
    return SolveRule(50, 0.9)


def agent_of(options: CatchOptions) -> DQNConfig:
    """DQN's counts and network."""
    network = GlimpseQ(Catch().num_actions, size=options.glimpse, hidden=options.hidden)
    return replace(options.agent, network=network)


def model_of(options: CatchOptions) -> PixelConfig:
    """The model's networks; it also predicts the end, which comes with the reward."""
    reward, weight = LocalReward(around=options.reward_around), options.reward_weight
    network = LocalDynamics(3, options.widths)
    return PixelConfig(network, reward=reward, reward_weight=weight, terminates=True)


def arms(options: CatchOptions) -> dict[str, study.Made]:
    """The standard arms."""
    game = FrameStack(Catch(options.rows, options.columns, frames=True))
    return study.world_arms(
        game, agent_of(options), model_of(options), options.dyna, options.hparams,
        study.Hooks(judge, piece=10, block=options.block))  # fmt: skip


def judge(dyna: Dyna, config: DynaConfig, state: Any, key: Any, hparams: Any) -> Metrics:
    """The final greedy policy in new episodes: ``greedy_return``, a mean."""
    act = study.greedy_policy(dyna, state, hparams)
    played = rollout(dyna.env, act, key, hparams.env, JUDGED, num_steps=config.num_steps)
    return {"greedy_return": played.reward.sum(-1).mean()}


def describe(options: CatchOptions, curves: Any) -> dict[str, Any]:
    """The final policy in numbers."""
    return {"greedy_return": mean_of_runs(curves["greedy_return"])}


def final(record: Any) -> str:
    """What the final policies earn."""
    arms = record.results["arms"].items()
    rows = [[name, with_interval(arm["greedy_return"], 2)] for name, arm in arms]
    return report.paragraphs(
        "## The final policy",
        f"Greedy, {JUDGED} new episodes a run; 1 is every ball caught, -1 none.",
        markdown_table(["arm", "return: mean (95% interval)"], rows),
    )


TUNED = CatchOptions(arms=("model_free", "dyna"), episodes=400, stop_after_solved=0)
#: the Maze's ``lean`` as it is: nothing of it was chosen on Catch
LEAN = changed(TUNED, {
    "preset": "lean", "episodes": 150, "stop_after_solved": 50,
    "glimpse": 5, "hidden": (128, 128), "widths": (32, 32), "reward_around": False,
    "reward_weight": 1.0,
    "dyna.num_real_first": 5, "dyna.model_updates": 300, "dyna.model_batch": 32,
    "dyna.rare_share": 0.25, "dyna.dream_updates": 2, "dyna.dream_episodes": 400,
    "dyna.dream_steps": 5,
    "dyna.eval_every": 10, "dyna.eval_episodes": 20,
    "agent": DQNConfig(
        updates=100, fake_updates=400, fake_capacity=8000, explore_until_rewarded=True,
    ),
    "hparams.agent": DQNHParams(epsilon_hold=5.0, epsilon_episodes=2.0),
    "hparams.model": PixelHParams(3e-3)})  # fmt: skip
CATCH = Experiment(
    name="catch",
    title="Catch",
    presets={"tuned": TUNED, "lean": LEAN},
    quick={"tuned": {"seeds": 2, "episodes": 120}, "lean": {"seeds": 2, "episodes": 60}},
    arms=arms,
    rule=rule,
    describe=(describe, frozen.describe(rule)),
    sections=(
        report.solving(rule), report.learning_curves(rule), report.thresholds(rule),
        frozen.frozen(rule), report.endings(rule), report.behaviour(report.WRONG, 10),
        final, report.arms_said(study.SAID), report.settings, report.spent,
    ),
)  # fmt: skip
