"""Scores of frame models, out of what was counted of each run."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from jaxdyna.experiments.maze_judge import CLASSES, REWARD_KINDS, THRESHOLDS, f1
from jaxdyna.experiments.maze_options import Options, config_of
from jaxdyna.experiments.maze_tables import RULES
from jaxdyna.experiments.report import Results
from jaxdyna.statistics import bootstrap_interval

HORIZONS = (1, 5, 10, 25, 50)
Judged = Mapping[str, np.ndarray]
Curves = Mapping[str, Judged]


def describe(curves: Curves, options: Options) -> Results:
    """By arm and stage: F1 a class, at the threshold used and at others; what is believed of
    lit pixels and spilled on others; rewards right a kind; F1 and error of dreams by step.
    """
    arms: Results = {}
    for name, judged in curves.items():
        arm, _, stage = name.partition("@")
        scores = f1(judged["one_step"])
        lit = np.maximum(judged["one_step"][:, 0, :, 2], 1)
        arms.setdefault(arm, {})[stage] = {
            "f1": _summaries(scores[:, used_threshold(options, arm)]),
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
    for rule in RULES:
        counts = judged[f"dream_{rule}"]
        wrong = (counts[..., 1] + counts[..., 2] - 2 * counts[..., 0]) / pixels
        scores = f1(counts)
        described["dream_f1"][rule] = {str(n): _summaries(scores[:, n - 1]) for n in steps}
        described["dream_error"][rule] = {str(n): _summaries(wrong[:, n - 1]) for n in steps}
    return described


def used_threshold(options: Options, arm: str) -> int:
    """Position in `THRESHOLDS` of the threshold that the arm's model uses."""
    threshold = config_of(options, arm).threshold
    return int(np.argmin(np.abs(THRESHOLDS - (0.5 if threshold is None else threshold))))


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
