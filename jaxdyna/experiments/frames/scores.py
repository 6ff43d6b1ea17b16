"""Scores of frame models, out of what was counted of each run."""

from collections.abc import Callable, Sequence

import numpy as np

from jaxdyna.experiments.frames.judging import THRESHOLDS
from jaxdyna.experiments.report.summaries import Curves, by_class
from jaxdyna.experiments.report.tables import Results
from jaxdyna.statistics import mean_of_runs

HORIZONS = (1, 2, 5, 10, 20, 30, 50)


def f1(counts: np.ndarray) -> np.ndarray:
    """Of counts ``[..., 3]``: the harmonic mean of precision and recall."""
    return 2 * counts[..., 0] / np.maximum(counts[..., 1] + counts[..., 2], 1)


def recall(counts: np.ndarray) -> np.ndarray:
    """Of counts ``[..., 3]``: the share of a class's pixels that are lit."""
    return counts[..., 0] / np.maximum(counts[..., 2], 1)


def precision(counts: np.ndarray) -> np.ndarray:
    """Of counts ``[..., 3]``, or of the right and all: the share that is right; NaN of none."""
    return np.where(counts[..., 1] > 0, counts[..., 0] / np.maximum(counts[..., 1], 1), np.nan)


SCORES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "f1": f1, "recall": recall, "precision": precision}  # fmt: skip


def scored(classes: Sequence[str], kinds: Sequence[str], curves: Curves) -> Results:
    """An arm's entries: by class, in the order of `World.channels`, `SCORES` at the threshold that
    the model uses, what is believed of lit pixels and spilled on others; by kind, the first so many
    of those that `judge` tells apart, the rewards that are right; by rule and step those of dreams.
    """
    used = curves["one_step"][:, used_threshold(curves)]
    mass = curves["mass"] / np.maximum(used[..., 2:], 1)
    right = {}
    for number, kind in enumerate(kinds if "reward" in curves else ()):
        counts = curves["reward"][:, number]
        said = dict(zip(("right", "steps"), counts.sum(0).tolist(), strict=True))
        right[kind] = mean_of_runs(precision(counts)) | said
    return _scores(classes, used) | {
        "believed": by_class(classes, mass[..., 0]),
        "spilled": by_class(classes, mass[..., 1]),
        "reward_right": right,
        "dreams": {
            name.removeprefix("dream_"): _dreams(classes, curves, name)
            for name in curves
            if name.startswith("dream_")
        },
    }


def _scores(classes: Sequence[str], counts: np.ndarray) -> Results:
    return {name: by_class(classes, score(counts)) for name, score in SCORES.items()}


def _dreams(classes: Sequence[str], curves: Curves, name: str) -> Results:
    """Scores by dreamed steps, and of how many dreams where these are counted apart."""
    said: Results = {}
    for step in (step for step in HORIZONS if step <= curves[name].shape[1]):
        counts = curves[name][:, step - 1]
        wrong = counts[..., 1] + counts[..., 2] - 2 * counts[..., 0]
        share = (wrong / curves["pixels"][:, None]).mean(-1)
        said[str(step)] = _scores(classes, counts) | {"wrong": mean_of_runs(share)}
        if name.endswith("_apart"):
            said[str(step)]["dreams"] = int(curves["steps_apart"][:, step - 1].sum())
    return said


def used_threshold(curves: Curves) -> int:
    """Position in `THRESHOLDS` of the one that the model uses."""
    return int(np.argmin(np.abs(THRESHOLDS - curves["threshold"][0])))
