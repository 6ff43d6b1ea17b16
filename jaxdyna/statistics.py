"""Honest statistics: when a run solved, and what many runs say together. Plain NumPy, on the host.

An unsolved run counts as infinity: it is never dropped. A mean with an unsolved run in it is
therefore undefined (None), while a median may still be known.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy  # whose parts are imported at their first use

from jaxdyna.fields import Checked, check_counts, setting

Summary = dict[str, Any]
INFINITE = 1e30
MOST_ERRORS = 1e3  #: an end that is so many standard errors away is no end
FEW = 5  #: runs of which there is no honest interval: their points are all that can be said


@dataclass(frozen=True)
class SolveRule(Checked):
    """Solved when the mean return of ``window`` successive real training episodes reaches
    ``threshold``, or ``threshold`` times the mean of what ``share_of`` says.
    """

    window: int = setting(help="Successive real training episodes.", at_least=1)
    threshold: float = setting(help="A return, or a share.")
    share_of: str | None = setting(
        None, "Name of a curve, such as the return that was to be had in each episode; None for a "
        "threshold that is a return.")  # fmt: skip

    def reached(self, mean: np.ndarray) -> np.ndarray:
        """Whether a mean of `score` is as high as asked for, but for rounding."""
        return mean >= (self.threshold if self.share_of is None else 0.0) - 1e-9

    def score(self, curves: Mapping[str, np.ndarray]) -> np.ndarray:
        """Of every episode, ``[seeds, episodes]``: its return, or how far it is above its share."""
        returns = np.asarray(curves["real_return"], np.float64)
        share = 0 if self.share_of is None else self.threshold * curves[self.share_of]
        return returns - share

    def __str__(self) -> str:
        what = f" of the mean {self.share_of.replace('_', ' ')}" if self.share_of else ""
        return (
            f"solved at the first real training episode at which the mean return of the last "
            f"{self.window} reaches {self.threshold:g}{what}; episodes_to_solve is that episode's "
            f"number counted from 1, first_solved the number of the window's first episode, and "
            f"real_steps_to_solve the real steps before the window begins"
        )


def episodes_to_solve(returns: np.ndarray, rule: SolveRule) -> np.ndarray:
    """Which episode, from 1, ends the first solving window: float64 ``[...]``, infinity for none.

    Args:
        returns: `SolveRule.score`, ``[..., episodes]``; NaN where an episode was not played. A
            window with what is not finite in it solves nothing, and spoils no other one.
        rule: when a run is solved.
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
    """The mean of each run's own last so many entries, ``[seeds]``, of ``[seeds, episodes]``."""
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
    positive: bool = True,
) -> Summary:
    """What the seeds say together, ready for JSON (None for infinity).

    Args:
        per_seed: ``[seeds]``, one at least; infinity where unsolved.
        solved: bool ``[seeds]``, by default where ``per_seed`` is finite.
        at_least: the budget B at which an unsolved seed stopped, a scalar or ``[seeds]``.
        positive: whether it is a positive quantity, whose logarithm is the more symmetrical.

    Returns:
        ``per_seed``, ``mean`` and ``median`` (None where unsolved seeds leave them unknown);
        ``median_ci95`` (exact, by ranks); ``solved``, ``seeds`` and ``solved_ci95`` of the share
        (exact, Clopper and Pearson); ``ci95`` of the mean, `studentised_interval`. With
        ``at_least`` also ``budget``, the largest, and of min(T, B) ``restricted_mean``,
        ``restricted_ci95`` and ``restricted_per_seed``, else None.
    """
    per_seed = np.asarray(per_seed, np.float64)
    if per_seed.ndim != 1 or not per_seed.size:
        raise ValueError(f"per_seed is {list(per_seed.shape)}: give [seeds], a number a run")
    solved = np.isfinite(per_seed) if solved is None else solved
    budget = restricted = restricted_ci95 = stopped = None
    most = np.inf
    if at_least is not None:
        budget = most = float(np.max(at_least))
        values = np.where(np.isfinite(per_seed), per_seed, at_least)
        restricted = float(values.mean())
        restricted_ci95 = studentised_interval(values, positive, most)
        stopped = [_plain(value) for value in values]
    share = scipy.stats.binomtest(int(np.sum(solved)), len(per_seed)).proportion_ci(method="exact")
    return {
        "per_seed": [_plain(value) for value in per_seed],
        "mean": _plain(np.mean(per_seed)),
        "ci95": studentised_interval(per_seed, positive, most),
        "median": _plain(np.median(per_seed)),
        "median_ci95": median_interval(per_seed),
        "solved": int(np.sum(solved)),
        "seeds": len(per_seed),
        "solved_ci95": [float(share.low), float(share.high)],
        "budget": budget,
        "restricted_mean": restricted,
        "restricted_ci95": restricted_ci95,
        "restricted_per_seed": stopped,
    }


