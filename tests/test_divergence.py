"""A run whose numbers stop being finite is over, says so, and touches no other."""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from parts import DYNA, MODEL_FREE, SMALL, hparams
from test_engine import assert_same_runs, play

from jaxdyna.agents import ReinforceHParams
from jaxdyna.dyna import DynaConfig
from jaxdyna.dyna.loop import DIVERGED
from jaxdyna.envs import CartPoleParams
from jaxdyna.experiments.engine import Engine, Experiment, Options, main, storage
from jaxdyna.experiments.report import sections
from jaxdyna.experiments.report.summaries import diverged
from jaxdyna.experiments.study.arms import Hooks, dyna_arm
from jaxdyna.models import SupervisedHParams
from jaxdyna.statistics import SolveRule

HOOKS = Hooks(
    lambda *_: {"judged": jnp.ones(2)}, lambda *_: {"film": jnp.ones(3)}, piece=2, block=32
)
POISON = {
    "world": {"env": CartPoleParams(max_steps=20, gravity=jnp.float32(jnp.nan))},
    "agent": {"agent": ReinforceHParams(learning_rate=jnp.inf)},
    "model": {"model": SupervisedHParams(learning_rate=jnp.inf)},
}


@pytest.fixture(scope="module")
def played():
    """32 runs, of which one is poisoned by each part in turn; and none."""
    engine, all_played = Engine(workers=1), {}
    for part, poison in ({"": {}} | POISON).items():
        arms = [dyna_arm(DYNA, SMALL, hparams(), HOOKS)] * 32
        arms[7] = dyna_arm(DYNA, SMALL, hparams(**poison), HOOKS)
        all_played[part] = play(engine, arms, [3])
    assert len(engine.programs) == 1
    return all_played


def test_a_healthy_run_says_so(played):
    for run in played[""].values():
        assert not run["diverged"].any() and len(run["diverged"]) == SMALL.num_episodes
        assert run["judged"].tolist() == [1, 1]


@pytest.mark.parametrize("part", DIVERGED)
def test_one_of_32_is_over_and_the_others_are_as_ever(part, played):
    runs = dict(played[part])
    broken = runs.pop((7, 3))
    assert_same_runs(runs, played[""])
    assert len(runs) == 31
    at = len(broken["diverged"])
    assert at < SMALL.num_episodes and not broken["diverged"][:-1].any()
    assert diverged({"diverged": broken["diverged"][None]}, [3]) == {
        "diverged": {"3": {"unit": at, "part": part}}
    }
    assert np.isnan(broken["judged"]).all()  # what a broken agent does is no result
    healthy = played[""][7, 3]
    for name in ("real_return", "agent_loss", "model_loss"):  # the same up to there
        np.testing.assert_array_equal(broken[name][: at - 1], healthy[name][: at - 1])


def test_without_a_model_there_is_none_to_break():
    arm = dyna_arm(MODEL_FREE, SMALL, hparams(**POISON["model"]), HOOKS._replace(block=1))
    assert not play(Engine(), [arm], [0])[0, 0]["diverged"].any()


@dataclass(frozen=True, kw_only=True)
class ToyOptions(Options):
    dyna: DynaConfig = SMALL


def rule(options):
    return SolveRule(2, 3.0)


def toy(options):
    make = partial(dyna_arm, DYNA, options.dyna, hooks=HOOKS._replace(block=2))
    return {
        "model_free": partial(make, hparams(fake_weight=0.0)),
        "dyna": partial(make, hparams(**POISON["model"])),
    }


TOY = Experiment(
    "toy", "A toy", {"tuned": ToyOptions(seeds=6, episodes=SMALL.num_episodes)}, toy, rule=rule,
    sections=(
        sections.solving(rule), sections.learning_curves(rule), sections.endings(rule),
        sections.equal_episodes(["model_free"], last=1), sections.settings, sections.spent,
    ),
)  # fmt: skip


def test_report_results_and_terminal_say_which_runs_where_and_why(tmp_path, capsys):
    assert main(TOY, argv=["--out", str(tmp_path / "out")], prog="toy") == 0
    arms = storage.read_json(tmp_path / "out" / "results.json")["arms"]
    assert "diverged" not in arms["model_free"]
    broken = arms["dyna"]["diverged"]
    assert broken.keys() == set("012345")
    assert {said["part"] for said in broken.values()} == {"model"}
    assert arms["dyna"]["episodes_played"]["per_seed"] == [said["unit"] for said in broken.values()]
    curves = storage.read_curves(tmp_path / "out" / "curves.npz")
    assert "show_film" in curves["model_free"] and "show_film" not in curves["dyna"]
    report, printed = (tmp_path / "out" / "report.md").read_text(), capsys.readouterr().out
    for said in (report, " ".join(printed.split())):
        assert f"finite in dyna: seed 0 in episode {broken['0']['unit']} (model), seed 1 in" in said
        assert "3 more runs." in said and "These runs ended there" in said


def test_a_healthy_run_passes_where_jax_looks_for_nans(played):
    """Skipped work is no NaN then; what the record says of it is."""
    jax.config.update("jax_debug_nans", True)
    try:
        arm = dyna_arm(DYNA, SMALL, hparams(), HOOKS._replace(block=2, piece=3))  # traced anew
        runs = play(Engine(), [arm], [3, 4])
    finally:
        jax.config.update("jax_debug_nans", False)
    for name, values in played[""][0, 3].items():
        np.testing.assert_allclose(runs[0, 3][name], values, 1e-4, err_msg=name)
    assert np.isnan(runs[0, 3]["fake_return"]).tolist() == [True] + 5 * [False]
