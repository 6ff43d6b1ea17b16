"""How many times fewer episodes, or steps, one arm needs than another."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from jaxdyna.experiments.report import Results, interval
from jaxdyna.statistics import ratio_of_means

UNITS = {
    "episodes_to_solve": "episodes",
    "real_steps_to_solve": "real steps before the solving window",
}


def compare(arms: Results, baseline: str, figure: str = "episodes_to_solve") -> Results:
    """Ratio of each arm's mean of a figure of `describe_arm` to the baseline's, with its interval;
    an unsolved run of the baseline counts as the least that it can have needed.
    """
    if baseline not in arms:
        return {}
    denominator = _per_seed(arms[baseline][figure])
    unsolved = ~np.isfinite(denominator)
    known = denominator[~unsolved].sum()
    least = arms[baseline][figure]["mean_at_least"] * len(denominator) - known
    at_least = least / max(unsolved.sum(), 1)
    return {
        name: ratio_of_means(_per_seed(arm[figure]), denominator, at_least)
        for name, arm in arms.items()
        if name != baseline
    }


def comparison(
    results: Results,
    paper: Mapping[str, float],
    baseline: str = "model_free",
    figure: str = "episodes_to_solve",
) -> list[str]:
    """The ratios to a baseline in words, a line an arm, the paper's own beside those it gives."""
    lines, unknown = [], []
    for name, ratio in compare(results["arms"], baseline, figure).items():
        if ratio["ratio"] is None:
            unknown.append(name)
            continue
        said = f"; the paper's is {paper[name]}" if name in paper else ""
        most = "at most " if ratio["bound"] else ""
        why = f", because {baseline} has unsolved runs" if ratio["bound"] else ""
        lines.append(
            f"{name} needs {most}**{ratio['ratio']:.2f}** of {baseline}'s {UNITS[figure]}{why} "
            f"(95% interval {interval(ratio['ci95'], 2)}{said})."
        )
    if unknown:
        arms = ", ".join(unknown)
        lines.append(f"Not all runs of {arms} solved: ratios to {baseline} are unknown.")
    return lines


def comparisons(
    results: Results, paper: Mapping[str, float], figure: str = "episodes_to_solve"
) -> list[str]:
    """The ratios to ``model_free``, and of our dreams to as many updates without them."""
    arms = results["arms"]
    both = {name: arms[name] for name in ("dyna", "more_updates") if name in arms}
    lines = comparison(results, paper, figure=figure)
    return lines + comparison({"arms": both}, {}, "more_updates", figure)


def _per_seed(summary: Results) -> np.ndarray:
    return np.array([np.inf if value is None else value for value in summary["per_seed"]])
