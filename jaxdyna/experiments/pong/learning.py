"""Learning to play Pong, with and without dreams (§4.3): the experiment and its report."""

from typing import Any

from jaxdyna.experiments.engine import Experiment
from jaxdyna.experiments.pong import world
from jaxdyna.experiments.pong.arms import GAMES, GREEDY_EPISODES, SAID, arms
from jaxdyna.experiments.pong.options import LEAN, MAIN_ARMS, PAPER, QUICK, TUNED, PongOptions
from jaxdyna.experiments.report import plots, sections as report
from jaxdyna.experiments.report.summaries import comparison, comparisons
from jaxdyna.experiments.report.tables import markdown_table, with_interval
from jaxdyna.experiments.study.grids import both_grids
from jaxdyna.statistics import SolveRule, mean_of_runs

SMOOTHED = 10
DREAMLESS = ("model_free", "max_updates", "more_updates")
BLURRED, CONTROL = "dyna_l2", "more_updates"
DRAWN = (*MAIN_ARMS, CONTROL)
MEASURES = {
    "won": "points won an episode",
    "lost": "points lost an episode",
    "wrong_frames": "share of new frames predicted wrong",
}
#: mean score of a game after 100,000 of the agent's steps, in the repositories' own files
ANCHORS = {"SimPLe": 12.8, "IRIS": 14.6, "DIAMOND": 20.4, "DreamerV3": -5.0}
WHOLE_GAMES = (
    f"Greedy, {GAMES} games to 21 points a run: points won less points lost, mean over runs and "
    "95% interval; a game of half an hour is broken off, at its score. The literature's figures, "
    "after 100,000 steps, are those of its own repositories; its agents see grey or coloured "
    "pixels, ours what is said above."
)


def rule(options: PongOptions) -> SolveRule:
    """As many points as the opponent."""
    return SolveRule(20, 0.0)


def describe(options: PongOptions, curves: Any) -> dict[str, Any]:
    """The final greedy policy in numbers."""
    judged = ("greedy_return", "game_score")
    return {name: mean_of_runs(curves[name].mean(1)) for name in judged if name in curves}


def about(record: Any) -> str:
    """The game, in words."""
    options = record.options
    told = {"objects": "is told where each object is", "rgb": "sees pixels, by convolutions"}
    given = (
        f" Dreams are in the models of {options.models}, which were trained before, on episodes "
        "that do not count, and learn nothing more; intervals are over agents, given these models."
        if options.models else "")  # fmt: skip
    return (
        f"An episode is {options.steps} steps of {world.FRAME_SKIP} frames of "
        f"{world.GAMES_SAID[options.game]}, its return the points won less those lost, so that 0 "
        f"is as many points as the opponent. It is seen as {world.seen_said(options)}. The agent "
        f"{told[options.frames]}.{given}"
    )


def in_steps(record: Any) -> str:
    """The ratios once more, in the real steps before the solving window, of the arms that solve."""
    return report.paragraphs(*comparisons(record.results, {}, "real_steps_to_solve"))


def cause(record: Any) -> str:
    """What each object of the blurred dreams costs; empty without arms that mend one."""
    true = sorted(name for name in record.curves if name.startswith("true_"))
    if not true or BLURRED not in record.curves:
        return ""
    asked = [name for name in (BLURRED, *true, CONTROL) if name in record.curves]
    returns = {name: record.curves[name]["real_return"] for name in asked}
    axis = f"real episodes (running mean of {SMOOTHED})"
    said = f"point difference: mean, {plots.shaded(returns[BLURRED])}"
    plots.bands(record.out / "cause.png", {"": returns}, axis, said, window=SMOOTHED)
    both = {name: record.results["arms"][name] for name in returns}
    return report.paragraphs(
        "## Which object's error does it",
        *comparison({"arms": both}, {}, BLURRED),
        report.equal_episodes((BLURRED,), tuple(returns))(record),
        "![point difference against real episodes, by what is true in the dreams](cause.png)",
    )


def final(record: Any) -> str:
    """What final policies earn; of whole games beside the literature's after 100,000 steps."""
    arms = record.results["arms"].items()
    rows = [[name, with_interval(arm["greedy_return"], 2)] for name, arm in arms]
    scores = {name: arm["game_score"] for name, arm in arms if "game_score" in arm}
    games = [[name, with_interval(score, 1)] for name, score in scores.items()]
    games += [[name, f"{score:.1f}"] for name, score in ANCHORS.items()]
    return report.paragraphs(
        "## The final policy",
        f"Greedy, {GREEDY_EPISODES} new episodes a run.",
        markdown_table(["arm", "point difference: mean (95% interval)"], rows),
        *((WHOLE_GAMES, markdown_table(["policy", "score of a game"], games)) if scores else ()),
    )


PONG = Experiment(
    name="pong", title="Pong: learning to play", arms=arms, rule=rule,
    presets={"tuned": TUNED, "lean": LEAN, "paper": PAPER},
    quick=QUICK, describe=(describe,),
    sections=(
        about, report.solving(rule), in_steps, report.equal_episodes(DREAMLESS),
        report.learning_curves(rule, said="point difference against real episodes",
                               what="point difference", window=SMOOTHED, arms=DRAWN),
        report.behaviour(MEASURES, SMOOTHED, "points.png", arms=DRAWN),
        cause, report.endings(rule), final, report.arms_said(SAID), report.settings, report.spent,
    ),
)  # fmt: skip
BASELINES, DYNA_GRID = both_grids(
    "Pong", PONG, ratios=(0.5, 1, 2.25, 5), between=10_000, counts=(50, 100, 200, 400), kept=200
)
