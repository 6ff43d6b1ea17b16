"""Learning to play Pong, with and without dreams (§4.3): the experiment and its report."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxdyna.experiments.engine import Experiment
from jaxdyna.experiments.pong.arms import GREEDY_EPISODES, SAID, arms
from jaxdyna.experiments.pong.games import games_said
from jaxdyna.experiments.pong.options import LEAN, QUICK, TUNED, PongOptions
from jaxdyna.experiments.pong.world import COLOURS_SAID, GAMES_SAID, SEEN_SAID, game_of
from jaxdyna.experiments.report import frames, plots
from jaxdyna.experiments.report import sections as report
from jaxdyna.experiments.report.summaries import comparison, comparisons, mean_of_runs
from jaxdyna.experiments.report.tables import markdown_table, with_interval
from jaxdyna.statistics import SolveRule, episodes_to_solve

RULE = SolveRule(20, 0.0)
"""As many points as the opponent."""
FILM_STEPS = 150
SMOOTHED = 10
MAIN_ARMS = ("model_free", "dyna_l2", "dyna_adversarial", "dyna")
BASELINES = ("model_free", "max_updates", "more_updates")
BLURRED = "dyna_l2"
MEASURES = {
    "won": "points won an episode",
    "lost": "points lost an episode",
    "wrong_frames": "share of new frames predicted wrong",
}


def describe(options: PongOptions, curves: Any) -> dict[str, Any]:
    """The final greedy policy in numbers, and the real steps that it took."""
    judged = ("greedy_return", "game_score", "game_ended")
    said = {name: mean_of_runs(curves[name].mean(1)) for name in judged if name in curves}
    return said | {"real_steps": float(np.nansum(curves["real_length"], 1).mean())}


def about(record: Any) -> str:
    """The game, in words."""
    options = record.options
    height, width, _ = game_of(options).frame_shape
    told = ", objects told by their colours" if options.game == "ale" else ""
    return (
        f"An episode is {options.steps} steps of {options.frame_skip} frames of "
        f"{GAMES_SAID[options.game]}, its return the points won less those lost, so that 0 is as "
        f"many points as the opponent. It is seen as {height}x{width} pixels of the field, "
        f"{SEEN_SAID[options.frames]}{told}."
    )


def in_steps(record: Any) -> str:
    """The ratios once more, in the real steps before the solving window, of the arms that solve."""
    solving = {}
    for name, arm in record.results["arms"].items():
        steps = arm["real_steps_to_solve"]
        if steps["mean"] or (name == "model_free" and steps["restricted_mean"]):
            solving[name] = arm
    return report.paragraphs(*comparisons({"arms": solving}, {}, "real_steps_to_solve"))


def cause(record: Any) -> str:
    """What each object of the blurred dreams costs; empty without arms that mend one."""
    true = sorted(name for name in record.curves if name.startswith("true_"))
    if not true or BLURRED not in record.curves:
        return ""
    curves = {name: record.curves[name] for name in (BLURRED, *true)}
    solved_at = {name: episodes_to_solve(RULE.score(one), RULE) for name, one in curves.items()}
    plots.learning_curves(
        record.out / "cause.png", {name: one["real_return"] for name, one in curves.items()},
        RULE.threshold, solved_at, record.options.dyna.num_real_first, "point difference", SMOOTHED,
    )  # fmt: skip
    both = {name: record.results["arms"][name] for name in curves}
    return report.paragraphs(
        "## Which object's error does it",
        *comparison({"arms": both}, {}, BLURRED),
        report.equal_episodes((BLURRED,), tuple(curves))(record),
        "![point difference against real episodes, by what is true in the dreams](cause.png)",
    )


def final(record: Any) -> str:
    """What the final policies earn, and a film of the first run's."""
    rows = [
        [name, with_interval(arm["greedy_return"], 2)]
        for name, arm in record.results["arms"].items()
    ]
    films = {
        name: curves["show_greedy"][:FILM_STEPS]
        for name, curves in report.drawn(record, MAIN_ARMS).items()
        if "show_greedy" in curves
    }
    if films:
        frames.film(record.out / "film.gif", films)
    return report.paragraphs(
        "## The final policy",
        f"Greedy, {GREEDY_EPISODES} new episodes a run.",
        markdown_table(["arm", "point difference: mean (95% interval)"], rows),
        COLOURS_SAID if films and record.options.frames == "objects" else "",
        report.figure(record, "film.gif", "the first run's final policies"),
    )


PONG = Experiment(
    name="pong",
    title="Pong: learning to play",
    presets={"tuned": TUNED, "lean": LEAN},
    quick=dict.fromkeys(("tuned", "lean"), QUICK),
    arms=arms,
    rule=lambda options: RULE,
    describe=(describe,),
    sections=(
        about,
        report.solving(lambda options: RULE, {}, {}),
        in_steps,
        report.equal_episodes(BASELINES),
        report.learning_curves(
            lambda options: RULE, said="point difference against real episodes",
            what="point difference", window=SMOOTHED, arms=MAIN_ARMS,
        ),
        report.behaviour(MEASURES, SMOOTHED, "points.png", arms=MAIN_ARMS),
        cause, report.endings(lambda options: RULE), final, games_said,
        report.arms_said(SAID), report.settings, report.spent,
    ),
    summary=report.solve_summary("Pong", {}, {}),
)  # fmt: skip
