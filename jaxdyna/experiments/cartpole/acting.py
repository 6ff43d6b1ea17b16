"""Learning to balance: the experiment."""

from typing import Any

from jaxdyna.experiments.cartpole import model
from jaxdyna.experiments.cartpole.arms import SAID, arms
from jaxdyna.experiments.cartpole.options import LEAN, PAPER, TUNED, rule
from jaxdyna.experiments.engine import Experiment
from jaxdyna.experiments.report import frozen, sections as report
from jaxdyna.experiments.report.summaries import first_dreams

FEW = {"seeds": 4, "stop_after_solved": 0}


def papers(record: Any) -> tuple[dict[str, float], dict[str, float]]:
    """The paper's own figures and ratio, where they are of this environment."""
    known = record.options.env_version == "v0"
    return ({"model_free": 650.0, "dyna": 400.0}, {"dyna": 0.62}) if known else ({}, {})


CARTPOLE = Experiment(
    name="cartpole",
    title="CartPole",
    presets={"tuned": TUNED, "lean": LEAN, "paper": PAPER},
    quick={"tuned": FEW | {"episodes": 400}, "lean": FEW, "paper": FEW | {"episodes": 400}},
    arms=arms, rule=rule,
    describe=(first_dreams, model.describe, frozen.describe(rule)),
    sections=(
        lambda record: report.solving(rule, *papers(record))(record),
        report.learning_curves(rule, "fig6.png", "Fig. 6: return against real episodes"),
        report.area, report.thresholds(rule),
        frozen.frozen(rule), report.endings(rule), report.distribution, model.section,
        report.arms_said(SAID), report.settings, report.spent,
    ),
)  # fmt: skip
