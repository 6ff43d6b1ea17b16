"""What the Maze's model experiment leaves behind: the F1 table, Fig. 7, dreams, rewards."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from jaxdyna.experiments import plots_frames, report
from jaxdyna.experiments.maze_model import CLASSES, REWARD_KINDS, THRESHOLDS, f1
from jaxdyna.experiments.maze_options import Options, config_of, training_of
from jaxdyna.experiments.report import Results, interval, markdown_table
from jaxdyna.statistics import bootstrap_interval

PAPER_F1 = {10: (0.83, 0.22, 0.97), 100: (0.92, 0.83, 0.99), 300: (0.98, 0.93, 1.0)}
HORIZONS = (1, 5, 10, 25, 50)
Curves = Mapping[str, Mapping[str, np.ndarray]]


def describe(curves: Curves, options: Options) -> Results:
    """By arm and stage: F1 a class, rewards right a kind, F1 of dreams by step, blur."""
    arms: Results = {}
    for name, judged in curves.items():
        arm, _, stage = name.partition("@")
        scores = f1(judged["one_step"])[:, _used(options, arm)]
        rewards = judged["reward"].sum(0)
        dreams = {
            rule: {
                str(step): _summaries(f1(judged[f"dream_{rule}"])[:, step - 1])
                for step in HORIZONS
                if step <= options.horizon
            }
            for rule in ("lit", "drawn")
        }
        arms.setdefault(arm, {})[stage] = {
            "f1": _summaries(scores),
            "blur": _summaries(_blur(judged["mass"])),
            "reward_right": {
                kind: {"right": int(right), "of": int(total)}
                for kind, (right, total) in zip(REWARD_KINDS, rewards, strict=True)
            },
            "dream_f1": dreams,
        }
    return arms


def figures(out: Path, curves: Curves, options: Options) -> None:
    """``fig7_ARM.png``, ``dream_ARM.gif``, ``thresholds.png``, ``losses.png``, ``horizon.png``."""
    by_arm: dict[str, dict[int, Mapping[str, np.ndarray]]] = {}
    for name, judged in curves.items():
        arm, _, stage = name.partition("@")
        by_arm.setdefault(arm, {})[int(stage)] = judged
    for arm in (arm for arm in ("paper", "lean") if arm in by_arm):
        stages = dict(sorted(by_arm[arm].items()))
        last = stages[max(stages)]
        rows = {f"{stage} episodes": _step(judged) for stage, judged in stages.items()}
        plots_frames.prediction_grid(out / f"fig7_{arm}.png", rows, last["seen"][1] / 255)
        columns = {"truth": last["film_truth"], "dream": last["film_dream"]}
        plots_frames.film(out / f"dream_{arm}.gif", columns)
    compared = {arm: stages[_common(options, stages)] for arm, stages in by_arm.items()}
    plots_frames.score_by_threshold(
        out / "thresholds.png",
        THRESHOLDS,
        {arm: f1(judged["one_step"]) for arm, judged in compared.items()},
        list(CLASSES),
        {arm: THRESHOLDS[_used(options, arm)] for arm in compared},
    )
    first = next(iter(compared.values()))
    plots_frames.prediction_grid(
        out / "losses.png",
        {arm: _step(judged) for arm, judged in compared.items()},
        first["seen"][1] / 255,
    )
    dreams = {
        f"{arm}, {'threshold' if rule == 'lit' else 'drawn'}": f1(judged[f"dream_{rule}"])
        for arm, judged in compared.items()
        for rule in ("lit", "drawn")
        if arm in ("paper", "lean")
    }
    if dreams:
        plots_frames.score_by_horizon(out / "horizon.png", dreams, list(CLASSES))


def markdown(results: Results, options: Options) -> str:
    """The report."""
    parts = [
        "# The Maze: predicting frames",
        f"`{results['command']}`",
        f"{options.seeds} runs. In each a random policy plays {options.episodes} episodes of "
        f"{options.steps} steps; a model is trained on the first so many of them, four frames and "
        f"the action in, the next frame out, and judged on {options.held_out} new episodes of the "
        "random policy. F1 of lit pixels over all steps, the first ones included, where four equal "
        "frames do not tell which way the obstacles will go. Mean over runs and 95% interval.",
        markdown_table(*f1_table(results)),
        *(f"- `{arm}`: {_setting(options, arm)}" for arm in results["arms"]),
        "![input, truth, belief and error at each stage](fig7_lean.png)"
        if "lean" in results["arms"]
        else "",
        "![the same for the paper's model](fig7_paper.png)" if "paper" in results["arms"] else "",
        "## Losses and thresholds",
        f"After {_stages_said(results, options)}. Blur: the share of what is believed to be lit "
        "that lies in pixels believed in by halves, 1 - sum of squares over sum; 0 where every "
        "pixel is black or white.",
        markdown_table(*_blur_table(results, options)),
        "![F1 against threshold](thresholds.png)",
        "![one step under each loss](losses.png)",
        "## Rewards",
        "Predicted to within 0.5 on the predicted frame, all runs together.",
        markdown_table(*_reward_table(results)),
        "## Dreams",
        f"F1 after so many steps fed with its own frames, actions as recorded, from step 10 of the "
        f"held-out episodes on; after {_stages_said(results, options)}. Frames are lit above the "
        "threshold, or each pixel is drawn with the probability that it is believed to be lit.",
        markdown_table(*_dream_table(results, options)),
        "![F1 against dreamed steps](horizon.png)",
        *(f"![dream of `{arm}` beside the truth](dream_{arm}.gif)"
          for arm in ("paper", "lean") if arm in results["arms"]),
        "## Time",
        markdown_table(*_time_table(results)),
    ]  # fmt: skip
    return "\n\n".join(part.rstrip("\n") for part in parts if part) + "\n"


def summary(console: Console, results: Results) -> None:
    """The F1 table in the terminal."""
    report.print_table(console, "F1 of predicted frames", *f1_table(results))
    console.print(f"{results['timing']['total_s']:.0f} s in all")


def f1_table(results: Results) -> tuple[list[str], list[list[str]]]:
    """F1 by model, stage and class, the paper's own figures beside its model's."""
    header = ["model", "episodes", *CLASSES]
    rows = []
    for stage, scores in PAPER_F1.items():
        rows.append(["paper's figures", str(stage), *(f"{score:.2f}" for score in scores)])
    for arm, stages in results["arms"].items():
        for stage, judged in sorted(stages.items(), key=lambda item: int(item[0])):
            rows.append([arm, stage, *(_cell(judged["f1"][name]) for name in CLASSES)])
    return header, rows


def _blur_table(results: Results, options: Options) -> tuple[list[str], list[list[str]]]:
    header = [
        "model",
        "loss",
        *(f"blur, {name}" for name in CLASSES),
        *(f"F1, {name}" for name in CLASSES),
    ]
    rows = []
    for arm, stages in results["arms"].items():
        judged = stages[str(_common(options, {int(stage): None for stage in stages}))]
        loss = arm.partition("_")[2] or "cross-entropy"
        cells = [_cell(judged[part][name]) for part in ("blur", "f1") for name in CLASSES]
        rows.append([arm, loss, *cells])
    return header, rows


def _reward_table(results: Results) -> tuple[list[str], list[list[str]]]:
    rows = []
    for arm, stages in results["arms"].items():
        for stage, judged in sorted(stages.items(), key=lambda item: int(item[0])):
            cells = [
                f"{100 * counts['right'] / max(counts['of'], 1):.1f}% of {counts['of']:,}"
                for counts in judged["reward_right"].values()
            ]
            rows.append([arm, stage, *cells])
    return ["model", "episodes", *REWARD_KINDS], rows


def _dream_table(results: Results, options: Options) -> tuple[list[str], list[list[str]]]:
    header = ["model", "frames", "step", *CLASSES]
    rows = []
    for arm, stages in results["arms"].items():
        if arm not in ("paper", "lean"):
            continue
        judged = stages[str(_common(options, {int(stage): None for stage in stages}))]
        for rule, steps in judged["dream_f1"].items():
            said = "threshold" if rule == "lit" else "drawn"
            for step, scores in steps.items():
                rows.append([arm, said, step, *(_cell(scores[name]) for name in CLASSES)])
    return header, rows


def _time_table(results: Results) -> tuple[list[str], list[list[str]]]:
    rows = [
        [arm, f"{spent['compile_s']:.0f}", f"{spent['run_s']:.0f}"]
        for arm, spent in results["timing"]["arms"].items()
    ]
    cores = results["device"]["cpu_cores"]
    return [f"model ({cores} cores)", "compiling (s)", "training and judging (s)"], rows


def _setting(options: Options, arm: str) -> str:
    config, training = config_of(options, arm), training_of(options, arm)
    network = type(config.network).__name__
    widths = options.widths if arm.startswith("paper") else options.lean_widths
    share = (
        f", a share of {training.rare_share:g} from steps with a reward"
        if training.rare_share is not None
        else ""
    )
    return (
        f"{network} with {widths} channels, {training.updates:,} updates on batches of "
        f"{training.batch}{share}, Adam from {training.learning_rate:g} down along a cosine with "
        f"weight decay {training.weight_decay:g}, "
        f"lit above {config.threshold:g}, reward by {type(config.reward).__name__}"
    )


def _used(options: Options, arm: str) -> int:
    """Position in `THRESHOLDS` of the threshold that the arm's model uses."""
    threshold = config_of(options, arm).threshold
    return int(np.argmin(np.abs(THRESHOLDS - (0.5 if threshold is None else threshold))))


def _common(options: Options, stages: Mapping[int, Any]) -> int:
    """The stage nearest to the one of the ablation."""
    return min(stages, key=lambda stage: abs(stage - options.ablation_stage))


def _stages_said(results: Results, options: Options) -> str:
    stages = {int(stage) for arm in results["arms"].values() for stage in arm}
    return f"{_common(options, dict.fromkeys(stages))} episodes"


def _step(judged: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    return judged["truth"][1] / 255, judged["belief"][1]


def _blur(mass: np.ndarray) -> np.ndarray:
    return 1 - mass[..., 1] / np.maximum(mass[..., 0], 1e-6)


def _summaries(values: np.ndarray) -> Results:
    """Mean, interval and every seed, by class, of ``[seeds, classes]``."""
    return {
        name: {
            "mean": float(column.mean()),
            "ci95": bootstrap_interval(column, lambda rows: rows.mean(-1)),
            "per_seed": column.tolist(),
        }
        for name, column in zip(CLASSES, values.T, strict=True)
    }


def _cell(summary: Results) -> str:
    return f"{summary['mean']:.3f} ({interval(summary['ci95'], 3)})"
