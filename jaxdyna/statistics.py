"""Honest statistics: when a run solved, and what many runs say together. Plain NumPy, on the host.

An unsolved run counts as infinity: it is never dropped. A mean with an unsolved run in it is
therefore undefined (None), while a median may still be known.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import binom, rankdata

from jaxdyna.fields import check, check_counts, setting

Summary = dict[str, Any]
FEW = 5
"""Runs of which there is no honest interval: their points are all that can be said."""


@dataclass(frozen=True)
class SolveRule:
    """Solved when the mean return of ``window`` successive real training episodes reaches
    ``threshold``, or ``threshold`` times the mean of what ``share_of`` says.
    """

    window: int = setting(help="Successive real training episodes.", at_least=1)
    threshold: float = setting(help="A return, or a share.")
    share_of: str | None = setting(
        None, "Name of a curve, such as the return that was to be had in each episode; None for a "
        "threshold that is a return.",
    )  # fmt: skip

    def __post_init__(self) -> None:
        check(self)

    def reached(self, mean: np.ndarray) -> np.ndarray:
        """Whether a mean of `score` is as high as asked for, but for rounding."""
        return mean >= (self.threshold if self.share_of is None else 0.0) - 1e-9

    def score(self, curves: Mapping[str, np.ndarray]) -> np.ndarray:
        """Of every episode, ``[seeds, episodes]``: its return, or how far it is above its share."""
        returns = np.asarray(curves["real_return"], np.float64)
        return (
            returns if self.share_of is None else returns - self.threshold * curves[self.share_of]
        )

    def __str__(self) -> str:
        what = f" of the mean {self.share_of.replace('_', ' ')}" if self.share_of else ""
        return (
            f"solved at the first real training episode at which the mean return of the last "
            f"{self.window} reaches {self.threshold:g}{what}; episodes_to_solve is that episode's "
            f"number counted from 1, first_solved the number of the window's first episode, and "
            f"real_steps_to_solve the real steps before the window begins"
        )


def episodes_to_solve(returns: np.ndarray, rule: SolveRule) -> np.ndarray:
    """The number, from 1, of the episode that ends the first solving window.

    Args:
        returns: `SolveRule.score`, ``[..., episodes]``; NaN where an episode was not played. A
            window with what is not finite in it solves nothing, and spoils no other one.
        rule: when a run is solved.

    Returns:
        float64 ``[...]``, infinity where unsolved.
    """
    returns = np.asarray(returns, np.float64)
    if returns.shape[-1] < rule.window:
        return np.full(returns.shape[:-1], np.inf)
    means = running_mean(returns, rule.window)[..., rule.window - 1 :]
    reached = rule.reached(means)
    return np.where(reached.any(-1), reached.argmax(-1) + rule.window, np.inf)


def running_mean(values: np.ndarray, window: int) -> np.ndarray:
    """The mean of the last ``window`` entries at each of ``[..., episodes]``, of fewer at the
    start, float64 of the same shape; NaN where one of them is not finite.
    """
    check_counts(window=window)
    ends = np.arange(1, values.shape[-1] + 1)
    starts = np.maximum(ends - window, 0)

    def sums(parts: np.ndarray) -> np.ndarray:
        zeros = np.zeros((*parts.shape[:-1], 1))
        padded = np.concatenate([zeros, parts.cumsum(-1, np.float64)], -1)
        return padded[..., ends] - padded[..., starts]

    finite = np.isfinite(values)
    return np.where(sums(~finite) > 0, np.nan, sums(np.where(finite, values, 0)) / (ends - starts))


def carried(values: np.ndarray) -> np.ndarray:
    """``[seeds, episodes]``, NaN after a run's end, with its last value there instead."""
    last = np.maximum(np.isfinite(values).sum(-1) - 1, 0)
    numbers = np.minimum(np.arange(values.shape[-1]), last[:, None])
    return np.take_along_axis(values, numbers, axis=-1)


def last_mean(values: np.ndarray, window: int) -> np.ndarray:
    """The mean of each run's own last so many entries, ``[seeds]``, of ``[seeds, episodes]`` that
    are NaN after a run's end.
    """
    return carried(running_mean(values, window))[:, -1]


def steps_before(lengths: np.ndarray, first_solved: np.ndarray) -> np.ndarray:
    """Real steps before the solving window begins, ``[seeds]``, from the real episodes' lengths
    ``[seeds, episodes]`` and its first episode from 1, ``[seeds]``; infinity where unsolved.
    """
    numbers = np.arange(1, lengths.shape[-1] + 1)
    before = np.where(numbers < first_solved[:, None], np.nan_to_num(lengths), 0).sum(-1)
    return np.where(np.isfinite(first_solved), before, np.inf)


