"""The command line from start to report."""

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny
from parts import assert_same

from jaxdyna.dyna import make_train
from jaxdyna.experiments import (
    cartpole,
    cartpole_accuracy,
    cartpole_data,
    cartpole_levers,
    cartpole_readings,
    cartpole_scaling,
    maze_levers,
    run,
)
from jaxdyna.experiments.cartpole_options import LEAN
from jaxdyna.experiments.checkpoint import Checkpoints
from jaxdyna.experiments.run import piece_length
from jaxdyna.experiments.storage import read_curves


def play(out, *more):
    return cartpole.main([*tiny.CARTPOLE, "--out", str(out), *more])


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    out = tmp_path_factory.mktemp("run")
    assert play(out, "--arms", "model_free", "dyna", "placebo", "oracle") == 0
    return out


def test_results_keep_the_contract(finished):
    results = json.loads((finished / "results.json").read_text())
    for key in (
        "experiment",
        "command",
        "preset",
        "config",
        "versions",
        "device",
        "timing",
        "arms",
    ):
        assert key in results
    assert set(results["timing"]) >= {"compile_s", "run_s", "total_s"}
    assert list(results["arms"]) == ["model_free", "dyna", "placebo", "oracle"]
    for arm in results["arms"].values():
        assert "solve_rule" in arm
        for key in ("episodes_to_solve", "first_solved", "real_steps_to_solve", "final_return"):
            assert set(arm[key]) >= {"per_seed", "mean", "median", "iqm", "ci95", "solved", "seeds"}
            assert len(arm[key]["per_seed"]) == arm[key]["seeds"] == 2
        assert arm["episodes_to_solve"]["per_seed"] == [None, None]
        assert arm["final_return"]["mean"] > 5
    assert results["config"]["seeds"] == 2 and results["command"].startswith("python -m jaxdyna")
    assert set(results["arms"]["dyna"]["model"]["one_step_r2_state"]) == {
        "cart position", "cart velocity", "pole angle", "pole angular velocity"
    }  # fmt: skip


def test_curves_hold_every_episode_of_every_seed(finished):
    curves = np.load(finished / "curves.npz")
    for arm in ("model_free", "dyna", "placebo", "oracle"):
        assert curves[f"{arm}/real_return"].shape == curves[f"{arm}/real_length"].shape == (2, 24)
    np.testing.assert_array_equal(
        curves["model_free/real_return"][:, :4], curves["dyna/real_return"][:, :4]
    )
    assert np.isnan(curves["dyna/fake_return"][:, :3]).all()
    assert np.isfinite(curves["dyna/fake_return"][:, 3:]).all()
    assert (curves["dyna/state_error"] > 0).all()


def test_report_and_figures(finished):
    report = (finished / "report.md").read_text()
    for name in ("fig6.png", "fig5_dyna.png", "solved.png"):
        assert f"({name})" in report
        assert (finished / name).read_bytes().startswith(b"\x89PNG")
    assert "nan" not in report.lower().replace("finance", "")
    assert not (finished / "checkpoints").exists()


def test_the_placebo_learns_from_as_many_dreams():
    """Where nothing lasts to the horizon, an arm that rests when safe and its placebo make the same
    number of policy updates: the placebo's endless dreams do not count as safe.
    """
    small = replace(
        LEAN,
        episodes=5,
        model_updates=2,
        dream_updates=4,
        dream_episodes=2,
        hparams=replace(LEAN.hparams, real_weight=0.0),
    )
    arm = cartpole.make_arms(small)["placebo"]
    state, metrics = jax.jit(make_train(arm.dyna, arm.config))(jax.random.key(0), arm.hparams)
    assert (metrics["real_length"] < 200).all()
    updates = [leaf for leaf in jax.tree.leaves(state.agent) if leaf.dtype == np.int32]
    # Three episodes before the first dream (real updates), then 4 dreams after each from the third.
    assert [int(count) for count in updates] == [3 + 3 * 4]


def test_a_checkpoint_may_be_resumed_on_fewer_devices(tmp_path):
    mesh = jax.sharding.Mesh(np.array(jax.devices()), ("devices",))
    spread = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("devices"))
    state = {"x": jnp.arange(4.0), "key": jax.random.split(jax.random.key(3), 4)}
    Checkpoints(tmp_path / "arm").save(7, jax.device_put(state, spread), {"r": np.ones(2)}, 1.5)
    alone = jax.device_put(state, jax.devices()[0])
    loaded, pieces, run_s = Checkpoints(tmp_path / "arm").load(alone)
    assert_same(loaded, state)
    assert loaded["x"].sharding.device_set == {jax.devices()[0]} and run_s == 1.5
    assert_same(pieces, [{"r": np.ones(2)}])


@pytest.mark.parametrize(
    ("study", "arguments"),
    [
        (cartpole_readings.READINGS.main, ["--episodes", "50"]),
        (cartpole_accuracy.ACCURACY.main, ["--episodes", "50"]),
        (cartpole_levers.LEVERS.main, ["--episodes", "2"]),
        (maze_levers.LEVERS.main, ["--episodes", "20"]),
        (cartpole_scaling.main, ["--episodes", "2"]),
    ],
)
def test_studies_refuse_too_few_episodes(study, arguments, capsys):
    with pytest.raises(SystemExit) as stop:
        study(arguments)
    assert stop.value.code == 2 and "lower N or raise" in capsys.readouterr().err


