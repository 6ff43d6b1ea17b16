"""Grids in which arms are tuned: their rows, and what is said of the best."""

from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest

from jaxdyna.experiments import cartpole, maze, pong
from jaxdyna.experiments.report.rows import edge_of_grid, ranking
from jaxdyna.experiments.report.summaries import describe_arm
from jaxdyna.fields import value_at
from jaxdyna.statistics import SolveRule

WORLDS = {"cartpole": cartpole, "maze": maze, "pong": pong}
STUDIES = {
    f"{world} {part.name}": part
    for world, module in WORLDS.items()
    for part in module.PARTS
    if part.name in ("baselines", "dyna_grid")
}
NAMES = [", ".join(row) for row in product(("ratio 1", "ratio 2", "ratio 4"), ("plain", "resets"),
                                           ("1-step", "3-step", "5-step"))]  # fmt: skip


def setups(study):
    """The settings of every row, by its name."""
    options = study.experiment().presets["tuned"].resolved()
    return {name: study.setup(options, row) for name, row in study.rows(options).items()}


@pytest.mark.parametrize("name", STUDIES)
def test_as_many_settings_of_either_arm_all_different(name):
    rows = setups(STUDIES[name])
    assert len(rows) == len(set(rows.values())) == 32


@pytest.mark.parametrize(
    ("world", "updates", "steps"), [("maze", 1000, 20_000), ("pong", 1000, 10_000)]
)
def test_a_ratio_is_updates_for_each_real_step(world, updates, steps):
    rows = setups(STUDIES[f"{world} baselines"])
    best = rows["ratio 5, resets, rate 0.001, 3-step"]
    assert (best.agent.updates, best.agent.reset_every, best.agent.n_step) == (
        updates,
        5 * steps,
        3,
    )
    assert best.agent.updates == 5 * best.steps and best.hparams.agent.learning_rate == 0.001
    assert rows["ratio 0.5, plain, rate 0.0003, 1-step" if world == "pong" else
                "ratio 0.25, plain, rate 0.0003, 1-step"].agent.reset_every == 0  # fmt: skip


def test_a_ratio_of_episodes_that_differ_in_length():
    rows = setups(STUDIES["cartpole baselines"])
    one = rows["ratio 0.5, resets, rate 0.001, 1-step"]
    assert (one.dqn.updates, one.dqn.updates_per_step, one.dqn.reset_every) == (0, 0.5, 20_000)
    assert value_at(one, "dqn_hparams.learning_rate") == 0.001


@pytest.mark.parametrize(
    ("winner", "edges"),
    [
        ("ratio 2, plain, 3-step", []),
        ("ratio 2, resets, 1-step", []),  # nothing is shorter
        ("ratio 1, resets, 3-step", ["ratio 1"]),
        ("ratio 4, plain, 5-step", ["ratio 4", "5-step"]),
        ("ratio 2, plain, 5-step@discount=0.9", ["5-step"]),
    ],
)
def test_a_winner_at_the_edge_of_its_grid_is_none(winner, edges):
    assert edge_of_grid(NAMES, winner) == edges
    one_rate = [f"{name}, rate 0.1" for name in NAMES]
    name, _, _ = winner.partition("@")
    assert edge_of_grid(one_rate, f"{name}, rate 0.1") == edges


def ranked(out, **solved_at):
    """The section of rows whose two runs solved then, of at most 9 episodes."""
    arms = {}
    for row, ends in solved_at.items():
        returns = np.array([[float(n + 1 >= end) for n in range(9)] for end in ends])
        curves = {"real_return": returns, "real_length": np.ones_like(returns)}
        arms[f"ratio {row[1:]}, plain, 3-step"] = describe_arm(curves, SolveRule(1, 1.0), 9)
    results = {
        "arms": arms, "runs": {"seeds": [0, 1]}, "config": {"episodes": 9},
        "timing": {"arms": {name: {"run_s": 1800.0} for name in arms}}, "device": {"cpu_cores": 2},
    }  # fmt: skip
    record = SimpleNamespace(options=SimpleNamespace(episodes=9, seed=0), results=results, out=out)
    return ranking(lambda options: {name: {} for name in NAMES})(record)


def test_rows_stand_in_the_order_of_their_restricted_means(tmp_path):
    text = ranked(tmp_path, r1=(3, 99), r2=(4, 4), r4=(9, 9))
    lines = [line.split(" | ")[0] for line in text.splitlines() if line.startswith("| ratio")]
    assert lines == [f"| ratio {ratio}, plain, 3-step" for ratio in (2, 1, 4)]
    assert "**ratio 2, plain, 3-step** has the lowest." in text and "edge" not in text
    assert "3 rows, of a grid of 18" in text and "1.50 hours of 2 cores" in text
    assert "edge of the grid (ratio 1)" in ranked(tmp_path, r1=(3, 3), r2=(4, 4))
    assert "no winner" in ranked(tmp_path, r1=(99, 99), r2=(99, 99))
