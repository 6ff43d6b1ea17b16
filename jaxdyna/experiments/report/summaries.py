"""What runs say together: an arm's figures of ``results.json``, ratios of arms, sentences."""

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxdyna import statistics
from jaxdyna.dyna.loop import DIVERGED
from jaxdyna.experiments.report.tables import Results, figure_at, interval, p_value, per_seed
from jaxdyna.statistics import SolveRule, last_mean, mean_of_runs, summarise

Curves = Mapping[str, np.ndarray]
FIRST_DREAMS = 100
HELD_EPISODES = 50
AS_BUSY = "more_updates", "max_updates"  #: arms that learn as often as ``dyna``, of real steps
UNITS = {
    "episodes_to_solve": "episodes",
    "real_steps_to_solve": "real steps before the solving window",
    "first_solved": "episodes up to the solving window's first",
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
        "final_return": summarise(last_mean(returns, rule.window), solved, positive=False),
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
    """`ratio_of` each arm's figure, by its dotted path, to the baseline's in the same setting."""
    ratios = {}
    for name, arm in arms.items():
        other = baseline_of(arm, baseline)
        mine, theirs = figure_at(arm, figure), figure_at(arms.get(other, {}), figure)
        if mine and theirs and name != other:
            ratios[name] = ratio_of(mine, theirs)
    return ratios


def ratio_of(mine: Results, theirs: Results, paired: bool = False) -> Results:
    """`statistics.ratio_of_means` of two figures of solving: of restricted means, in which unsolved
    runs count with what they played; none where both are `hardly_solved`.
    """
    of = per_seed if hardly_solved(mine, theirs) else restricted
    return statistics.ratio_of_means(of(mine), of(theirs), paired)


def hardly_solved(*figures: Results) -> bool:
    """Whether fewer than half of the runs of each have solved: their restricted means are near the
    budget then, and so alike, whatever the arms are.
    """
    return all(2 * figure["solved"] < figure["seeds"] for figure in figures)


def baseline_of(arm: Results, baseline: str) -> str:
    """The full name of the baseline in an arm's setting."""
    return f"{baseline}@{arm['setting']}" if arm.get("setting") else baseline


def restricted(figure: Results) -> np.ndarray:
    """Each run's figure ``[seeds]``, of unsolved ones what they played; in old records its mean."""
    if figure.get("restricted_per_seed"):
        return np.array(figure["restricted_per_seed"], float)
    values = per_seed(figure)
    unsolved = ~np.isfinite(values)
    rest = figure["restricted_mean"] * len(values) - values[~unsolved].sum()
    return np.where(unsolved, rest / max(unsolved.sum(), 1), values)


def comparison(
    results: Results, paper: Mapping[str, float], baseline: str = "model_free",
    figure: str = "episodes_to_solve",
) -> list[str]:  # fmt: skip
    """The ratios to a baseline in words, a line an arm, the paper's own beside those it gives."""
    arms, lines = results["arms"], []
    for name, ratio in compare(arms, baseline, figure).items():
        other = baseline_of(arms[name], baseline)
        if ratio["ratio"] is None:
            why = hardly_solved(*(figure_at(arms[one], figure) for one in (name, other)))
            said = ", since fewer than half of the runs of either have solved" if why else ""
            lines.append(f"{name} and {other}: no ratio of {UNITS[figure]}{said}.")
            continue
        beside = []
        if ratio["ci95"] is not None:
            beside += [f"95% interval {interval(ratio['ci95'], 2)}", p_value(ratio["p"])]
        beside += [f"the paper's is {paper[name]:.2g}"] if name in paper else []
        said = f" ({', '.join(beside)})" if beside else ""
        found = f"{name} needs **{ratio['ratio']:.2f}** of {other}'s {UNITS[figure]}"
        they_are = verdict(ratio["p"], ratio["ci90"])
        lines.append(f"{found}{said}.{f' They are {they_are}.' if they_are else ''}")
    if any(arms[name][figure]["solved"] < arms[name][figure]["seeds"] for name in arms):
        lines.append("Unsolved runs count with what they played.")
    return lines


def break_even(results: Results) -> tuple[float, float, float] | None:
    """What a real step has to take for dreams to pay.

    Returns:
        Seconds of computing that a run of ``dyna`` takes beyond one of ``model_free``, the real
        steps before the solving window that it saves (restricted means), and the one over the other
        in milliseconds a real step. None where seconds are not known, where nothing is saved or the
        two are not told apart, as of five runs or fewer, where no run of ``dyna`` has solved, or
        both are `hardly_solved`.

    Seconds are a core's, or a device's, of whole runs, as long as they were played: where these go
    on after they have solved, dreams are charged for that as well.
    """
    both = "dyna", "model_free"
    spent, arms, device = (results.get(name, {}) for name in ("timing", "arms", "device"))
    seconds = [spent.get("arms", {}).get(name, {}).get("run_s") for name in both]
    if None in seconds or spent.get("shards", 1) > 1 or not {*both} <= arms.keys():
        return None
    figures = [arms[name]["real_steps_to_solve"] for name in both]
    if not figures[0].get("solved") or hardly_solved(*figures):
        return None
    runs, block = len(results["runs"]["seeds"]), results["runs"]["block"]
    workers = device["cpu_cores"] if device["platform"] == "cpu" else device["count"]
    each = [one * min(workers, -(-runs // block)) / runs for one in seconds]
    with_it, without = (restricted(figure) for figure in figures)
    extra, saved = each[0] - each[1], float(without.mean() - with_it.mean())
    p = statistics.ratio_of_means(with_it, without)["p"]
    if saved <= 0 or p is None or p > 0.05:
        return None
    return extra, saved, 1000 * max(extra, 0.0) / saved


def verdict(p: float | None, ci90: Sequence[float] | None) -> str:
    """What two are by p and the 90% interval of their ratio; empty where they are told apart."""
    if p is None or ci90 is None or p <= 0.05:
        return ""
    return "the same within a tenth" if ci90[0] >= 0.9 and ci90[1] <= 1.1 else "not told apart"


def comparisons(
    results: Results, paper: Mapping[str, float], figure: str = "episodes_to_solve"
) -> list[str]:
    """The ratios to ``model_free``, and of our dreams to as many updates without them."""
    arms, lines = results["arms"], comparison(results, paper, figure=figure)
    for other in AS_BUSY:
        both = {name: arms[name] for name in ("dyna", other) if name in arms}
        lines += comparison({"arms": both}, {}, other, figure) if len(both) > 1 else []
    return list(dict.fromkeys(lines))
