"""The planning experiment: decisions timed and played, arms compared, command line."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdyna.envs import CartPole
from jaxdyna.experiments import planning, planning_budgets
from jaxdyna.experiments.planning_budgets import Contender, Ground

ENV = CartPole()
LEFT = Contender("left", "-", 0, lambda learned, obs, state, key: jnp.int32(learned))
UPRIGHT = Contender(
    "upright", "true", 1, lambda learned, obs, state, key: (state.theta > 0).astype(jnp.int32)
)


def ground(runs):
    learned = jnp.zeros(runs)
    params, key = ENV.default_params, jax.random.key(1)
    return Ground(
        "CartPole", ENV, params, learned, 30, lambda start, params: jnp.float32(30), key, 3, 4
    )


@pytest.mark.parametrize("runs", [1, 2])
def test_shares_are_of_what_could_be_had_in_the_same_episodes(runs):
    rows = planning_budgets.measure(ground(runs), [LEFT, UPRIGHT], lambda said: None)
    for row in rows:
        returns = np.array(row["returns"])
        assert returns.shape == (runs, 3) and row["ms"] > 0 and row["ms_in_batch"] > 0
        np.testing.assert_allclose(row["share"], returns.sum() / (30 * returns.size))
        low, high = row["share_ci95"]
        assert low <= row["share"] <= high
    falls, stays = rows
    assert 0.2 < falls["share"] < 0.4 < stays["share"]
    assert runs == 1 or falls["returns"][0] != falls["returns"][1]


def test_everybody_decides_by_what_each_run_has_learned():
    both = ground(2)._replace(learned=jnp.arange(2))  # the first pushes left, the second right
    returns = planning_budgets.play(both, LEFT.act)
    other = planning_budgets.play(both._replace(learned=1 - jnp.arange(2)), LEFT.act)
    assert (returns[0] != other[0]).any() and (returns[1] != other[1]).any()


TINY = ["--quick", "--seeds", "2", "--episodes", "6", "--grounds", "cartpole", "--sizes.runs", "2",
        "1", "--sizes.episodes", "4", "4", "--sizes.played", "1", "1", "--sizes.candidates", "4",
        "--contenders", "policy", "MPC (learned world)", "--arms", "dyna", "mpc_init"]  # fmt: skip


def test_it_leaves_tables_figures_and_an_answer(tmp_path, monkeypatch):
    arguments = [*TINY, "--out", str(tmp_path)]
    assert planning.main(arguments) == 0
    results = json.loads((tmp_path / "results.json").read_text())
    assert [row["who"] for row in results["budgets"]] == ["policy", "MPC"]
    assert set(results["arms"]) == {"dyna", "mpc_init"}
    text = (tmp_path / "report.md").read_text()
    assert "times** as long" in text and "0 of 2 runs of `mpc_init` solve" in text
    for figure in ("decisions", "solved", "variants"):
        assert (tmp_path / f"{figure}.png").exists()

    def measured_again(*_):
        raise AssertionError

    monkeypatch.setattr(planning, "budgets", measured_again)
    assert planning.main([*arguments, "--resume"]) == 0
    again = json.loads((tmp_path / "results.json").read_text())
    assert again["budgets"] == results["budgets"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--contenders", "policy", "chess"], "there is no chess"),
        (["--contenders", "MPC (true world)"], "add it"),
        (["--grounds", "moon"], "there is no moon"),
        (["--sizes.played", "0", "1"], "at least 1"),
        (["--arms", "nobody"], "there is no nobody"),
    ],
)
def test_bad_input_is_explained(arguments, said, capsys):
    with pytest.raises(SystemExit) as stop:
        planning.main(["--quick", *arguments])
    assert stop.value.code == 2 and said in " ".join(capsys.readouterr().err.split())
