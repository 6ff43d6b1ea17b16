"""Learning to balance: the experiment."""

from __future__ import annotations

from typing import Any

from jaxdyna.experiments.cartpole import model
from jaxdyna.experiments.cartpole.arms import SAID, arms
from jaxdyna.experiments.cartpole.options import LEAN, TUNED, rule
from jaxdyna.experiments.engine import Experiment
from jaxdyna.experiments.report import sections as report
from jaxdyna.experiments.report.summaries import first_dreams
from jaxdyna.experiments.study.arms import ABSENT

PAPER = {"model_free": 650.0, "dyna": 400.0}
PAPER_RATIO = {"dyna": 0.62}
READ = (
    "`experiments/cartpole_readings/report.md` in the repository changes what the paper leaves "
    "open, one detail at a time: it is the ablation behind this reading of it."
)


def papers(options: Any) -> tuple[dict[str, float], dict[str, float]]:
    """The paper's own figures and ratio, where they are of this environment."""
    return (PAPER, PAPER_RATIO) if options.env_version == "v0" else ({}, {})


def solving(record: Any) -> str:
    """The table of arms and the ratios."""
    return report.solving(rule, *papers(record.options))(record)


def summary(record: Any) -> list[Any]:
    """The same in the terminal."""
    return report.solve_summary("CartPole", *papers(record.options))(record)


def settings(record: Any) -> str:
    """With what was read where."""
    read = READ if record.options.preset == "tuned" else ""
    return report.paragraphs(ABSENT, report.settings(record), read)


CARTPOLE = Experiment(
    name="cartpole",
    title="CartPole",
    presets={"tuned": TUNED, "lean": LEAN},
    quick={
        "tuned": {"seeds": 4, "episodes": 400, "stop_after_solved": 0},
        "lean": {"seeds": 4, "stop_after_solved": 0},
    },
    arms=arms,
    rule=rule,
    describe=(first_dreams, model.describe),
    sections=(
        solving,
        report.learning_curves(
            rule, name="fig6.png", said="Fig. 6: return against real episodes"
        ),
        report.endings(rule), report.distribution, model.section, report.arms_said(SAID), settings,
        report.spent,
    ),
    summary=summary,
)  # fmt: skip
