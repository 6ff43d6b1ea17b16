"""Statistics against values worked out by hand, plain loops and SciPy."""

import json
from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from scipy.stats import binom, spearmanr

from jaxdyna.experiments.report.summaries import describe_arm
from jaxdyna.experiments.study.accuracy import Measure, describe
from jaxdyna.statistics import (
    SolveRule,
    bootstrap_interval,
    episodes_to_solve,
    mean_interval,
    mean_of_runs,
    median_interval,
    rank_correlation,
    ratio_of_means,
    steps_before,
    summarise,
)

NUMBERS = st.floats(-1e6, 1e6, allow_subnormal=False)
NEEDED = st.one_of(st.integers(1, 5000).map(float), st.just(np.inf))
"""Episodes that a run needed."""
RULE = SolveRule(window=3, threshold=5.0)
INF = np.inf


def test_solving_window_by_hand():
    returns = np.array(
        [
            [5, 5, 5, 0, 0, 0],  # the very first window
            [0, 0, 5, 4, 6, 0],  # episodes 3, 4, 5
            [9, 9, 0, 0, 0, 0],  # 9 + 9 + 0 is enough
            [4.9, 4.9, 5.1, 4.9, 4.9, 5.1],  # never
        ]
    )
    np.testing.assert_array_equal(episodes_to_solve(returns, RULE), [3, 5, 3, INF])
    assert episodes_to_solve(returns[:, :2], RULE).tolist() == [INF] * 4
    padded = np.where(np.arange(6) < 4, returns, np.nan)
    np.testing.assert_array_equal(episodes_to_solve(padded, RULE), [3, INF, 3, INF])


def test_steps_before_the_window():
    lengths = np.array([[10, 20, 30, 40], [1, 2, 3, 4], [5, 5, 5, 5]])
    np.testing.assert_array_equal(steps_before(lengths, np.array([1, 3, INF])), [0, 3, INF])


def test_unsolved_seeds_are_never_dropped():
    summary = summarise(np.array([100.0, 200, 300, INF, 250, 350, 400]), at_least=1000)
    assert summary["per_seed"] == [100, 200, 300, None, 250, 350, 400]
    assert (summary["solved"], summary["seeds"]) == (6, 7)
    assert summary["mean"] is None and summary["median"] == 300
    assert summary["budget"] == 1000
    np.testing.assert_allclose(summary["restricted_mean"], 2600 / 7)
    assert summary["ci95"][0] >= 100 and summary["ci95"][1] is None
    assert summary["median_ci95"] == [100, None]
    json.dumps(summary, allow_nan=False)


def test_where_there_is_no_honest_interval_there_is_none():
    few, alike = summarise(np.arange(5.0)), summarise(np.full(8, 3.0))
    assert few["ci95"] is few["median_ci95"] is alike["ci95"] is None
    assert few["budget"] is few["restricted_mean"] is None and few["mean"] == 2


def test_a_medians_interval_is_exact_by_ranks():
    ends = {count: median_interval(np.arange(1.0, count + 1)) for count in (6, 10, 20, 100, 1000)}
    assert ends == {6: [1, 6], 10: [2, 9], 20: [6, 15], 100: [40, 61], 1000: [469, 532]}


def test_an_arms_figures_are_those_of_each_runs_own_episodes():
    """A run that ended after three episodes, one that played on and did not solve."""
    returns = np.array([[1.0, 6, 6, np.nan, np.nan], [5.0, 5, 0, 0, 2]])
    curves = {"real_return": returns, "real_length": np.where(np.isnan(returns), np.nan, 10.0)}
    arm = describe_arm(curves, SolveRule(2, 6.0), budget=5)
    assert arm["episodes_to_solve"]["per_seed"] == [3, None]
    assert arm["episodes_to_solve"]["restricted_mean"] == 4
    assert arm["first_solved"]["per_seed"] == [2, None]
    assert arm["real_steps_to_solve"]["per_seed"] == [10, None]
    assert arm["final_return"]["per_seed"] == [6, 1] and arm["final_return"]["solved"] == 1
    assert arm["episodes_played"]["per_seed"] == [3, 5] and arm["solved_and_held"] == 0


