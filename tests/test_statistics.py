"""Statistics against values worked out by hand."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from jaxdyna.experiments.report.summaries import describe_arm
from jaxdyna.experiments.study.accuracy import Measure, describe
from jaxdyna.statistics import (
    SolveRule,
    bootstrap_interval,
    episodes_to_solve,
    mean_interval,
    median_interval,
    rank_correlation,
    ratio_of_means,
    steps_before,
    summarise,
)

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
    runs = np.array([1.0, 3.0])
    np.testing.assert_allclose(ratio_of_means(runs, runs)["ci95"], [1 / 3, 3])


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