def summarise(
    per_seed: np.ndarray,
    solved: np.ndarray | None = None,
    at_least: np.ndarray | float | None = None,
) -> Summary:
    """What the seeds say together, ready for JSON (None for infinity).

    Args:
        per_seed: ``[seeds]``, one at least; infinity where unsolved.
        solved: bool ``[seeds]``, by default where ``per_seed`` is finite.
        at_least: lower bound of an unsolved seed's value, such as the budget, a scalar or
            ``[seeds]``.

    Returns:
        ``per_seed, mean, median``; ``ci95`` (bootstrap interval of the mean), None for five seeds
        or fewer, and for seeds that are all alike; ``median_ci95`` (exact, by ranks); ``solved``
        and ``seeds`` (counts); ``budget`` (the largest bound) and ``restricted_mean``, the mean
        with unsolved seeds at their bound, both None without ``at_least``.
    """
    per_seed = np.asarray(per_seed, np.float64)
    if per_seed.ndim != 1 or not per_seed.size:
        raise ValueError(f"per_seed is {list(per_seed.shape)}: give [seeds], a number a run")
    solved = np.isfinite(per_seed) if solved is None else solved
    budget = restricted = None
    if at_least is not None:
        budget = float(np.max(at_least))
        restricted = float(np.where(np.isfinite(per_seed), per_seed, at_least).mean())
    several = len(per_seed) > FEW and np.unique(per_seed).size > 1
    return {
        "per_seed": [_plain(value) for value in per_seed],
        "mean": _plain(np.mean(per_seed)),
        "median": _plain(np.median(per_seed)),
        "ci95": bootstrap_interval(per_seed, _row_means) if several else None,
        "median_ci95": median_interval(per_seed),
        "solved": int(np.sum(solved)),
        "seeds": len(per_seed),
        "budget": budget,
        "restricted_mean": restricted,
    }


def median_interval(values: np.ndarray) -> list[float | None] | None:
    """The exact 95% interval of a median by ranks, such as the 2nd to the 9th of ten values; None
    for five or fewer, which have none.
    """
    rank = int(binom.ppf(0.025, len(values), 0.5))
    if rank < 1:
        return None
    ordered = np.sort(values)
    return [_plain(ordered[rank - 1]), _plain(ordered[len(values) - rank])]


def bootstrap_interval(
    values: np.ndarray, statistic: Callable[[np.ndarray], np.ndarray], resamples: int = 5000
) -> list[float | None]:
    """A 95% percentile-bootstrap interval over seeds, the same on every call.

    Args:
        values: ``[seeds]``.
        statistic: from ``[resamples, seeds]`` to ``[resamples]``.
        resamples: how many.

    Returns:
        ``[low, high]``; None for an infinite end, and for a single seed.
    """
    if len(values) < 2:
        return [None, None]
    index = np.random.default_rng(0).integers(0, len(values), (resamples, len(values)))
    return _interval(statistic(values[index]))


def mean_of_runs(values: np.ndarray) -> Summary:
    """One number a run, such as a final return, ``[seeds]``: ``mean`` and ``ci95`` (bootstrap
    interval) of what is finite, and ``per_seed``, None of what is not.
    """
    known = values[np.isfinite(values)]
    return {
        "mean": float(known.mean()) if len(known) else None,
        "ci95": bootstrap_interval(known, _row_means),
        "per_seed": [_plain(value) for value in values],
    }


def mean_interval(values: np.ndarray, resamples: int = 400) -> np.ndarray:
    """95% bootstrap intervals of the mean over seeds, each of ``[seeds, n]``: ``[2, n]``."""
    generator = np.random.default_rng(0)
    weights = generator.multinomial(len(values), np.full(len(values), 1 / len(values)), resamples)
    return np.percentile(weights @ values / len(values), [2.5, 97.5], axis=0)


def ratio_of_means(
    numerator: np.ndarray, denominator: np.ndarray, denominator_at_least: float = np.inf
) -> Summary:
    """How two arms compare: the ratio of their means, with a 95% bootstrap interval.

    Args:
        numerator: ``[seeds]``, infinity where unsolved.
        denominator: ``[seeds]``.
        denominator_at_least: lower bound of an unsolved seed's value.

    Returns:
        ``ratio`` and ``ci95``; ``bound`` is True where unsolved seeds in the denominator stand at
        their lower bound, so that the ratio and its interval are upper bounds. None where an
        unsolved seed in the numerator, or one without a bound, leaves nothing known, and no
        interval of five seeds or fewer.
    """
    bound = not np.isfinite(denominator).all()
    denominator = np.where(np.isfinite(denominator), denominator, denominator_at_least)
    if not (np.isfinite(numerator).all() and np.isfinite(denominator).all()):
        return {"ratio": None, "ci95": [None, None], "bound": bound}
    generator = np.random.default_rng(0)

    def means(values):
        return values[generator.integers(0, len(values), (5000, len(values)))].mean(-1)

    several = min(len(numerator), len(denominator)) > FEW
    resampled = means(numerator) / means(denominator)
    return {
        "ratio": _plain(numerator.mean() / denominator.mean()),
        "ci95": _interval(resampled) if several else [None, None],
        "bound": bound,
    }


def rank_correlation(left: np.ndarray, right: np.ndarray) -> tuple[float, float, float]:
    """Spearman's rank correlation of the means over seeds of two finite quantities, ``[settings,
    seeds]`` of the same seeds, 0 where one is the same in every setting, and the ends of its 95%
    bootstrap interval over seeds.
    """

    def correlate(draws):
        ranks = [rankdata(values[:, draws].mean(-1), axis=0) for values in (left, right)]
        one, other = (each - each.mean(0) for each in ranks)
        scale = np.sqrt(np.square(one).sum(0) * np.square(other).sum(0))
        return (one * other).sum(0) / np.where(scale > 0, scale, 1)

    seeds = left.shape[1]
    draws = np.random.default_rng(0).integers(0, seeds, (2000, seeds))
    low, high = np.percentile(correlate(draws), [2.5, 97.5])
    return float(correlate(np.arange(seeds)[None])[0]), float(low), float(high)


def _row_means(values: np.ndarray) -> np.ndarray:
    return values.mean(-1)


def _interval(resampled: np.ndarray) -> list[float | None]:
    low, high = np.percentile(resampled, [2.5, 97.5], method="nearest")
    return [_plain(low), _plain(high)]


def _plain(value: Any) -> float | None:
    return float(value) if np.isfinite(value) else None
