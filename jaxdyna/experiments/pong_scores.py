"""Scores of frame models of Pong, and the tables made of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from jaxdyna.experiments.pong_judge import OBJECTS, precision, recall
from jaxdyna.experiments.report import Results, interval
from jaxdyna.statistics import bootstrap_interval

HORIZONS = (1, 2, 5, 10, 20, 30)
SAID = {
    "l2": "L2",
    "l1": "L1",
    "bce": "cross-entropy",
    "adversarial": "L2 and the adversarial loss (the paper's)",
    "ours": "ours",
}
Curves = Mapping[str, Mapping[str, np.ndarray]]
Table = tuple[list[str], list[list[str]]]


def describe(curves: Curves, options: Any) -> Results:
    """By model and policy, of each object: recall and precision one step ahead, how much is
    believed of its pixels and spilled elsewhere for each of them, both by dreamed steps.
    """
    arms: Results = {}
    steps = [step for step in HORIZONS if step <= options.horizon]
    for name, judged in curves.items():
        arm, _, policy = name.partition("@")
        there = np.maximum(judged["one_step"][..., 2], 1)
        dreams = {
            part: {
                which: {str(n): _summaries(score(judged[part][:, n - 1])) for n in steps}
                for which, score in (("recall", recall), ("precision", precision))
            }
            for part in ("dream", "dream_unserved")
        }
        left = judged["still_unserved"].sum(0)
        arms.setdefault(arm, {})[policy] = {
            "recall": _summaries(recall(judged["one_step"])),
            "precision": _summaries(precision(judged["one_step"])),
            "believed": _summaries(judged["mass"][..., 0] / there),
            "spilled": _summaries(judged["mass"][..., 1] / there),
            **dreams,
            "still_unserved": {str(n): int(left[n - 1]) for n in steps},
        }
    return arms


def _summaries(values: np.ndarray) -> Results:
    """Mean, interval and every seed, by object, of ``[seeds, objects]``; None of nothing."""
    said: Results = {}
    for name, column in zip(OBJECTS, values.T, strict=True):
        known = column[np.isfinite(column)]
        said[name] = {
            "mean": float(known.mean()) if len(known) else None,
            "ci95": bootstrap_interval(known, lambda rows: rows.mean(-1)),
            "per_seed": [float(value) if np.isfinite(value) else None for value in column],
        }
    return said


def one_step(results: Results) -> Table:
    """Recall and precision one step ahead."""
    header = ["model", "trained on", *_headers("recall", "precision")]
    rows = [
        [arm, policy, *_cells(judged, "recall", "precision")]
        for arm, policy, judged in _each(results)
    ]
    return header, rows


def blur(results: Results) -> Table:
    """How sharp the beliefs are."""
    header = ["model", "trained on", *_headers("believed", "spilled")]
    rows = [
        [arm, policy, *_cells(judged, "believed", "spilled")]
        for arm, policy, judged in _each(results)
    ]
    return header, rows


def dreams(results: Results, part: str = "dream") -> Table:
    """Recall by dreamed steps; what was trained on the mixed policy's episodes where there is
    such.
    """
    rows = []
    for arm, policy, judged in _each(results):
        if policy == "random" and "mixed" in results["arms"][arm]:
            continue
        for step, by_object in judged[part]["recall"].items():
            sharp = judged[part]["precision"][step]
            cells = [_mean(score[name]) for score in (by_object, sharp) for name in OBJECTS]
            number = [f"{judged['still_unserved'][step]}"] if part == "dream_unserved" else []
            rows.append([arm, policy, step, *number, *cells])
    counted = ["dreams"] if part == "dream_unserved" else []
    return ["model", "trained on", "step", *counted, *_headers("recall", "precision")], rows


def times(results: Results) -> Table:
    """Seconds by what they were spent on."""
    rows = []
    for arm, spent in results["timing"]["arms"].items():
        parts = {f"training, {name} policy": took for name, took in spent["stages"].items()}
        parts |= {
            "collecting": spent.get("collect_s", 0.0),
            "compiling" if spent.get("collect_s") else "collecting, compiling": spent["compile_s"],
            "judging": spent["judge_s"],
        }
        rows += [[arm, part, f"{took:.0f}"] for part, took in parts.items() if took]
    return [f"model ({results['device']['cpu_cores']} cores)", "part", "seconds"], rows


def random_said(results: Results) -> str:
    """What training on random data alone does to the own paddle, in words."""
    said = []
    for arm, policies in results["arms"].items():
        if set(policies) >= {"random", "mixed"}:
            pairs = [
                f"{policies[policy]['recall']['own paddle']['mean']:.3f}"
                for policy in ("random", "mixed")
            ]
            spilled = [
                f"{policies[policy]['spilled']['own paddle']['mean']:.2f}"
                for policy in ("random", "mixed")
            ]
            said.append(f"`{arm}` {pairs[0]} against {pairs[1]} ({spilled[0]} and {spilled[1]})")
    if not said:
        return ""
    return (
        "Trained on the random policy alone against the mixed one, recall of the own paddle, and "
        f"in brackets what is believed of it elsewhere: {'; '.join(said)}."
    )


def _headers(*parts: str) -> list[str]:
    return [f"{part}, {name}" for part in parts for name in OBJECTS]


def _mean(summary: Results) -> str:
    return "-" if summary["mean"] is None else f"{summary['mean']:.3f}"


def _interval(summary: Results) -> str:
    """Of several runs; one has none."""
    return f" ({interval(summary['ci95'], 3)})" if len(summary["per_seed"]) > 1 else ""


def _cells(judged: Results, *parts: str) -> list[str]:
    summaries = [judged[part][name] for part in parts for name in OBJECTS]
    return [_mean(each) + _interval(each) for each in summaries]


def _each(results: Results) -> Iterator[tuple[str, str, Results]]:
    for arm, policies in results["arms"].items():
        for policy, judged in policies.items():
            yield arm, policy, judged
