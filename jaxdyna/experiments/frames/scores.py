"""Scores of frame models, out of what was counted of each run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxdyna.experiments.frames.judging import THRESHOLDS
from jaxdyna.experiments.report.summaries import by_class, mean_of_runs

HORIZONS = (1, 2, 5, 10, 20, 30, 50)
Results = dict[str, Any]
Curves = Mapping[str, np.ndarray]


def f1(counts: np.ndarray) -> np.ndarray:
    """Of counts ``[..., 3]``: the harmonic mean of precision and recall."""
    return 2 * counts[..., 0] / np.maximum(counts[..., 1] + counts[..., 2], 1)


def recall(counts: np.ndarray) -> np.ndarray:
    """Of counts ``[..., 3]``: the share of a class's pixels that are lit."""
    return counts[..., 0] / np.maximum(counts[..., 2], 1)


def precision(counts: np.ndarray) -> np.ndarray:
    """Of counts ``[..., 3]``: the share of lit pixels that are the class's; NaN of none."""
    return np.where(counts[..., 1] > 0, counts[..., 0] / np.maximum(counts[..., 1], 1), np.nan)


SCORES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "f1": f1, "recall": recall, "precision": precision,
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Scored:
    """What is told apart.

    Attributes:
        classes: their names, in the order of `World.channels`.
        kinds: names of the kinds of rewards that `jaxdyna.experiments.frames.judging.judge` tells
            apart, the first so many.
    """

    classes: tuple[str, ...]
    kinds: tuple[str, ...] = ()

    def describe(self, options: Any, curves: Curves) -> Results:
        """An arm's entries: by class `SCORES` at the threshold that the model uses, F1 at all of
        them, what is believed of lit pixels and spilled on others; by kind the rewards that are
        right; by rule and dreamed steps the scores of dreams.
        """
        judged = curves["one_step"]
        used = judged[:, used_threshold(curves)]
        lit = np.maximum(used[..., 2], 1)
        means = f1(judged).mean(0).tolist()
        return {
            **{name: self._by_class(score(used)) for name, score in SCORES.items()},
            "f1_by_threshold": {
                f"{threshold:g}": dict(zip(self.classes, row, strict=True))
                for threshold, row in zip(THRESHOLDS, means, strict=True)
            },
            "believed": self._by_class(curves["mass"][..., 0] / lit),
            "spilled": self._by_class(curves["mass"][..., 1] / lit),
            "reward_right": {
                kind: _share(curves["reward"][:, number])
                for number, kind in enumerate(self.kinds)
                if "reward" in curves
            },
            "dreams": {
                name.removeprefix("dream_"): self._dreams(curves, name)
                for name in curves
                if name.startswith("dream_")
            },
        }

    def _dreams(self, curves: Curves, name: str) -> Results:
        """Scores by dreamed steps, and of how many dreams where these are counted apart."""
        said: Results = {}
        apart, pixels = name.endswith("_apart"), curves["pixels"][:, None]
        for step in (step for step in HORIZONS if step <= curves[name].shape[1]):
            counts = curves[name][:, step - 1]
            wrong = (counts[..., 1] + counts[..., 2] - 2 * counts[..., 0]) / pixels
            said[str(step)] = {
                **{score: self._by_class(of(counts)) for score, of in SCORES.items()},
                "wrong": mean_of_runs(wrong.mean(-1)),
                **({"dreams": int(curves["steps_apart"][:, step - 1].sum())} if apart else {}),
            }
        return said

    def _by_class(self, values: np.ndarray) -> Results:
        return by_class(dict.fromkeys(self.classes), values)


def used_threshold(curves: Curves) -> int:
    """Position in `THRESHOLDS` of the one that the model uses."""
    return int(np.argmin(np.abs(THRESHOLDS - curves["threshold"][0])))


def _share(counts: np.ndarray) -> Results:
    """Of counts ``[runs, 2]``, right and all: the share, of those runs that have any."""
    share = np.where(counts[:, 1] > 0, counts[:, 0] / np.maximum(counts[:, 1], 1), np.nan)
    return mean_of_runs(share) | {
        "right": int(counts[:, 0].sum()),
        "steps": int(counts[:, 1].sum()),
    }
