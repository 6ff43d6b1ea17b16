"""What frame prediction in the Maze leaves behind: the F1 table, Fig. 7, dreams, rewards."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console

from jaxdyna import frame_replay
from jaxdyna.experiments import maze_scores, plots_frames, report
from jaxdyna.experiments import maze_tables as tables
from jaxdyna.experiments.maze_judge import CLASSES, FAINT, THRESHOLDS, f1
from jaxdyna.experiments.maze_model import collect
from jaxdyna.experiments.maze_options import DREAM_FROM, Options, config_of, training_of
from jaxdyna.experiments.report import Results, markdown_table

OURS = (
    "Not in the paper: the number of channels (the authors' code has 128), weight decay and the "
    "cosine, an action's factor of the product that starts scattered around 1, nothing nonlinear "
    "between the dense layers and the product"
)
Judged = Mapping[str, np.ndarray]
Curves = Mapping[str, Judged]


def figures(out: Path, curves: Curves, options: Options) -> None:
    """``fig7_ARM.png``, ``dream_ARM.gif``, ``thresholds.png``, ``losses.png``, ``horizon.png``."""
    by_arm: dict[str, dict[int, Judged]] = {}
    for name, judged in curves.items():
        arm, _, stage = name.partition("@")
        by_arm.setdefault(arm, {})[int(stage)] = judged
    dreams = {}
    for arm in (arm for arm in tables.DREAMERS if arm in by_arm):
        stages = dict(sorted(by_arm[arm].items()))
        last = stages[max(stages)]
        rows = {f"{stage} episodes": _step(judged) for stage, judged in stages.items()}
        plots_frames.prediction_grid(out / f"fig7_{arm}.png", rows, last["seen"][1] / 255)
        columns = {"truth": last["film_truth"], f"{arm} dreams": last["film_dream"]}
        plots_frames.film(out / f"dream_{arm}.gif", columns)
        for rule, said in tables.RULES.items():
            dreams[f"{arm}, {said}"] = f1(last[f"dream_{rule}"])
    at = _compared_stage(options, curves)
    compared = {arm: stages[at] for arm, stages in by_arm.items() if at in stages}
    plots_frames.score_by_threshold(
        out / "thresholds.png",
        THRESHOLDS,
        {arm: f1(judged["one_step"]) for arm, judged in compared.items()},
        list(CLASSES),
        {arm: THRESHOLDS[maze_scores.used_threshold(options, arm)] for arm in compared},
    )
    plots_frames.prediction_grid(
        out / "losses.png",
        {arm: _step(judged) for arm, judged in compared.items()},
        next(iter(compared.values()))["seen"][1] / 255,
    )
    if dreams:
        plots_frames.score_by_horizon(out / "horizon.png", dreams, list(CLASSES))


def markdown(results: Results, options: Options, curves: Curves, out: Path) -> str:
    """The report, with the figures that are in ``out``."""
    stage = str(_compared_stage(options, curves))
    parts = [
        "# The Maze: predicting frames",
        f"`{results['command']}`",
        f"{report.runs(options.seeds)}. In each a uniformly random policy plays {options.episodes} "
        f"episodes of {options.steps} steps, which the replay keeps at {_bytes(options):.0f} bytes "
        "a transition. A model, four frames and the action in, the next frame out, is trained on "
        "the first so many of them, each time from scratch, and judged on "
        f"{options.held_out} new episodes of the same policy: F1 of lit pixels over all steps, "
        "the first ones included, where four equal frames do not tell which way the obstacles "
        "will go. Mean over runs and 95% interval.",
        markdown_table(*tables.scores(results)),
        "\n".join(f"- `{arm}`: {_setting(options, arm)}" for arm in results["arms"]),
        _picture(out, "fig7_lean.png", "ours: input, truth, belief and error at each stage"),
        _picture(out, "fig7_paper.png", "the paper's model: input, truth, belief and error"),
        "## Losses and thresholds",
        f"After {stage} episodes. Believed: how sure the model is of a pixel that is lit, 1 at "
        f"best. Spilled: its beliefs above {FAINT:g} in others, for each that is lit, 0 "
        f"at best. {tables.blur_said(results, stage)} The best threshold is chosen on the "
        f"held-out episodes themselves.{_others_said(results)}",
        markdown_table(*tables.losses(results, stage)),
        markdown_table(*tables.thresholds(results, stage)),
        _picture(out, "thresholds.png", "F1 against threshold"),
        _picture(out, "losses.png", "one step under each loss"),
        "## Rewards",
        *_rewards_said(results, options),
        *_dreams_said(results, out),
        "## Time",
        "Of all runs together.",
        markdown_table(*tables.times(results)),
    ]
    return "\n\n".join(part.rstrip("\n") for part in parts if part) + "\n"


def _rewards_said(results: Results, options: Options) -> list[str]:
    predicting = [arm for arm in results["arms"] if config_of(options, arm).reward is not None]
    if not predicting:
        return ["Not predicted."]
    return [
        "Share predicted to within half the smallest reward, by what happened; a step on the goal "
        "with an obstacle on it is a collision. Which collisions the first step brings cannot be "
        "known from four equal frames. A random policy hardly ever sees the goal, in training or "
        "here.",
        markdown_table(*tables.rewards(results, predicting)),
    ]


def _dreams_said(results: Results, out: Path) -> list[str]:
    if not any(arm in results["arms"] for arm in tables.DREAMERS):
        return []
    films = [
        _picture(out, f"dream_{arm}.gif", f"dream of {arm} beside the truth")
        for arm in tables.DREAMERS
    ]
    return [
        "## Dreams",
        f"So many steps fed with its own frames, actions as recorded, from step {DREAM_FROM} of "
        "the held-out episodes on, after the most episodes. Frames are lit above the threshold, or "
        "each pixel is drawn with the probability that it is believed to be lit. Wrong: share of "
        f"all pixels. {tables.drift_said(results)}",
        markdown_table(*tables.dreams(results)),
        _picture(out, "horizon.png", "F1 against dreamed steps"),
        *films,
    ]


def summary(console: Console, results: Results) -> None:
    """The F1 table in the terminal."""
    header, rows = tables.scores(results)
    short = [[*row[:2], *(cell.partition(" ")[0] for cell in row[2:])] for row in rows]
    report.print_table(console, "F1 of predicted frames", header, short)
    console.print(f"{results['timing']['total_s']:.0f} s in all")


def _setting(options: Options, arm: str) -> str:
    config, training = config_of(options, arm), training_of(options, arm)
    coder = f", kernels {options.kernels}, dense {options.dense}"
    size = (
        f"{options.widths} channels{coder}"
        if arm.startswith("paper")
        else f"{options.lean_widths} channels"
    )
    rare = training.rare_share
    share = "" if rare is None else f", at least {rare:g} of them collisions and goal steps"
    each = training.updates_per_episode
    more = f" and {each:g} more for each episode of data" if each else ""
    head = "no reward head"
    if config.reward:
        head = f"{type(config.reward).__name__} of weight {training.reward_weight:g}"
    said = (
        f"{type(config.network).__name__} with {size}, {tables.loss_of(arm)}, "
        f"{training.updates:,} updates{more} on batches of {training.batch}{share}, AdamW from "
        f"{training.learning_rate:g} down along a cosine with weight decay "
        f"{training.weight_decay:g}, lit above {config.threshold:g}, {head}"
    )
    return said + (f". {OURS}" if arm == "paper" else "")


def _others_said(results: Results) -> str:
    if any("_" in arm for arm in results["arms"]):
        return ""
    return (
        " Other losses were not played here: `--arms paper paper_l2 paper_l1 lean lean_l2 lean_l1` "
        "compares them."
    )


def _picture(out: Path, name: str, said: str) -> str:
    return f"![{said}]({name})" if (out / name).exists() else ""


def _bytes(options: Options) -> float:
    """Bytes that the replay takes for a transition."""
    held: Any = jax.eval_shape(
        lambda key: collect(options, key, options.episodes), jax.random.key(0)
    )
    return frame_replay.bytes_per_transition(held)


def _compared_stage(options: Options, curves: Curves) -> int:
    """Of the stages that most arms have finished, the one nearest to that of the ablation."""
    finished = [int(name.partition("@")[2]) for name in curves]
    most = max(finished.count(stage) for stage in finished)
    common = {stage for stage in finished if finished.count(stage) == most}
    return min(common, key=lambda stage: abs(stage - options.ablation_stage))


def _step(judged: Judged) -> tuple[np.ndarray, np.ndarray]:
    return judged["truth"][1] / 255, judged["belief"][1]
