"""Statistics against values worked out by hand."""

import json

import numpy as np
import pytest

from jaxdyna.statistics import (
    SolveRule,
    bootstrap_interval,
    episodes_to_solve,
    interquartile_mean,
    r_squared,
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


def test_interquartile_mean_drops_a_quarter_at_each_end():
    assert interquartile_mean(np.array([1.0, 100, 2, 3, 4, 5, 6, -50])) == 3.5
    assert interquartile_mean(np.array([1.0, 2, 3, 4, INF, 2, 3, 4])) == 3.0
    assert interquartile_mean(np.array([1.0, INF, INF, 2])) == INF


def test_unsolved_seeds_are_never_dropped():
    summary = summarise(np.array([100.0, 200, 300, INF]), at_least=1000)
    assert summary["per_seed"] == [100, 200, 300, None]
    assert (summary["solved"], summary["seeds"]) == (3, 4)
    assert summary["mean"] is None and summary["mean_at_least"] == 400
    assert summary["median"] == 250 and summary["iqm"] == 250
    assert summary["ci95"][0] >= 100 and summary["ci95"][1] is None
    json.dumps(summary, allow_nan=False)


def test_bootstrap_covers_the_true_mean_about_as_often_as_it_says():
    generator = np.random.default_rng(1)
    hits = 0
    for _ in range(200):
        low, high = bootstrap_interval(
            generator.normal(3, 2, 40), lambda rows: rows.mean(-1), resamples=500
        )
        hits += low <= 3 <= high
    assert 0.88 <= hits / 200 <= 0.985


def test_ratio_of_means():
    ratio = ratio_of_means(np.array([1.0, 3.0]), np.array([4.0, 4.0]))
    assert ratio["ratio"] == 0.5 and ratio["ci95"] == [0.25, 0.75]
    assert not ratio["bound"]
    assert ratio_of_means(np.array([1.0]), np.array([4.0]))["ci95"] == [None, None]
    assert ratio_of_means(np.array([1.0, INF]), np.array([4.0, 4.0]))["ratio"] is None


def test_ratio_to_an_arm_with_unsolved_seeds_is_an_upper_bound():
    ours, unsolved = np.array([1.0, 3.0]), np.array([4.0, INF])
    assert ratio_of_means(ours, unsolved)["ratio"] is None
    ratio = ratio_of_means(ours, unsolved, denominator_at_least=6.0)
    assert ratio["ratio"] == 0.4 and ratio["bound"]


def test_rank_correlation():
    error = np.array([[1.0, 1.2], [2.0, 2.2], [3.0, 3.1]])
    assert rank_correlation(error, 10 * error) == (1.0, 1.0, 1.0)
    assert rank_correlation(error, -error)[0] == -1.0
    tied = np.array([[1.0, 1.0], [3.0, 3.0], [3.0, 3.0]])
    assert rank_correlation(error, tied)[0] == rank_correlation(error[[0, 2, 1]], tied)[0]
    np.testing.assert_allclose(rank_correlation(error, tied)[0], np.sqrt(3) / 2)
    assert rank_correlation(error, np.ones((3, 2)))[0] == 0
    noise = np.array([[1.0, 9.0], [5.0, 5.0], [6.0, 2.0]])
    rank, low, high = rank_correlation(error, noise)
    assert -1 <= low <= rank <= high <= 1 and low < high


def test_r_squared_from_sums():
    target, predicted = np.array([1.0, 2, 3, 4]), np.array([1.0, 2, 3, 3])
    ours = r_squared(
        np.array([np.square(predicted - target).sum()]),
        np.array([target.sum()]), np.array([np.square(target).sum()]), np.float64(4),
    )  # fmt: skip
    assert ours == pytest.approx([1 - 1 / 5])
