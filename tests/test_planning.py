"""The planning experiment: decisions timed and played, arms compared, command line."""

import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny
from parts import assert_same

from jaxdyna.dyna import make_init, make_train
from jaxdyna.envs import CartPole, Maze
from jaxdyna.experiments import (
    maze_train,
    planning,
    planning_budgets,
    planning_claim,
    planning_grounds,
)
from jaxdyna.experiments.cartpole import make_arms
from jaxdyna.experiments.cartpole_options import LEAN
from jaxdyna.experiments.maze_train_options import LEAN as MAZE
from jaxdyna.experiments.planning_budgets import Contender, Ground
from jaxdyna.experiments.planning_grounds import maze_contenders
from jaxdyna.planners import ShootingConfig, solve_maze

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


FEW = ["--contenders", "policy", "MPC (learned world)", "--arms", "dyna", "mpc_init"]


def test_it_leaves_tables_figures_and_an_answer_and_measures_decisions_once(tmp_path, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    def measured_again(*_):
        raise AssertionError

    arguments = [*tiny.PLANNING, *FEW, "--out", str(tmp_path)]
    with monkeypatch.context() as patch:
        patch.setattr(planning.Session, "_play", interrupted)
        assert planning.main(arguments) == 130
    monkeypatch.setattr(planning, "budgets", measured_again)
    assert planning.main([*arguments, "--resume"]) == 0
    results = json.loads((tmp_path / "results.json").read_text())
    timing = results["timing"]
    assert 0 < timing["prelude_s"] < timing["total_s"]
    assert [row["who"] for row in results["budgets"]] == ["policy", "MPC"]
    assert set(results["arms"]) == {"dyna", "mpc_init"}
    text = (tmp_path / "report.md").read_text()
    assert "times** as long" in text and "in the same episodes" in text
    for figure in ("decisions", "solved", "variants"):
        assert (tmp_path / f"{figure}.png").exists()
    assert planning.main([*arguments, "--resume"]) == 0  # with everything finished
    again = json.loads((tmp_path / "results.json").read_text())
    assert again["budgets"] == results["budgets"]
    assert again["timing"]["prelude_s"] == timing["prelude_s"]


def test_who_imitates_dreams_later_or_stays_as_it_is():
    def learned(name, episodes):
        options = replace(
            LEAN, arms=(name,), episodes=episodes, real_first=2, shown_episodes=2, model_updates=2,
            mpc=ShootingConfig(2, 4), dream_episodes=2,
        )  # fmt: skip
        arm = make_arms(options)[name]
        train = jax.jit(make_train(arm.dyna._replace(diagnose=None), arm.config))
        state, metrics = train(jax.random.key(0), arm.hparams)
        return state.agent, metrics

    shown, _ = learned("mpc_init", 4)
    dreaming, metrics = learned("mpc_init_dyna", 4)  # of which only the last dream counts
    assert np.isfinite(metrics["fake_return"][1:]).all()
    assert_same(shown.imitating, dreaming.imitating)
    assert bool(shown.waiting) and not bool(dreaming.waiting)
    clone, metrics = learned("mpc_clone", 6)
    assert bool(clone.waiting)  # what imitates acts, and nothing comes after it
    np.testing.assert_array_equal(metrics["agent_loss"][jnp.array([0, 1, 4, 5])], 0)
    assert_same(clone.imitating, shown.imitating)


def test_the_oracle_plays_best_in_the_maze_and_values_are_asked_for():
    sizes = planning_grounds.Sizes(candidates=(4,), simulations=(4,), far_candidates=(256,))
    options = replace(MAZE, episodes=1, real_first=1, size=2, obstacles=1, steps=8)
    arm = maze_train.make_arms(options)["dyna"]
    state = jax.jit(jax.vmap(make_init(arm.dyna, arm.config), (0, None)))(
        jax.random.split(jax.random.key(0), 1), arm.hparams
    )

    def best(start, params):
        return solve_maze(Maze(2, 1), start.env, params, 8).best_return

    here = Ground("Maze", arm.dyna.env, arm.hparams.env, replace(state, key=None), 8, best,
                  jax.random.key(1), 6, 2)  # fmt: skip
    contenders = {who.label: who for who in maze_contenders(arm, options, sizes)}
    assert set(contenders) <= set(planning.CONTENDERS)
    played = ["policy", "MPC to the goal (true world)", "MCTS, learned values (learned world)"]
    share = {
        name: planning_budgets.play(here, contenders[name].act).sum()
        / planning_budgets.best_returns(here).sum()
        for name in played
    }
    assert share[played[1]] > max(0.9, share["policy"]) and np.isfinite(share[played[2]])


def arm_of(returns, first):
    unsolved = [value for value in first if value is not None]
    return {
        "later_return": returns,
        "first_solved": {"per_seed": first, "solved": len(unsolved), "seeds": len(first)},
    }


def test_the_claim_in_numbers_by_hand():
    arms = {
        "dyna": arm_of([200.0, 180.0], [1, 2]),
        "mpc_clone": arm_of([190.0, 170.0], [3, None]),
        "dyna, few": arm_of([190.0, 170.0], [5, 6]),
        "mpc_clone, few": arm_of([100.0, 160.0], [None, None]),
        "mpc": arm_of([1.0, 1.0], [None, None]),
    }
    first, more = planning_claim.sentences({"arms": arms})
    assert "`dyna` 10 (10 to 10)" in first and "`mpc_clone` 50 (10 to 90)" in first
    assert "`mpc_clone` loses **+40 (+0 to +80)** more" in more.replace("(0 to 80)", "(+0 to +80)")
    text = "\n".join(planning_claim.answer({"arms": arms}))
    assert "| mpc_clone, few | 0/2 | -1.00 (-1.00 to -1.00) | 130 | -50 " in text
    assert "mpc |" not in text.replace("mpc_clone", "")
    del arms["dyna, few"]
    assert planning_claim.sentences({"arms": arms}) == []


def test_a_row_with_unsolved_runs_leaves_a_lower_bound():
    report = planning.PlanningReport(planning.PLANNING, replace(planning.FULL, episodes=150))

    def solve(first):
        return {"first_solved": arm_of([0.0], first)["first_solved"]}

    assert report.limit == 52
    assert report._difference(solve([12, 14]), solve([2, 4])) == "+10 (10 to 10)"
    assert report._difference(solve([12, None]), solve([2, 2])) == "≥ +30"
    assert report._difference(solve([12, 14]), solve([2, None])) == "-"


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
