"""The tables of frame prediction in the Maze, out of ``results.json``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from jaxdyna.experiments.maze_judge import CLASSES, REWARD_KINDS
from jaxdyna.experiments.report import Results, interval
from jaxdyna.statistics import bootstrap_interval

PAPER_F1 = {10: (0.83, 0.22, 0.97), 100: (0.92, 0.83, 0.99), 300: (0.98, 0.93, 1.0)}
SHOWN_THRESHOLDS = ("0.1", "0.2", "0.3", "0.5", "0.7")
SHARP = 0.8
RULES = {"lit": "threshold", "drawn": "drawn"}
DREAMERS = ("paper", "lean")
Table = tuple[list[str], list[list[str]]]


def scores(results: Results) -> Table:
    """F1 by model, stage and class, the paper's own figures beside its model's."""
    rows = [
        ["paper's figures", str(stage), *(f"{score:.2f}" for score in said)]
        for stage, said in PAPER_F1.items()
    ]
    for arm, stage, judged in _by_stage(results):
        rows.append([arm, stage, *(cell(judged["f1"][name]) for name in CLASSES)])
    return ["model", "episodes", *CLASSES], rows


def losses(results: Results, stage: str) -> Table:
    """What each loss makes of a picture, after one stage."""
    header = ["model", "loss"]
    for part in ("believed", "spilled"):
        header += [f"{part}, {name}" for name in CLASSES]
    rows = []
    for arm, judged in _at(results, stage):
        cells = [cell(judged[part][name]) for part in ("believed", "spilled") for name in CLASSES]
        rows.append([arm, loss_of(arm), *cells])
    return header, rows


def thresholds(results: Results, stage: str) -> Table:
    """F1 of agent and obstacles by loss and threshold, and at the best of all thresholds."""
    rows = []
    for arm, judged in _at(results, stage):
        by_threshold = judged["f1_by_threshold"]
        for name in ("agent", "obstacles"):
            means = {mark: f1[name] for mark, f1 in by_threshold.items()}
            best = max(means, key=lambda mark: means[mark])
            cells = [f"{means[mark]:.3f}" for mark in SHOWN_THRESHOLDS]
            rows.append([arm, loss_of(arm), name, *cells, f"{means[best]:.3f} at {best}"])
    return [
        "model",
        "loss",
        "F1 of",
        *(f"> {mark}" for mark in SHOWN_THRESHOLDS),
        "best here",
    ], rows


def rewards(results: Results, arms: Sequence[str]) -> Table:
    """How many rewards are predicted right by these arms, by what the step earned."""
    rows = []
    for arm, stage, judged in _by_stage(results):
        cells = []
        if arm not in arms:
            continue
        for kind in REWARD_KINDS:
            share = judged["reward_right"][kind]
            said = f"{cell(share)} of {share['steps']:,}" if share["steps"] else "no such step"
            cells.append(said)
        rows.append([arm, stage, *cells])
    return ["model", "episodes", *REWARD_KINDS], rows


def dreams(results: Results) -> Table:
    """F1 and share of wrong pixels against dreamed steps, after the last stage."""
    rows = []
    for arm, judged in _last(results):
        for rule, said in RULES.items():
            for step, by_class in judged["dream_f1"][rule].items():
                wrong = judged["dream_error"][rule][step]
                share = sum(wrong[name]["mean"] for name in CLASSES) / len(CLASSES)
                cells = [cell(by_class[name]) for name in CLASSES]
                rows.append([arm, said, step, *cells, f"{100 * share:.2f}%"])
    return ["model", "frames", "step", *CLASSES, "wrong"], rows


def drift_said(results: Results) -> str:
    """Which way of making frames drifts less, in words; the runs' dreams begin alike, so that
    their difference is paired.
    """
    said = []
    for arm, judged in _last(results):
        step = [step for step in judged["dream_f1"]["lit"] if int(step) <= 10][-1]
        lit, drawn = (
            np.array(judged["dream_f1"][rule][step]["obstacles"]["per_seed"]) for rule in RULES
        )
        low, high = bootstrap_interval(lit - drawn, lambda rows: rows.mean(-1))
        verdict = "they cannot be told apart"
        if low is not None and high is not None and low * high > 0:
            verdict = f"{RULES['lit' if low > 0 else 'drawn']} drifts less"
        said.append(
            f"After {step} steps `{arm}` has F1 {lit.mean():.3f} of obstacles with the threshold "
            f"and {drawn.mean():.3f} drawn, a difference of {(lit - drawn).mean():.3f} "
            f"({interval([low, high], 3)}): {verdict}."
        )
    return " ".join(said)


def blur_said(results: Results, stage: str) -> str:
    """What each loss did to obstacles, in words."""
    said = []
    for arm, judged in _at(results, stage):
        sure, spilled = (judged[part]["obstacles"]["mean"] for part in ("believed", "spilled"))
        what = "sharp" if sure > SHARP else ("blurred" if spilled > 1 - SHARP else "dark")
        said.append(f"`{arm}` is {what} ({sure:.2f}, {spilled:.2f})")
    return (
        f"Obstacles (believed, spilled): {'; '.join(said)}. Sharp: more than {SHARP:g} believed; "
        f"otherwise blurred where more than {1 - SHARP:g} is spilled, or else dark."
    )


def times(results: Results) -> Table:
    """Seconds by what they were spent on."""
    rows = []
    for arm, spent in results["timing"]["arms"].items():
        parts = {f"training, {stage} episodes": took for stage, took in spent["stages"].items()}
        parts |= {"collecting, compiling": spent["compile_s"], "judging": spent["judge_s"]}
        rows += [[arm, part, f"{seconds:.0f}"] for part, seconds in parts.items()]
    return [f"model ({results['device']['cpu_cores']} cores)", "part", "seconds"], rows


def loss_of(arm: str) -> str:
    """The loss that an arm's name says."""
    return {"l1": "l1", "l2": "l2"}.get(arm.partition("_")[2], "cross-entropy")


def cell(summary: Results) -> str:
    """``mean (low to high)``."""
    return f"{summary['mean']:.3f} ({interval(summary['ci95'], 3)})"


def _by_stage(results: Results) -> Iterator[tuple[str, str, Results]]:
    for arm, stages in results["arms"].items():
        for stage in sorted(stages, key=int):
            yield arm, stage, stages[stage]


def _at(results: Results, stage: str) -> Iterator[tuple[str, Results]]:
    for arm, stages in results["arms"].items():
        if stage in stages:
            yield arm, stages[stage]


def _last(results: Results) -> Iterator[tuple[str, Results]]:
    for arm in DREAMERS:
        if arm in results["arms"]:
            stages = results["arms"][arm]
            yield arm, stages[max(stages, key=int)]