def median_interval(values: np.ndarray) -> list[float | None] | None:
    """The exact 95% interval of a median by ranks, such as the 2nd to the 9th of ten values; None
    for five or fewer, which have none.
    """
    ends = scipy.stats.quantile_test(values).confidence_interval(0.95)
    return None if np.isnan(ends).any() else [_plain(end) for end in ends]


def studentised_interval(
    values: np.ndarray, positive: bool = False, most: float = np.inf, resamples: int = 5000
) -> list[float | None] | None:
    """A 95% studentised-bootstrap interval of a mean over seeds, the same on every call (Efron and
    Tibshirani 1993, §12.5). It holds the mean about as often as it says from six seeds on, where
    the percentile bootstrap's holds it in 85 to 90 of 100 cases. Of a few runs apart from the rest
    some resamples have next to no spread, and ends are anywhere: where a plain one would lie
    beyond the runs by more than half their range, Student's t stands, which holds about as often.

    Args:
        values: ``[seeds]``.
        positive: whether to resample the mean's logarithm: of positive, skewed quantities.
        most: the largest that values can be; of positive ones the least is 0.
        resamples: how many.

    Returns:
        ``[low, high]``; None where there is no honest one: of five seeds or fewer, of seeds that
        are all alike, or all but one or two, where one is infinite, and where it would say
        nothing: be all that values can be, or more than `MOST_ERRORS` standard errors long.
    """
    values = np.asarray(values, np.float64)
    known = len(values) > FEW and np.isfinite(values).all() and np.ptp(values) > 0
    if not known or (positive and values.mean() <= 0):
        return None
    draws = np.random.default_rng(0).integers(0, len(values), (resamples, len(values)))
    mean, error = _mean_and_error(values[None], positive)
    means, errors = _mean_and_error(values[draws], positive)
    spread = errors > 1e-9 * error  # a resample without it, but for rounding, counts as infinite
    pivots = np.where(
        spread, (means - mean) / np.where(spread, errors, 1), INFINITE * np.sign(means - mean)
    )
    high, low = np.percentile(pivots, [2.5, 97.5], method="nearest")
    ends = np.array([mean[0] - low * error[0], mean[0] - high * error[0]])
    if positive and np.isfinite(most):
        within = np.clip(np.exp(np.clip(ends, -700, 700)), 0, most)
        return None if within[0] < 1 / INFINITE and within[1] == most else within.tolist()
    astray = max(abs(low), abs(high)) > MOST_ERRORS
    if positive:
        return None if astray else np.exp(ends).tolist()
    alike = np.abs(values - np.median(values)) <= 1e-9 * np.ptp(values)
    if astray and np.sum(~alike) <= 2:
        return None
    if max(values.min() - ends[0], ends[1] - values.max()) > np.ptp(values) / 2:
        ends = mean_interval(values[:, None])[:, 0]
    return ends.tolist()


def _mean_and_error(values: np.ndarray, positive: bool) -> tuple[np.ndarray, np.ndarray]:
    """The mean over the last axis and its standard error, or those of its logarithm."""
    mean = values.mean(-1)
    error = values.std(-1, ddof=1) / np.sqrt(values.shape[-1])
    if not positive:
        return mean, error
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.log(mean), error / mean