def test_interrupted_and_resumed_is_uninterrupted(finished, tmp_path, monkeypatch):
    """Ctrl-C after the second arm's first piece; its other arms and episodes follow on resume."""
    monkeypatch.setattr(run, "PIECE_EPISODES", 12)
    arms = ["--arms", "model_free", "dyna"]
    original = run.Runner.run

    def interrupted_run(self, name, arm, resume=False):
        report = self.report

        def interrupt(stage, done, total, solved):
            report(stage, done, total, solved)
            if (name, stage, done) == ("dyna", "running", 12):
                signal.raise_signal(signal.SIGINT)

        self.report = interrupt
        return original(self, name, arm, resume)

    with monkeypatch.context() as patch:
        patch.setattr(run.Runner, "run", interrupted_run)
        assert play(tmp_path, *arms) == 130
    partial = json.loads((tmp_path / "results.json").read_text())
    assert list(partial["arms"]) == ["model_free"] and (tmp_path / "report.md").exists()
    assert (tmp_path / "checkpoints" / "dyna").is_dir()

    with pytest.raises(SystemExit) as stop:
        play(tmp_path, *arms, "--resume", "--model-batch", "3")
    assert stop.value.code == 2

    played = []
    monkeypatch.setattr(run.Runner, "run", lambda self, name, *rest, **settings: (
        played.append(name), original(self, name, *rest, **settings))[1])  # fmt: skip
    assert play(tmp_path, *arms, "--resume") == 0
    assert played == ["dyna"]
    ours, whole = (np.load(folder / "curves.npz") for folder in (tmp_path, finished))
    assert_same({k: ours[k] for k in ours.files}, {k: whole[k] for k in ours.files})
    assert {name.split("/")[0] for name in ours.files} == {"model_free", "dyna"}


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--episodes", "-5"], "--episodes is -5"),
        (["--seeds", "0"], "--seeds is 0"),
        (["--episodes", "50"], "num_real_first (N) is 100"),
        (["--arms", "nonsense"], "nonsense"),
        (["--preset", "nonsense"], "nonsense"),
        (["--seeds", "many"], "many"),
        (["--bogus", "1"], "--bogus"),
        (["--out", "/dev/null/here"], "choose another folder"),
        (["--resume", "--out", "/tmp/jaxdyna-nothing-here"], "nothing to resume"),
        (["--model.ensemble", "0"], "at least 1"),
        (["--hparams.termination-threshold", "2"], "between 0 and 1"),
        (["--hparams.fake-weight", "inf"], "finite"),
        (["--hparams.env.force-mag", "nan"], "finite"),
        (["--hparams.env.length", "0"], "above 0"),
        (["--hparams.env.max-steps", "7"], "--env-version"),
        (["--agent.hidden", "0"], "at least 1"),
        (["--model.hidden", "-3"], "at least 1"),
        (["--model.weight-variance", "-1"], "above 0"),
        (["--block", "0"], "at least 1"),
    ],
)
def test_bad_settings_end_in_one_line_and_code_2(arguments, complaint, capsys):
    with pytest.raises(SystemExit) as stop:
        cartpole.main(arguments)
    captured = capsys.readouterr()
    assert stop.value.code == 2
    assert captured.out == "" and len(captured.err.strip().splitlines()) == 1
    assert complaint in captured.err


def test_a_model_that_diverges_is_reported(tmp_path):
    assert play(tmp_path, "--arms", "dyna", "--hparams.model.learning-rate", "1e6") == 0
    model = json.loads((tmp_path / "results.json").read_text())["arms"]["dyna"]["model"]
    assert model["one_step_r2_state"]["pole angle"]["mean"] is None


def test_a_new_run_sets_the_old_one_aside(tmp_path):
    play(tmp_path, "--arms", "model_free")
    before = (tmp_path / "results.json").read_bytes()
    play(tmp_path, "--arms", "model_free", "--seed", "5")
    assert (tmp_path / "previous" / "results.json").read_bytes() == before
    assert json.loads((tmp_path / "results.json").read_text())["config"]["seed"] == 5
    (tmp_path / "results.json").write_text("{")
    with pytest.raises(SystemExit):
        play(tmp_path, "--arms", "model_free", "--seed", "5", "--resume")


def test_resume_with_further_arms_says_so(tmp_path):
    play(tmp_path, "--arms", "model_free")
    alone = json.loads((tmp_path / "results.json").read_text())
    alone["device"]["peak_memory_gib"] = 999.0
    (tmp_path / "results.json").write_text(json.dumps(alone))
    play(tmp_path, "--arms", "oracle", "--resume")
    results = json.loads((tmp_path / "results.json").read_text())
    assert set(results["arms"]) == set(results["config"]["arms"]) == {"model_free", "oracle"}
    first, second = results["command"].split(" && ")
    assert "--arms model_free" in first and second.endswith("--arms oracle --resume")
    assert results["device"]["peak_memory_gib"] == 999.0  # the most of both


