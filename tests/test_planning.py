"""The planning experiment: decisions timed and played, arms compared, command line."""

import json
import re
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny
from parts import assert_same

from jaxdyna.envs import CartPole, Maze
from jaxdyna.experiments import planning
from jaxdyna.experiments.cartpole import CARTPOLE
from jaxdyna.experiments.cartpole.arms import arms as cartpole_arms, parts as cartpole_parts
from jaxdyna.experiments.engine import main
from jaxdyna.experiments.engine.session import Session
from jaxdyna.experiments.maze import MAZE
from jaxdyna.experiments.maze.arms import agent_of, model_of, parts
from jaxdyna.experiments.planning import budgets, deciding, grounds, report
from jaxdyna.experiments.planning.budgets import Contender, Ground
from jaxdyna.experiments.report.rows import _ratio
from jaxdyna.fields import changed
from jaxdyna.planners import ShootingConfig, solve_maze
from jaxdyna.statistics import summarise
from jaxdyna.sweep import over_runs

PROG = "python -m jaxdyna.experiments.planning"


def play(*arguments):
    return main(*planning.PARTS, argv=arguments, prog=PROG)


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


@pytest.mark.parametrize("runs", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_shares_are_of_what_could_be_had_in_the_same_episodes(runs):
    rows = budgets.measure(ground(runs), [LEFT, UPRIGHT], lambda said: None)
    for row in rows:
        returns = np.array(row["returns"])
        assert returns.shape == (runs, 3) and row["ms"] > 0 and row["ms_in_batch"] > 0
        np.testing.assert_allclose(row["share"], returns.sum() / (30 * returns.size))
        assert (row["share_ci95"] is None) == (runs == 1)  # of two runs it is over the episodes
    falls, stays = rows
    assert 0.2 < falls["share"] < 0.4 < stays["share"]
    assert runs == 1 or falls["returns"][0] != falls["returns"][1]


def test_everybody_decides_by_what_each_run_has_learned():
    both = ground(2)._replace(learned=jnp.arange(2))  # the first pushes left, the second right
    returns, starts = budgets.play(both, LEFT.act)
    other, same = budgets.play(both._replace(learned=1 - jnp.arange(2)), LEFT.act)
    assert_same(starts, same)
    assert (returns[0] != other[0]).any() and (returns[1] != other[1]).any()


def test_who_decides_in_cartpole():
    options, sizes = CARTPOLE.presets["lean"].resolved(), grounds.Sizes(simulations=(4,))
    found = grounds.cartpole_contenders(cartpole_parts(options), options, sizes)
    assert [(one.who, one.world, one.steps) for one in found] == [
        ("policy", "-", 0), ("MPC", "true", 8 * 30), ("MPC", "learned", 8 * 30),
        ("MPC", "true", 32 * 30), ("MPC", "learned", 32 * 30),
        ("MCTS", "true", 4 * 21), ("MCTS", "learned", 4 * 21),
    ]  # fmt: skip


@pytest.mark.slow  # `.ci/run` plays it by its command
def test_it_leaves_tables_figures_and_an_answer_and_measures_decisions_once(tmp_path, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    def measured_again(*_):
        raise AssertionError

    def simple(key, sizes):
        yield ground(2), [LEFT._replace(who="policy"), UPRIGHT._replace(who="MPC")]

    arguments = [*tiny.PLANNING, "--arms", "model_free", "--out", str(tmp_path)]
    with monkeypatch.context() as patch:
        patch.setattr(Session, "_play", interrupted)
        patch.setitem(deciding.GROUNDS, "cartpole", simple)
        assert play(*arguments) == 130
    monkeypatch.setattr(deciding, "measure", measured_again)
    assert play(*arguments, "--resume") == 0
    results = json.loads((tmp_path / "results.json").read_text())
    assert [row["label"] for row in results["budgets"]] == ["policy", "MPC (true world)"]
    assert set(results["arms"]) == {"model_free"}
    text = (tmp_path / "report.md").read_text()
    assert "times the policy's" in text and "in the same episodes" in text
    assert (tmp_path / "decisions.png").exists()  # the others need arms that differ
    assert play(*arguments, "--resume") == 0  # with everything finished
    again = json.loads((tmp_path / "results.json").read_text())
    assert again["budgets"] == results["budgets"]


@pytest.mark.slow  # `.ci/run` plays mpc_init by its command
def test_who_imitates_goes_on_alone_dreams_later_or_stays_as_it_is():
    few = {"dyna.num_real_first": 2, "shown_episodes": 2, "dyna.model_updates": 2, "episodes": 6,
           "mpc": ShootingConfig(2, 4), "dyna.dream_episodes": 2}  # fmt: skip
    made = cartpole_arms(changed(CARTPOLE.presets["lean"], few).resolved(), judged=False)
    alone, dreaming, clone = (made[name]() for name in ("mpc_init", "mpc_init_dyna", "mpc_clone"))

    def whole(arm, key):
        def episode(state, number):
            state, metrics = arm.work.step(state, None, number, arm.hparams)
            return state, (state.agent, metrics)

        return jax.lax.scan(episode, arm.work.init(key, arm.hparams), jnp.arange(arm.units))[1]

    def played(arm):  # as one run: the checker takes keys for used that are scanned and vmapped
        return over_runs(partial(whole, arm), 1), jax.random.key(0)[None]

    assert "fake_return" not in jax.eval_shape(*played(alone))[1]
    assert "fake_return" in jax.eval_shape(*played(dreaming))[1]
    assert dreaming.hparams.num_real_first == 4 > alone.hparams.num_real_first
    run, key = played(clone)
    agents, metrics = jax.tree.map(lambda leaf: leaf[0], jax.jit(run)(key))
    np.testing.assert_array_equal(
        metrics["agent_loss"] > 0, [False, False, True, True] + 2 * [False]
    )
    after, last = (jax.tree.map(lambda leaf, at=at: leaf[at], agents) for at in (3, 5))
    assert bool(last.waiting)  # what imitates acts, and nothing comes after it
    assert_same(after, last)


@pytest.mark.slow
def test_the_optimal_plan_plays_best_in_the_maze_and_values_are_asked_for():
    sizes = grounds.Sizes(candidates=(4,), simulations=(4,), far_candidates=(256,))
    small = {"episodes": 1, "dyna.num_real_first": 1, "size": 2, "obstacles": 1, "steps": 8}
    options = changed(MAZE.presets["lean"], small).resolved()
    dyna = parts(Maze(2, 1), agent_of(options), model_of(options))
    work = MAZE.arms(options)["dyna"]().work
    state = jax.jit(work.init)(jax.random.key(0), options.hparams)
    learned = jax.tree.map(lambda leaf: leaf[None], replace(state, key=None))

    def best(start, params):
        return solve_maze(Maze(2, 1), start.env, params, 8).best_return

    here = Ground("Maze", dyna.env, options.hparams.env, learned, 8, best, jax.random.key(1), 6, 2)
    contenders = {who.label: who for who in grounds.maze_contenders(dyna, options, sizes)}
    played = ["policy", "MPC to the goal (true world)", "MCTS, learned values (learned world)"]
    share = {}
    for name in played:
        returns, starts = budgets.play(here, contenders[name].act)
        share[name] = returns.sum() / budgets.best_returns(here, starts).sum()
    assert share[played[1]] > max(0.9, share["policy"]) and np.isfinite(share[played[2]])


def test_the_claim_in_numbers_by_hand():
    arms = {
        "dyna": {"later_return": [200.0, 180.0]},
        "mpc_clone": {"later_return": [190.0, 170.0]},
        "dyna, few": {"later_return": [190.0, 170.0]},
        "mpc_clone, few": {"later_return": [100.0, 160.0]},
        "mpc": {"later_return": [1.0, 1.0]},
    }
    rows = {name: row for name, *row in report.robust_table(arms)[1]}
    assert rows == {
        "dyna": ["190", "-", "-", "-"],
        "mpc_clone": ["180", "-10", "-", "-"],
        "dyna, few": ["180", "-", "10", "-"],
        "mpc_clone, few": [
            "130", "-50", "50", "+40",
        ],
    }  # fmt: skip
    del arms["dyna, few"]
    *_, last = report.robust_table(arms)[1]
    assert last == ["mpc_clone, few", "130", "-", "50", "-"]


def test_a_rows_ratio_is_paired_and_unsolved_runs_count_as_the_budget():
    def solve(*first):
        values = np.array([np.inf if value is None else value for value in first], float)
        return summarise(values, at_least=52)

    assert _ratio(solve(12, 14), solve(2, 4)) == "4.33"
    assert _ratio(solve(12, None), solve(2, 2)) == "16.00"  # an unsolved run at its budget
    runs = np.array([20.0, 30, 40, 50, 60, 70])
    several, half = summarise(runs, at_least=99), summarise(runs / 2 + [0.1, 0] * 3, at_least=99)
    assert re.fullmatch(r"0\.50 \(0\.50 to 0\.50; p 0\.03\d\)", _ratio(half, several))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--grounds", "moon"], "must be one of cartpole, maze"),
        (["--sizes.played", "0", "1"], "at least 1"),
        (["--arms", "nobody"], "--arms nobody: there are"),
    ],
)
def test_bad_input_is_explained(arguments, said, capsys):
    with pytest.raises(SystemExit) as stop:
        play("--quick", *arguments)
    assert stop.value.code == 2 and said in " ".join(capsys.readouterr().err.split())
