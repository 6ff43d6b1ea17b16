"""Learning to play Pong, with and without dreams (§4.3): the experiment and its report."""

from typing import Any

import numpy as np

from jaxdyna.experiments.engine import Experiment
from jaxdyna.experiments.pong import world
from jaxdyna.experiments.pong.arms import GAMES, GREEDY_EPISODES, SAID, arms
from jaxdyna.experiments.pong.options import LEAN, MAIN_ARMS, QUICK, TUNED, PongOptions
from jaxdyna.experiments.report import frames, plots
from jaxdyna.experiments.report import sections as report
from jaxdyna.experiments.report.summaries import comparison, comparisons, mean_of_runs
from jaxdyna.experiments.report.tables import markdown_table, with_interval
from jaxdyna.statistics import SolveRule, episodes_to_solve

FILM_STEPS, SMOOTHED = 150, 10
BASELINES = ("model_free", "max_updates", "more_updates")
BLURRED = "dyna_l2"
MEASURES = {
    "won": "points won an episode",
    "lost": "points lost an episode",
    "wrong_frames": "share of new frames predicted wrong",
}
ANCHORS = {"SimPLe": 12.8, "IRIS": 14.6, "DIAMOND": 20.4, "DreamerV3": -5.0}
"""Mean score of a game after 100,000 of the agent's steps, in the repositories' own files."""


def rule(options: PongOptions) -> SolveRule:
    """As many points as the opponent."""
    return SolveRule(20, 0.0)


def describe(options: PongOptions, curves: Any) -> dict[str, Any]:
    """The final greedy policy in numbers, and the real steps that it took."""
    judged = ("greedy_return", "game_score", "game_ended")
    said = {name: mean_of_runs(curves[name].mean(1)) for name in judged if name in curves}
    return said | {"real_steps": float(np.nansum(curves["real_length"], 1).mean())}


def about(record: Any) -> str:
    """The game, in words."""
    options = record.options
    return (
        f"An episode is {options.steps} steps of {options.frame_skip} frames of "
        f"{world.GAMES_SAID[options.game]}, its return the points won less those lost, so that 0 "
        f"is as many points as the opponent. It is seen as {world.seen_said(options)}."
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
    solves = rule(record.options)
    at = {name: episodes_to_solve(solves.score(one), solves) for name, one in curves.items()}
    plots.learning_curves(
        record.out / "cause.png", {name: one["real_return"] for name, one in curves.items()},
        solves.threshold, at, record.options.dyna.num_real_first, "point difference", SMOOTHED,
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
    arms, shown = record.results["arms"].items(), report.drawn(record, MAIN_ARMS).items()
    rows = [[name, with_interval(arm["greedy_return"], 2)] for name, arm in arms]
    film = {name: one["show_greedy"][:FILM_STEPS] for name, one in shown if "show_greedy" in one}
    if film:
        frames.film(record.out / "film.gif", film)
    return report.paragraphs(
        "## The final policy",
        f"Greedy, {GREEDY_EPISODES} new episodes a run.",
        markdown_table(["arm", "point difference: mean (95% interval)"], rows),
        world.COLOURS_SAID if film and record.options.frames == "objects" else "",
        "![the first run's final policies](film.gif)" if film else "",
    )


def whole_games(record: Any) -> str:
    """Games to their end by the final policies, beside what the literature has after as many steps;
    nothing where none were played.
    """
    rows = [
        [name, f"{arm['real_steps']:,.0f}", with_interval(arm["game_score"], 1),
         f"{1 - np.mean(arm['game_ended']['per_seed']):.0%}"]
        for name, arm in record.results["arms"].items() if "game_score" in arm
    ]  # fmt: skip
    if not rows:
        return ""
    rows += [[name, "100,000", f"{score:.1f}", "-"] for name, score in ANCHORS.items()]
    return report.paragraphs(
        "## Whole games",
        f"Greedy, {GAMES} games to 21 points a run: points won less points lost, mean over runs "
        "and 95% interval; a game of half an hour is broken off, at its score. The literature's "
        "figures are those of its own repositories; its agents see grey or coloured pixels, ours a "
        "channel for each object's colour.",
        markdown_table(["policy", "real steps a run", "score of a game", "broken off"], rows),
    )


PONG = Experiment(
    name="pong", title="Pong: learning to play", arms=arms, rule=rule,
    presets={"tuned": TUNED, "lean": LEAN}, quick=dict.fromkeys(("tuned", "lean"), QUICK),
    describe=(describe,),
    sections=(
        about, report.solving(rule), in_steps, report.equal_episodes(BASELINES),
        report.learning_curves(rule, said="point difference against real episodes",
                               what="point difference", window=SMOOTHED, arms=MAIN_ARMS),
        report.behaviour(MEASURES, SMOOTHED, "points.png", arms=MAIN_ARMS),
        cause, report.endings(rule), final, whole_games, report.arms_said(SAID), report.settings,
        report.spent,
    ),
)  # fmt: skip