def test_double_precision(tmp_path):
    command = [sys.executable, "-m", "jaxdyna.experiments.cartpole", *tiny.CARTPOLE]
    command += ["--out", str(tmp_path)]
    environment = os.environ | {"JAX_ENABLE_X64": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    "arguments", [["--seeds", "0"], ["--seed", "-1"], ["--arms", "x"], ["--preset", "lean"]]
)
def test_readings_check_their_settings(arguments, capsys):
    with pytest.raises(SystemExit) as stop:
        cartpole_readings.READINGS.main(arguments)
    assert stop.value.code == 2 and len(capsys.readouterr().err.strip().splitlines()) == 1


def test_readings_report(tmp_path):
    assert cartpole_readings.READINGS.main([*tiny.READINGS, "--out", str(tmp_path)]) == 0
    text = (tmp_path / "report.md").read_text()
    assert all(f"| {name} |" in text for name in tiny.READINGS[-2:])
    assert (tmp_path / "variants.png").exists()


def test_accuracy_report(tmp_path):
    assert cartpole_accuracy.ACCURACY.main([*tiny.ACCURACY, "--out", str(tmp_path)]) == 0
    text = (tmp_path / "report.md").read_text()
    assert "Rank correlation" in text and (tmp_path / "accuracy.png").exists()
    arms = json.loads((tmp_path / "results.json").read_text())["arms"]
    errors = {name: np.mean(arm["model_error"]) for name, arm in arms.items()}
    assert 0 < errors["dyna (paper preset)"] < errors["hidden layers of 4"]


def test_many_seeds_keep_what_the_contract_asks_for(tmp_path):
    arguments = ["--seeds", "51", "--episodes", "5", "--model-updates", "1", "--arms", "dyna"]
    assert play(tmp_path, *arguments) == 0
    curves = read_curves(tmp_path / "curves.npz")["dyna"]
    for name in ("real_return", "real_length", "fake_return", "model_error"):
        assert curves[name].shape == (51, 5)
    assert (curves["model_error"] > 0).all() and "state_error" not in curves


def test_data_study(tmp_path):
    counts = {"seeds": 2, "episodes": 10, "transitions": 100, "updates": 20, "judged-episodes": 2}
    arguments = [text for name, count in counts.items() for text in (f"--{name}", str(count))]
    assert cartpole_data.main([*arguments, "--out", str(tmp_path)]) == 0
    results = json.loads((tmp_path / "results.json").read_text())
    for row in results["change_r2"].values():
        assert all(-10 < cell["mean"] < 1 and len(cell["per_seed"]) == 2 for cell in row.values())
    assert (tmp_path / "horizon.png").exists() and "| random policy |" in (
        tmp_path / "report.md"
    ).read_text()


def test_scaling_study(tmp_path):
    arguments = ["--sizes", "2", "--episodes", "4", "--out", str(tmp_path)]
    assert cartpole_scaling.main(arguments) == 0
    rows = json.loads((tmp_path / "results.json").read_text())["sweeps"]
    assert [row["runs"] for row in rows] == [2]
    assert all(row["compile_s"] > 0 and row["run_s"] > 0 for row in rows)
    assert (tmp_path / "seconds.png").exists()
    with pytest.raises(SystemExit) as stop:
        cartpole_scaling.main(["--sizes", "0"])
    assert stop.value.code == 2


def test_help_names_the_contracts_options(capsys):
    with pytest.raises(SystemExit) as stop:
        cartpole.main(["--help"])
    assert stop.value.code == 0
    shown = capsys.readouterr().out
    for option in ("--preset", "--seeds", "--seed", "--episodes", "--arms", "--out", "--resume"):
        assert option in shown
    assert "0x" not in shown


def test_an_arm_stops_some_episodes_after_its_last_seed_solved(tmp_path):
    """Without gravity and force nothing ever falls, so that the first window solves."""
    still = ["--hparams.env.force-mag", "0", "--hparams.env.gravity", "0"]
    still += ["--hparams.env.reset-bound", "0.01"]
    arguments = ["--arms", "model_free", "--stop-after-solved", "20", *still]
    for extra, length in (([], 120), (["--stop-after-solved", "None"], 160)):
        play(tmp_path, "--episodes", "160", *arguments, *extra)
        assert np.load(tmp_path / "curves.npz")["model_free/real_return"].shape == (2, length)
    solve = json.loads((tmp_path / "results.json").read_text())["arms"]["model_free"]
    assert solve["episodes_to_solve"]["mean"] == 100 and solve["first_solved"]["mean"] == 1
    assert solve["real_steps_to_solve"]["mean"] == 0 and solve["final_return"]["mean"] == 200


def test_piece_length_divides_where_it_can():
    assert [piece_length(total, 50) for total in (1000, 600, 24, 7, 997)] == [50, 50, 24, 7, 50]
    assert [piece_length(total, 10) for total in (500, 150, 24, 7, 97)] == [10, 10, 8, 7, 10]