def test_bootstrap_covers_the_true_mean_about_as_often_as_it_says():
    generator = np.random.default_rng(1)
    hits = 0
    for _ in range(200):
        low, high = bootstrap_interval(
            generator.normal(3, 2, 40), lambda rows: rows.mean(-1), resamples=500
        )
        hits += low <= 3 <= high
    assert 0.88 <= hits / 200 <= 0.985


def test_a_bootstrap_interval_is_that_of_the_binomial():
    """Half of 100 runs are 1: their resampled mean is between 0.40 and 0.60 in 95 of 100 cases,
    and between 0.42 and 0.58 in 90.
    """
    runs = np.repeat([0.0, 1.0], 50)
    np.testing.assert_allclose(
        bootstrap_interval(runs, lambda rows: rows.mean(-1)), [0.4, 0.6], atol=0.011
    )
    np.testing.assert_allclose(mean_interval(runs[:, None])[:, 0], [0.4, 0.6], atol=0.011)


def test_solved_and_held_and_first_at_the_threshold_by_hand():
    """Run 0 solves, and falls off again but for its last episodes; runs 1 and 2 hold, the last one
    on average.
    """
    returns = np.zeros((3, 60))
    returns[0, 3:9] = returns[0, -3:] = 6
    returns[1, 8:] = 8
    returns[2, 1::2] = 12
    curves = {"real_return": returns, "real_length": np.ones((3, 60))}
    arm = describe_arm(curves, SolveRule(3, 6.0), budget=60)
    assert arm["episodes_to_solve"]["per_seed"] == [6, 11, 4]
    assert arm["first_at_threshold"]["per_seed"] == [4, 9, 2]
    assert arm["solved_and_held"] == 2
    never = describe_arm(curves, SolveRule(3, 8.5), budget=60)
    assert never["first_at_threshold"]["per_seed"] == [None, None, 2]
    longer = describe_arm(curves, SolveRule(61, 6.0), budget=60)  # held, but never solved
    assert longer["solved_and_held"] == longer["episodes_to_solve"]["solved"] == 0


def test_a_models_error_is_of_the_episodes_with_dreams():
    """N = 3 and three episodes: 3, 4 and 5; a run that ended after the fourth has two."""
    error = np.array([[9.0, 9, 1, 2, 6, 9], [9.0, 9, 1, 2, 7, 9]])
    returns = np.where(np.arange(6) < [[6], [4]], 1.0, np.nan)
    options = SimpleNamespace(dyna=SimpleNamespace(num_real_first=3))
    said = describe(Measure("error", 3, "", "", (), "-"))
    assert said(options, {"error": error, "real_return": returns}) == {"model_error": [3, 1.5]}


def test_the_runs_of_a_ratio_are_resampled_each_arm_on_its_own():
    """In pairs the ratio of two equal arms would always be 1."""
    runs = np.array([1.0, 3.0] * 3)
    low, high = ratio_of_means(runs, runs)["ci95"]
    assert low < 0.8 and high > 1.25


def test_ratio_of_means():
    ratio = ratio_of_means(np.array([1.0, 3.0] * 3), np.full(8, 4.0))
    assert ratio["ratio"] == 0.5 and 0.25 < ratio["ci95"][0] < 0.5 < ratio["ci95"][1] < 0.75
    assert not ratio["bound"]
    few = ratio_of_means(np.array([1.0, 3.0]), np.full(8, 4.0))
    assert few["ratio"] == 0.5 and few["ci95"] == [None, None]
    assert ratio_of_means(np.array([1.0, INF]), np.array([4.0, 4.0]))["ratio"] is None


