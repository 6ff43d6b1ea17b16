"""An experiment of some seconds: REINFORCE on CartPole with dreams, as a world of one file."""

from dataclasses import dataclass
from typing import ClassVar

from parts import DYNA, SMALL, hparams

from jaxdyna.dyna import DynaConfig, DynaHParams
from jaxdyna.experiments.engine import Experiment, Options
from jaxdyna.experiments.report import sections as report
from jaxdyna.experiments.study.arms import Hooks, standard_arms
from jaxdyna.fields import changed, setting
from jaxdyna.statistics import SolveRule


@dataclass(frozen=True, kw_only=True)
class PoleOptions(Options):
    """REINFORCE with dreams, for some seconds."""

    decided: ClassVar = {"dyna.num_episodes": "--episodes"}

    arms: tuple[str, ...] = setting(("dyna",), "what is played")
    episodes: int = setting(6, "real episodes", at_least=1, everyday=True)
    window: int = setting(3, "of the solve rule", at_least=1)
    threshold: float = setting(15.0, "of the solve rule")
    dyna: DynaConfig = setting(factory=lambda: SMALL)
    hparams: DynaHParams = setting(factory=hparams)

    def resolved(self):
        return changed(self, {"dyna.num_episodes": self.episodes})


def rule(options):
    return SolveRule(options.window, options.threshold)


def arms(options):
    hooks = Hooks(piece=2, block=options.block)
    return standard_arms(DYNA, options.dyna, options.hparams, None, hooks)


POLE = Experiment(
    name="pole",
    title="Pole",
    presets={"tuned": PoleOptions()},
    arms=arms,
    rule=rule,
    describe=(lambda options, curves: {"dreams": options.dyna.dream_episodes},),
    sections=(report.solving(rule, {}, {}), report.solved_share(rule), report.settings),
)

PARTS = (POLE,)
