"""What runs say together: an arm's figures of ``results.json``, ratios of arms, sentences."""

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxdyna import statistics
from jaxdyna.dyna.loop import DIVERGED
from jaxdyna.experiments.report.tables import Results, interval, per_seed
from jaxdyna.statistics import SolveRule, last_mean, mean_of_runs, summarise

Curves = Mapping[str, np.ndarray]
FIRST_DREAMS = 100
HELD_EPISODES = 50
UNITS = {
    "episodes_to_solve": "episodes",
    "real_steps_to_solve": "real steps before the solving window",
}


def describe_arm(curves: Curves, rule: SolveRule, budget: int) -> Results:
    """The figures of one arm, out of ``real_return`` and ``real_length``, ``[runs, episodes]``, NaN
    after a run's own end, and what the rule asks for; ``budget``: real episodes at the most.
    """
    score, returns = rule.score(curves), curves["real_return"]
    solved_at = statistics.episodes_to_solve(score, rule)
    first = solved_at - rule.window + 1
    solved = np.isfinite(solved_at)
    steps = statistics.steps_before(curves["real_length"], first)
    played = np.isfinite(returns).sum(-1)
    held, reached = last_mean(score, HELD_EPISODES), rule.reached(score)
    first_at = np.where(reached.any(1), reached.argmax(1) + 1.0, np.inf)
    return {
        "episodes_to_solve": summarise(solved_at, at_least=budget),
        "first_solved": summarise(first, at_least=max(budget - rule.window + 1, 1)),
        "real_steps_to_solve": summarise(steps, at_least=np.nansum(curves["real_length"], -1)),
        "first_at_threshold": summarise(first_at, at_least=budget),
        "final_return": summarise(last_mean(returns, rule.window), solved),
        "solved_and_held": int((solved & rule.reached(held)).sum()),
        "episodes_played": {"mean": float(played.mean()), "per_seed": played.tolist()},
        "solve_rule": str(rule),
    }


def diverged(curves: Curves, seeds: Sequence[int]) -> Results:
    """``diverged``: of each run whose numbers stopped being finite the unit at which (an episode,
    or a gradient step; from 1) and whose they were, by its seed; nothing where none did.
    """
    numbers = np.nan_to_num(curves.get("diverged", np.zeros((len(seeds), 1)))).astype(int)
    said = {
        str(seed): {"unit": int(row.argmax()) + 1, "part": DIVERGED[row.max() - 1]}
        for seed, row in zip(seeds, numbers, strict=True)
        if row.any()
    }
    return {"diverged": said} if said else {}


def by_class(names: Sequence[str], values: np.ndarray) -> Results:
    """`mean_of_runs` of each column of ``[runs, names]``."""
    return {name: mean_of_runs(column) for name, column in zip(names, values.T, strict=True)}


def first_dreams(options: Any, curves: Curves) -> Results:
    """``first_dreams``: medians of fake and real return and length over runs and the first
    `FIRST_DREAMS` episodes with dreams; empty for an arm without, NaN where none took place.
    """
    start = max(options.dyna.num_real_first - 1, 0)
    after = slice(start, start + FIRST_DREAMS)
    names = ("fake_return", "real_return", "fake_length", "real_length")
    with warnings.catch_warnings(action="ignore"):
        said = {name: float(np.nanmedian(curves[name][:, after])) for name in names
                if "fake_length" in curves}  # fmt: skip
    return {"first_dreams": said}


def compare(arms: Results, baseline: str, figure: str = "episodes_to_solve") -> Results:
    """Ratio of each arm's mean of a figure of `describe_arm` to the baseline's, with its interval;
    an unsolved run of the baseline counts as the least that it can have needed.
    """
    if baseline not in arms:
        return {}
    denominator = per_seed(arms[baseline][figure])
    unsolved = ~np.isfinite(denominator)
    known = denominator[~unsolved].sum()
    least = arms[baseline][figure]["restricted_mean"] * len(denominator) - known
    at_least = least / max(unsolved.sum(), 1)
    return {
        name: statistics.ratio_of_means(per_seed(arm[figure]), denominator, at_least)
        for name, arm in arms.items()
        if name != baseline and figure in arm
    }


def comparison(
    results: Results, paper: Mapping[str, float], baseline: str = "model_free",
    figure: str = "episodes_to_solve",
) -> list[str]:  # fmt: skip
    """The ratios to a baseline in words, a line an arm, the paper's own beside those it gives."""
    arms, lines, unknown = results["arms"], [], []
    for name, ratio in compare(arms, baseline, figure).items():
        if ratio["ratio"] is None:
            if mean := arms[baseline][figure]["mean"]:
                least = arms[name][figure]["restricted_mean"] / mean
                said = f"at least **{least:.2f}** of {baseline}'s {UNITS[figure]}"
                lines.append(f"{name} needs {said}, because it has unsolved runs.")
            else:
                unknown.append(name)
            continue
        ends = interval(ratio["ci95"], 2)
        beside = [f"95% interval {ends}"] if ends != "-" else []
        beside += [f"the paper's is {paper[name]:.2g}"] if name in paper else []
        said = f" ({'; '.join(beside)})" if beside else ""
        most = "at most " if ratio["bound"] else ""
        why = f", because {baseline} has unsolved runs" if ratio["bound"] else ""
        found = f"{name} needs {most}**{ratio['ratio']:.2f}** of {baseline}'s {UNITS[figure]}"
        lines.append(f"{found}{why}{said}.")
    if unknown:
        unsolved = ", ".join([baseline, *unknown])
        lines.append(f"Not all runs of {unsolved} solved: ratios to {baseline} are unknown.")
    return lines


def comparisons(
    results: Results, paper: Mapping[str, float], figure: str = "episodes_to_solve"
) -> list[str]:
    """The ratios to ``model_free``, and of our dreams to as many updates without them."""
    arms, lines = results["arms"], comparison(results, paper, figure=figure)
    for other in ("more_updates", "max_updates"):
        both = {name: arms[name] for name in ("dyna", other) if name in arms}
        lines += comparison({"arms": both}, {}, other, figure)
    return lines