def test_ratio_to_an_arm_with_unsolved_seeds_is_an_upper_bound():
    ours, unsolved = np.array([1.0, 3.0]), np.array([4.0, INF])
    assert ratio_of_means(ours, unsolved)["ratio"] is None
    ratio = ratio_of_means(ours, unsolved, denominator_at_least=6.0)
    assert ratio["ratio"] == 0.4 and ratio["bound"]


def test_rank_correlation():
    error = np.array([[1.0, 1.2], [2.0, 2.2], [3.0, 3.1]])
    assert rank_correlation(error, 10 * error) == pytest.approx((1, 1, 1))
    assert rank_correlation(error, -error)[0] == pytest.approx(-1)
    tied = np.array([[1.0, 1.0], [3.0, 3.0], [3.0, 3.0]])
    assert rank_correlation(error, tied)[0] == rank_correlation(error[[0, 2, 1]], tied)[0]
    np.testing.assert_allclose(rank_correlation(error, tied)[0], np.sqrt(3) / 2)
    assert rank_correlation(error, np.ones((3, 2)))[0] == 0
    noise = np.array([[1.0, 9.0], [5.0, 5.0], [6.0, 2.0]])
    rank, low, high = rank_correlation(error, noise)
    assert -1 <= low <= rank <= high <= 1 and low < high


@st.composite
def played(draw):
    """Returns of a few runs, NaN after the end of each, and a share of which there is a curve."""
    unit = draw(st.sampled_from([1, 1 / 8, 0.1, 1e6]))
    ends = draw(st.lists(st.integers(0, 12), min_size=1, max_size=4))
    whole = st.lists(st.integers(-3, 3), min_size=12, max_size=12)
    returns = unit * np.array([draw(whole) for _ in ends], float)
    there = np.arange(12) < np.array(ends)[:, None]
    threshold = unit * draw(st.integers(-3, 3)) * draw(st.sampled_from([1, 0.5]))
    return np.where(there, returns, np.nan), SolveRule(draw(st.integers(1, 14)), threshold)


@given(played=played())
@example(played=(np.full((1, 50), 0.1), SolveRule(50, 0.1)))
@settings(max_examples=100)
def test_solving_and_holding_agree_with_plain_loops(played):
    """Any window and threshold, runs of any length; sums are exact there."""
    returns, rule = played
    lengths = np.where(np.isnan(returns), np.nan, 1.0 + np.arange(returns.shape[1]))
    least = Fraction(rule.threshold) - Fraction(1e-9)
    expected, held = [], 0
    for run in returns:
        own = [Fraction(value) for value in run[~np.isnan(run)]]
        ends = range(rule.window, len(own) + 1)
        means = {end: sum(own[end - rule.window : end]) / rule.window for end in ends}
        expected.append(next((end for end, mean in means.items() if mean >= least), np.inf))
        last = own[-50:]
        held += expected[-1] < np.inf and sum(last) / len(last) >= least
    assert episodes_to_solve(returns, rule).tolist() == expected
    if not np.isnan(returns[:, 0]).any():
        curves = {"real_return": returns, "real_length": lengths}
        arm = describe_arm(curves, rule, budget=returns.shape[1])
        assert arm["solved_and_held"] == held
        before = [sum(range(1, int(end) - rule.window + 1)) if np.isfinite(end) else None
                  for end in expected]  # fmt: skip
        assert arm["real_steps_to_solve"]["per_seed"] == before


@given(values=st.lists(NEEDED, min_size=1, max_size=12), budget=st.integers(1, 9999))
@settings(max_examples=60)
def test_what_runs_say_together_lies_within_them(values, budget):
    values = np.array(values)
    said, known = summarise(values, at_least=budget), values[np.isfinite(values)]
    assert said["per_seed"] == [value if np.isfinite(value) else None for value in values]
    assert said["mean"] == (pytest.approx(values.mean()) if len(known) == len(values) else None)
    assert said["solved"] == len(known)
    at_their_bound = [*known, *[budget] * (len(values) - len(known))]
    assert said["restricted_mean"] == pytest.approx(np.mean(at_their_bound))
    middle = said["median"] or np.inf
    for interval in (said["ci95"], said["median_ci95"]):
        low, high = (end or np.inf for end in interval or (values.min(), values.max()))
        assert values.min() <= low <= high <= values.max()
    assert low <= middle <= high
    turned = summarise(values[::-1], at_least=budget)
    same = ("mean", "median", "median_ci95", "solved")
    assert [turned[name] for name in same] == [said[name] for name in same]


