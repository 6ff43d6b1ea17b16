"""What frame prediction in the Maze leaves behind: the F1 table, Fig. 7, dreams, rewards."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console

from jaxdyna import frame_replay
from jaxdyna.experiments import maze_tables as tables
from jaxdyna.experiments import plots_frames, report
from jaxdyna.experiments.maze_judge import CLASSES, REWARD_KINDS, THRESHOLDS, f1
from jaxdyna.experiments.maze_model import collect
from jaxdyna.experiments.maze_options import DREAM_FROM, Options, config_of, training_of
from jaxdyna.experiments.report import Results, markdown_table
from jaxdyna.statistics import bootstrap_interval

HORIZONS = (1, 5, 10, 25, 50)
Judged = Mapping[str, np.ndarray]
Curves = Mapping[str, Judged]


def describe(curves: Curves, options: Options) -> Results:
    """By arm and stage: F1 a class, at the threshold used and at others; what is believed to be
    lit, and blur; rewards right a kind; F1 and error of dreams by step.
    """
    arms: Results = {}
    for name, judged in curves.items():
        arm, _, stage = name.partition("@")
        scores = f1(judged["one_step"])
        lit = np.maximum(judged["one_step"][:, 0, :, 2], 1)
        arms.setdefault(arm, {})[stage] = {
            "f1": _summaries(scores[:, _used(options, arm)]),
            "f1_by_threshold": {
                f"{threshold:g}": dict(
                    zip(CLASSES, scores[:, number].mean(0).tolist(), strict=True)
                )
                for number, threshold in enumerate(THRESHOLDS)
            },
            "believed": _summaries(judged["mass"][..., 0] / lit),
            "spilled": _summaries(judged["mass"][..., 1] / lit),
            "reward_right": {
                kind: _share(judged["reward"][:, number])
                for number, kind in enumerate(REWARD_KINDS)
            },
            **_dreams(judged, options),
        }
    return arms


def _dreams(judged: Judged, options: Options) -> Results:
    pixels = options.held_out * options.size**2
    steps = [step for step in HORIZONS if step <= options.horizon]
    described: Results = {"dream_f1": {}, "dream_error": {}}
    for rule in tables.RULES:
        counts = judged[f"dream_{rule}"]
        wrong = (counts[..., 1] + counts[..., 2] - 2 * counts[..., 0]) / pixels
        scores = f1(counts)
        described["dream_f1"][rule] = {str(n): _summaries(scores[:, n - 1]) for n in steps}
        described["dream_error"][rule] = {str(n): _summaries(wrong[:, n - 1]) for n in steps}
    return described


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
        {arm: THRESHOLDS[_used(options, arm)] for arm in compared},
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
        f"{options.seeds} runs. In each a uniformly random policy plays {options.episodes} "
        f"episodes of {options.steps} steps, which the replay keeps at {_bytes(options):.0f} bytes "
        "a transition. A model, four frames and the action in, the next frame out, is trained on "
        "the first so many of them, each time from scratch, and judged on "
        f"{options.held_out} new episodes of the same policy: F1 of lit pixels over all steps, "
        "the first ones included, where four equal frames do not tell which way the obstacles "
        "will go. Mean over runs and 95% interval.",
        markdown_table(*tables.scores(results)),
        "\n".join(f"- `{arm}`: {_setting(options, arm)}" for arm in results["arms"]),
        _picture(out, "fig7_lean.png", "input, truth, belief and error at each stage"),
        _picture(out, "fig7_paper.png", "the same for the paper's model"),
        "## Losses and thresholds",
        f"After {stage} episodes. Believed: the sum of what the model believes to be lit over the "
        "pixels that are, 0 for a model that has gone dark. Blur: the sum of p(1 - p) over the "
        f"same, 0 where every pixel is believed to be black or lit.{_others_said(results)}",
        markdown_table(*tables.losses(results, stage)),
        markdown_table(*tables.thresholds(results, stage)),
        _picture(out, "thresholds.png", "F1 against threshold"),
        _picture(out, "losses.png", "one step under each loss"),
        "## Rewards",
        "Share predicted to within 0.5 on the predicted frame, by what the step earned.",
        markdown_table(*tables.rewards(results)),
        *_dreams_said(results, out),
        "## Time",
        "Seconds of training all runs, and of compiling.",
        markdown_table(*tables.times(results)),
    ]
    return "\n\n".join(part.rstrip("\n") for part in parts if part) + "\n"


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
    share = (
        f", a share of {training.rare_share:g} from steps with a reward"
        if training.rare_share is not None
        else ""
    )
    more = (
        f" and {training.updates_per_episode:g} more for each episode of data"
        if training.updates_per_episode
        else ""
    )
    head = f"reward by {type(config.reward).__name__}" if config.reward else "no reward head"
    return (
        f"{type(config.network).__name__} with {size}, {tables.loss_of(arm)}, "
        f"{training.updates:,} updates{more} on batches of {training.batch}{share}, Adam from "
        f"{training.learning_rate:g} down along a cosine with weight decay "
        f"{training.weight_decay:g}, lit above {config.threshold:g}, {head} "
        f"(weight {training.reward_weight:g})"
    )


def _others_said(results: Results) -> str:
    if any("_" in arm for arm in results["arms"]):
        return ""
    return " Other losses were not played here: `--arms lean lean_l2 lean_l1` compares them."


def _picture(out: Path, name: str, said: str) -> str:
    return f"![{said}]({name})" if (out / name).exists() else ""


def _bytes(options: Options) -> float:
    """Bytes that the replay takes for a transition."""
    held: Any = jax.eval_shape(
        lambda key: collect(options, key, options.episodes), jax.random.key(0)
    )
    return frame_replay.bytes_per_transition(held)


def _used(options: Options, arm: str) -> int:
    """Position in `THRESHOLDS` of the threshold that the arm's model uses."""
    threshold = config_of(options, arm).threshold
    return int(np.argmin(np.abs(THRESHOLDS - (0.5 if threshold is None else threshold))))


def _compared_stage(options: Options, curves: Curves) -> int:
    """Of the stages that most arms have finished, the one nearest to that of the ablation."""
    finished = [int(name.partition("@")[2]) for name in curves]
    most = max(finished.count(stage) for stage in finished)
    common = {stage for stage in finished if finished.count(stage) == most}
    return min(common, key=lambda stage: abs(stage - options.ablation_stage))


def _step(judged: Judged) -> tuple[np.ndarray, np.ndarray]:
    return judged["truth"][1] / 255, judged["belief"][1]


def _share(counts: np.ndarray) -> Results:
    """Of counts ``[seeds, 2]``, right and all: the share of those seeds that have any."""
    some = counts[counts[:, 1] > 0]
    share = some[:, 0] / some[:, 1]
    return {
        "mean": float(share.mean()) if len(some) else None,
        "ci95": bootstrap_interval(share, _row_means) if len(some) else None,
        "right": int(counts[:, 0].sum()),
        "steps": int(counts[:, 1].sum()),
    }


def _summaries(values: np.ndarray) -> Results:
    """Mean, interval and every seed, by class, of ``[seeds, classes]``."""
    return {
        name: {
            "mean": float(column.mean()),
            "ci95": bootstrap_interval(column, _row_means),
            "per_seed": column.tolist(),
        }
        for name, column in zip(CLASSES, values.T, strict=True)
    }


def _row_means(rows: np.ndarray) -> np.ndarray:
    return rows.mean(-1)