def mean_of_runs(values: np.ndarray) -> Summary:
    """One number a run, such as a final return, ``[seeds]``: ``mean`` and ``ci95``
    (`studentised_interval`) of what is finite, and ``per_seed``, None of what is not.
    """
    known = values[np.isfinite(values)]
    return {
        "mean": float(known.mean()) if len(known) else None,
        "ci95": studentised_interval(known),
        "per_seed": [_plain(value) for value in values],
    }


def mean_interval(values: np.ndarray, positive: bool = False) -> np.ndarray:
    """95% t intervals ``[2, n]`` of means over seeds, each of ``[seeds, n]``, or, of a ``positive``
    quantity, of their logarithms (delta method): bands of figures.
    """
    mean, error = _mean_and_error(values.T, positive)
    half = scipy.stats.t.ppf(0.975, len(values) - 1) * error
    ends = mean + np.stack([-half, half])
    return np.exp(ends) if positive else ends


def share_interval(hits: np.ndarray) -> np.ndarray:
    """95% intervals ``[2, n]`` of shares (exact, Clopper and Pearson), of bool ``[seeds, n]``."""
    count, total = len(hits), np.sum(hits, 0)
    with np.errstate(invalid="ignore"):
        low = scipy.stats.beta.ppf(0.025, total, count - total + 1)
        high = scipy.stats.beta.ppf(0.975, total + 1, count - total)
    return np.stack([np.where(total == 0, 0, low), np.where(total == count, 1, high)])


def ratio_of_means(numerator: np.ndarray, denominator: np.ndarray, paired: bool = False) -> Summary:
    """How two arms compare: the ratio of their means, by its logarithm's standard error (delta
    method) and Student's t, with Welch's degrees of freedom where the arms are unpaired.

    Args:
        numerator: ``[seeds]``, positive.
        denominator: ``[seeds]``, positive.
        paired: whether seed by seed they belong together, as in rows of a study.

    Returns:
        ``ratio`` (None where it is not known); ``ci95`` and ``ci90``; ``p``, that of a permutation
        test of the same statistic (9,999 draws, two-sided; of signs where paired); ``sooner``, see
        `sooner`. The intervals and p are None of five seeds or fewer, and where nothing varies.
    """
    one, other = (np.asarray(values, np.float64) for values in (numerator, denominator))
    said: Summary = {"ratio": None, "ci95": None, "ci90": None, "p": None, "sooner": None}
    if not (np.isfinite(one).all() and np.isfinite(other).all()):
        return said
    said["sooner"] = sooner(one, other)
    if min(one.mean(), other.mean()) <= 0:
        return said
    said["ratio"] = float(one.mean() / other.mean())
    if min(len(one), len(other)) <= FEW:
        return said
    log, error, freedom = (part[0] for part in _log_ratio(one[None], other[None], paired))
    if error <= 0:
        return said
    for name, level in (("ci95", 0.975), ("ci90", 0.95)):
        half = scipy.stats.t.ppf(level, freedom) * error
        said[name] = [float(np.exp(log - half)), float(np.exp(log + half))]
    generator = np.random.default_rng(0)
    if paired:
        swapped = generator.random((9999, len(one))) < 0.5
        draws = np.where(swapped, other, one), np.where(swapped, one, other)
    else:
        pooled = generator.permuted(np.tile(np.concatenate([one, other]), (9999, 1)), axis=1)
        draws = pooled[:, : len(one)], pooled[:, len(one) :]
    with np.errstate(divide="ignore", invalid="ignore"):
        logs, errors, _ = _log_ratio(*draws, paired)
        extreme = np.abs(logs / errors) >= abs(log / error) * (1 - 1e-9)
    said["p"] = float((1 + np.sum(extreme | (errors == 0))) / 10_000)
    return said


def sooner(one: np.ndarray, other: np.ndarray) -> float:
    """The share of pairs of runs, ``[seeds]`` each, in which one's is lower, equal ones half."""
    return float(np.mean((one < other[:, None]) + (one == other[:, None]) / 2))