def test_a_medians_interval_covers_it_as_often_as_it_says_and_no_wider():
    """Its ranks, for any number of runs, by the binomial's own sums."""
    for count in range(1, 60):
        interval = median_interval(np.arange(1.0, count + 1))
        covers = [binom.cdf(count - rank, count, 0.5) - binom.cdf(rank - 1, count, 0.5)
                  for rank in range(1, count // 2 + 1)]  # fmt: skip
        good = [rank for rank, share in enumerate(covers, start=1) if share >= 0.95]
        assert interval == ([good[-1], count + 1 - good[-1]] if good else None), count


@given(
    left=st.lists(NEEDED, min_size=1, max_size=8), right=st.lists(NEEDED, min_size=1, max_size=8),
    bound=st.integers(5000, 9999), data=st.data(),
)  # fmt: skip
@settings(max_examples=60)
def test_a_ratio_turns_over_with_its_arms(left, right, bound, data):
    """And is the same in whatever order the runs come."""
    left, right = np.array(left), np.array(right)
    known = np.isfinite(left).all()
    ratio = ratio_of_means(left, right, bound)
    assert ratio["bound"] == (not np.isfinite(right).all())
    assert (ratio["ratio"] is None) == (not known)
    filled = np.where(np.isfinite(right), right, bound)
    back = ratio_of_means(filled, left)
    if known:
        assert ratio["ratio"] == pytest.approx(left.mean() / filled.mean())
        assert ratio["ratio"] * back["ratio"] == pytest.approx(1)
        turned = [data.draw(st.permutations(arm.tolist())) for arm in (left, right)]
        again = ratio_of_means(*map(np.array, turned), bound)
        assert again["ratio"] == pytest.approx(ratio["ratio"])
        low, high = ratio["ci95"]
        if low is not None:
            most = left.max() / filled.min()
            assert left.min() / filled.max() * (1 - 1e-9) <= low <= high <= most * (1 + 1e-9)


@given(
    values=st.lists(st.lists(NUMBERS, min_size=4, max_size=4), min_size=3, max_size=6),
    missing=st.integers(0, 3),
)
@settings(max_examples=40)
def test_correlation_and_means_agree_with_scipy_and_numpy(values, missing):
    left = np.array(values)
    right = np.roll(left, 1, axis=0)[:, ::-1]
    means = left.mean(1), right.mean(1)
    assume(min(map(np.ptp, means)) > 0)
    rank, low, high = rank_correlation(left, right)
    assert rank == pytest.approx(spearmanr(*means).statistic)
    assert -1 <= low <= high <= 1
    ends = mean_interval(left)
    slack = 1e-9 * np.abs(left).max()
    assert (left.min(0) - slack <= ends[0]).all() and (ends[1] <= left.max(0) + slack).all()
    some = left[:, 0].copy()
    some[:missing] = np.nan
    said = mean_of_runs(some)
    assert said["mean"] == (pytest.approx(np.nanmean(some)) if missing < len(some) else None)
    assert said["per_seed"] == [None if np.isnan(value) else value for value in some]


def test_what_is_not_finite_spoils_its_own_windows_only():
    """A broken return neither solves a run nor keeps it from being solved for ever."""
    rule, steady = SolveRule(2, 1.0), [0.0, 0.0, 1.0, 1.0, 0.0]
    for broken in (np.nan, np.inf, -np.inf):
        found = episodes_to_solve(np.array([[broken, *steady], [0.0, broken, 0, 0, 0, 0]]), rule)
        np.testing.assert_array_equal(found, [5, np.inf])