def brunner_munzel(one: np.ndarray, other: np.ndarray) -> float | None:
    """p that either of two unpaired arms is as often the lower, ties one half (Brunner and Munzel
    2000, two-sided), from ``[seeds]`` of each, infinity where unsolved; not below the least that
    ranks can have, of arms wholly apart. None of five seeds or fewer, and where nothing varies.
    """
    one, other = np.split(scipy.stats.rankdata([*one, *other]), [len(one)])
    if min(len(one), len(other)) <= FEW or np.ptp([*one, *other]) == 0:
        return None
    least = 2 / math.comb(len(one) + len(other), len(one))
    apart = one.max() < other.min() or other.max() < one.min()
    return least if apart else max(float(scipy.stats.brunnermunzel(one, other).pvalue), least)


def holm(p_values: Sequence[float]) -> np.ndarray:
    """Holm's adjusted p-values (1979) of one family of tests, float64 ``[m]`` in the order of
    ``p_values [m]``: the k-th smallest of m counts m - k + 1 times, none less than a smaller one,
    and all are 1 at the most. `ValueError` where one is no probability.
    """
    p = np.asarray(p_values, np.float64)
    if p.ndim != 1 or not ((p >= 0) & (p <= 1)).all():
        raise ValueError(f"p_values are {p.tolist()}: give [tests], each between 0 and 1")
    order = np.argsort(p, kind="stable")
    adjusted = np.empty_like(p)
    adjusted[order] = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    return np.minimum(adjusted, 1)


def _log_ratio(one: np.ndarray, other: np.ndarray, paired: bool) -> tuple[np.ndarray, ...]:
    """Of last axes' means the ratio's logarithm, its standard error, its degrees of freedom."""
    means = one.mean(-1), other.mean(-1)
    log = np.log(means[0] / means[1])
    if paired:
        scaled = one / means[0][..., None] - other / means[1][..., None]
        count = one.shape[-1]
        return log, scaled.std(-1, ddof=1) / np.sqrt(count), np.full(log.shape, count - 1.0)
    parts = [values.var(-1, ddof=1) / (values.shape[-1] * np.square(mean))
             for values, mean in zip((one, other), means, strict=True)]  # fmt: skip
    total = parts[0] + parts[1]
    spread = sum(np.square(part) / (values.shape[-1] - 1)
                 for part, values in zip(parts, (one, other), strict=True))  # fmt: skip
    return log, np.sqrt(total), np.square(total) / np.where(spread > 0, spread, 1)


def share_of_sums(parts: np.ndarray, wholes: np.ndarray) -> Summary:
    """What the runs' parts, ``[seeds]``, which may be negative, are of their wholes, both summed:
    ``share`` and its ``ci95`` (linearised, Student's t), None of five runs or fewer.
    """
    share, count = parts.sum() / wholes.sum(), len(parts)
    said: Summary = {"share": float(share), "ci95": None}
    if count > FEW:
        rest = (parts - share * wholes) / wholes.mean()
        half = scipy.stats.t.ppf(0.975, count - 1) * rest.std(ddof=1) / np.sqrt(count)
        said["ci95"] = [float(share - half), float(share + half)]
    return said


def rank_correlation(left: np.ndarray, right: np.ndarray) -> tuple[float, float, float]:
    """Spearman's rank correlation of the means over seeds of two finite quantities, ``[settings,
    seeds]``, 0 where one is the same in every setting, and the ends of its 95% bootstrap interval.
    """

    def correlate(draws):
        ranks = [scipy.stats.rankdata(side[:, draws].mean(-1), axis=0) for side in (left, right)]
        one, other = (each - each.mean(0) for each in ranks)
        scale = np.sqrt(np.square(one).sum(0) * np.square(other).sum(0))
        return (one * other).sum(0) / np.where(scale > 0, scale, 1)

    seeds = left.shape[1]
    draws = np.random.default_rng(0).integers(0, seeds, (2000, seeds))
    low, high = np.percentile(correlate(draws), [2.5, 97.5])
    return float(correlate(np.arange(seeds)[None])[0]), float(low), float(high)


def _plain(value: Any) -> float | None:
    return float(value) if np.isfinite(value) else None
