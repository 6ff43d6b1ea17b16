"""CartPole from the command line to the report."""

import json
import os
import signal
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny
from parts import assert_same
from renamed import respelled

from jaxdyna.experiments.cartpole import PARTS, model
from jaxdyna.experiments.cartpole.arms import arms
from jaxdyna.experiments.cartpole.options import LEAN, TUNED
from jaxdyna.experiments.engine import Engine, Record, main, session, storage
from jaxdyna.experiments.engine.progress import Bars
from jaxdyna.experiments.engine.storage import read_curves
from jaxdyna.fields import changed
from jaxdyna.sweep import over_runs

PROG = "python -m jaxdyna.experiments.cartpole"
TINY = [*respelled(["cartpole", *tiny.CARTPOLE])[1:], "--block", "2"]
ARMS = ["model_free", "dyna", "placebo", "oracle"]
EPISODES = 52  # a piece and a bit


def run(*argv):
    return main(*PARTS, argv=argv, prog=PROG)


def play(out, *more):
    return run(*TINY, "--out", str(out), *more)


def study(part, arguments, out):
    early = ["--part", part, "--seeds", "2", "--dyna.num-real-first", "4", "--episodes", "12"]
    assert run(*early, "--block", "2", "--out", str(out), "--arms", *arguments) == 0
    return json.loads((out / "results.json").read_text()), (out / "report.md").read_text()


def refused(capsys, *argv):
    """The one line on bad input."""
    with pytest.raises(SystemExit) as stop:
        run(*argv)
    captured = capsys.readouterr()
    assert stop.value.code == 2 and captured.out == ""
    [line] = captured.err.strip().splitlines()
    return line


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    out = tmp_path_factory.mktemp("run")
    assert play(out, "--episodes", str(EPISODES), "--arms", *ARMS) == 0
    return out


def test_results_keep_the_contract(finished):
    results = json.loads((finished / "results.json").read_text())
    assert set(results) >= {
        "experiment", "command", "preset", "config", "versions", "commit", "device", "timing",
        "runs", "sweep", "arms",
    }  # fmt: skip
    assert set(results["timing"]) >= {"compile_s", "run_s", "total_s"}
    assert results["runs"] == {"seeds": [0, 1], "of": 2, "shard": [1, 1], "block": 2}
    assert list(results["arms"]) == ARMS and results["command"].startswith(PROG)
    for arm in results["arms"].values():
        for key in ("episodes_to_solve", "first_solved", "real_steps_to_solve", "final_return"):
            assert set(arm[key]) >= {"per_seed", "mean", "median", "ci95", "solved", "seeds"}
            assert len(arm[key]["per_seed"]) == arm[key]["seeds"] == 2
        assert arm["episodes_to_solve"]["per_seed"] == [None, None]
        assert arm["episodes_to_solve"]["restricted_mean"] == EPISODES
        assert arm["final_return"]["mean"] > 5 and "195" in arm["solve_rule"]
    assert results["config"]["dyna"]["num_episodes"] == EPISODES
    assert set(results["arms"]["dyna"]["model"]["one_step_r2_state"]) == {
        "cart position", "cart velocity", "pole angle", "pole angular velocity"
    }  # fmt: skip


def test_curves_hold_every_episode_of_every_run(finished):
    curves = read_curves(finished / "curves.npz")
    for arm in ARMS:
        for name in ("real_return", "real_length"):
            assert curves[arm][name].shape == (2, EPISODES)
    alone, dyna = curves["model_free"], curves["dyna"]
    assert_same(alone["real_return"][:, :4], dyna["real_return"][:, :4])
    assert np.isnan(dyna["fake_return"][:, :3]).all()
    assert np.isfinite(dyna["fake_return"][:, 3:]).all()
    assert dyna["model_error"].shape == (2, EPISODES) and (dyna["model_error"] > 0).all()
    assert "show_policy_truth" in dyna and "model_error" not in alone


def test_report_and_figures(finished):
    report = (finished / "report.md").read_text()
    for name in ("fig6.png", "fig5_dyna.png"):
        assert f"({name})" in report
        assert (finished / name).read_bytes().startswith(b"\x89PNG")
    assert "fig5_placebo.png" not in report  # it has no model
    assert "nan" not in report.lower()
    assert not (finished / "checkpoints").exists()


def test_of_what_was_swept_the_first_setting_has_its_figure(finished, tmp_path):
    """Of eight settings eight figures would be three megabytes."""
    results = storage.read_json(finished / "results.json")
    dyna, curves = results["arms"]["dyna"], read_curves(finished / "curves.npz")["dyna"]
    names = ("dyna@N=2", "dyna@N=3", "mpc")
    results["arms"] = dict.fromkeys(names, dyna)
    record = Record(TUNED, results, dict.fromkeys(names, curves), tmp_path)
    assert "dyna@N=3" in model.section(record)
    assert {path.name for path in tmp_path.iterdir()} == {"fig5_dyna@N=2.png", "fig5_mpc.png"}


def test_the_placebo_learns_from_as_many_dreams():
    """Where nothing lasts to the horizon, an arm that rests when safe and its placebo make the same
    number of policy updates: the placebo's endless dreams do not count as safe.
    """
    small = changed(LEAN, {
        "episodes": 5, "dyna.model_updates": 2, "dyna.dream_updates": 4, "dyna.dream_episodes": 2,
    }).resolved()  # fmt: skip
    state, metrics = last_state(arms(small)["placebo"]())
    assert (metrics["real_length"] < 200).all()
    # Three episodes before the first dream (real updates), then 4 dreams after each from the third.
    assert policy_updates(state) == 3 + 3 * 4


def test_max_updates_makes_as_many_on_every_real_episode():
    small = changed(TUNED, {"episodes": 5, "dyna.dream_updates": 4, "dyna.num_real_first": 2})
    assert policy_updates(last_state(arms(small.resolved())["max_updates"]())[0]) == 5 * (1 + 4)


def last_state(arm):
    """An arm's only run, whole: its state in the end and its metrics."""

    def whole(key, hparams):
        def step(state, episode):
            return arm.work.step(state, None, episode, hparams)

        return jax.lax.scan(step, arm.work.init(key, hparams), jnp.arange(arm.units))

    hparams = jax.tree.map(lambda value: jnp.asarray(value)[None], arm.hparams)
    return jax.jit(over_runs(whole, 1))(jax.random.split(jax.random.key(0), 1), hparams)


def policy_updates(state):
    """By Adam's own count, the only whole number in REINFORCE's state."""
    (count,) = [leaf for leaf in jax.tree.leaves(state.agent) if leaf.dtype == np.int32]
    return int(count[0])


@pytest.mark.slow  # as test_damage of an experiment of seconds
def test_interrupted_and_resumed_is_uninterrupted(finished, tmp_path, monkeypatch):
    """SIGTERM after the second arm's first piece; what is left of it follows on resume."""
    played, original = [], Bars.tell

    class Watched(Engine):
        def play(self, *arguments):
            played.append(self)
            return super().play(*arguments)

    def interrupt(self, name, stage, done, over):
        original(self, name, stage, done, over)
        if (name, stage, done) == ("dyna", "running", 50):
            os.kill(os.getpid(), signal.SIGTERM)
            assert played[-1].interrupted.wait(60)

    monkeypatch.setattr(session, "Engine", Watched)
    arguments = ["--episodes", str(EPISODES), "--arms", "model_free", "dyna"]
    with monkeypatch.context() as patch:
        patch.setattr(Bars, "tell", interrupt)
        assert play(tmp_path, *arguments) == 130
    partial = json.loads((tmp_path / "results.json").read_text())
    assert list(partial["arms"]) == ["model_free"] and (tmp_path / "report.md").exists()
    assert list((tmp_path / "checkpoints").glob("dyna*/run*.npz")) and len(played) == 2

    with pytest.raises(SystemExit) as stop:
        play(tmp_path, *arguments, "--resume", "--dyna.model-batch", "3")
    assert stop.value.code == 2

    assert play(tmp_path, *arguments, "--resume") == 0
    assert len(played) == 3
    ours, whole = (read_curves(folder / "curves.npz") for folder in (tmp_path, finished))
    assert list(ours) == ["model_free", "dyna"]
    assert_same(ours, {arm: whole[arm] for arm in ours})


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--episodes", "-5"], "--episodes is -5"),
        (["--seeds", "0"], "--seeds is 0"),
        (["--episodes", "50"], "(N) is 100 but there are only 50 episodes: lower N or raise"),
        (["--arms", "nonsense"], "nonsense"),
        (["--preset", "nonsense"], "there are tuned, lean"),
        (["--part", "nonsense"], "readings, levers, accuracy, data, baselines"),
        (["--seeds", "many"], "many"),
        (["--bogus", "1"], "--bogus"),
        (["--out", "/dev/null/here"], "choose another folder"),
        (["--resume", "--out", "/tmp/jaxdyna-nothing-here"], "nothing to resume"),
        (["--model.ensemble", "0"], "at least 1"),
        (["--hparams.dream.termination-threshold", "2"], "between 0 and 1"),
        (["--hparams.fake-weight", "inf"], "at least 0"),
        (["--hparams.env.force-mag", "nan"], "finite"),
        (["--hparams.env.length", "0"], "above 0"),
        (["--hparams.env.max-steps", "7"], "decided by --env-version"),
        (["--dyna.num-steps", "7"], "decided by --env-version"),
        (["--mcts.considered", "7"], "MuZero's"),
        (["--agent.hidden", "0"], "at least 1"),
        (["--model.hidden", "-3"], "at least 1"),
        (["--model.weight-variance", "-1"], "above 0"),
        (["--block", "0"], "at least 1"),
        (["--out", ""], "--out is empty: name a folder"),
        (["--arms", "dyna", "dyna"], "--arms names dyna twice"),
        (["--dyna.replay-capacity", "7"], "at least one episode of 200 steps"),
        (["--part", "readings", "--episodes", "50"], "lower N or raise"),
        (["--part", "accuracy", "--episodes", "50"], "lower N or raise"),
        (["--part", "levers", "--episodes", "2"], "lower N or raise"),
        (["--part", "readings", "--arms", "x"], "--arms x: there are"),
        (["--part", "readings", "--preset", "lean"], "there are tuned"),
        (["--part", "data", "--transitions", "0"], "at least 1"),
    ],
)
def test_bad_settings_end_in_one_line_and_code_2(arguments, complaint, capsys):
    assert complaint in refused(capsys, *arguments)


@pytest.mark.slow
def test_a_model_that_diverges_is_reported(tmp_path):
    assert play(tmp_path, "--arms", "dyna", "--hparams.model.learning-rate", "1e6") == 0
    model = json.loads((tmp_path / "results.json").read_text())["arms"]["dyna"]["model"]
    assert model["one_step_r2_state"]["pole angle"]["mean"] is None


def test_a_new_run_sets_the_old_one_aside(tmp_path, capsys):
    play(tmp_path, "--arms", "model_free")
    before = (tmp_path / "results.json").read_bytes()
    play(tmp_path, "--arms", "model_free", "--seed", "5")
    (kept,) = (tmp_path / "previous").iterdir()
    assert (kept / "results.json").read_bytes() == before
    assert json.loads((tmp_path / "results.json").read_text())["config"]["seed"] == 5
    (tmp_path / "results.json").write_text("{")
    capsys.readouterr()
    again = ["--arms", "model_free", "--seed", "5", "--resume", "--out", str(tmp_path)]
    assert "results.json is damaged" in refused(capsys, *TINY, *again)


def test_resume_with_further_arms_says_so(tmp_path):
    play(tmp_path, "--arms", "model_free")
    alone = storage.read_json(tmp_path / "results.json")
    alone["device"]["peak_memory_gib"] = 999.0
    storage.write_json(tmp_path / "results.json", alone)
    play(tmp_path, "--arms", "oracle", "--resume")
    results = json.loads((tmp_path / "results.json").read_text())
    assert set(results["arms"]) == set(results["config"]["arms"]) == {"model_free", "oracle"}
    first, second = results["command"].split(" && ")
    assert "--arms model_free" in first and second.endswith("--arms oracle --resume")
    assert results["device"]["peak_memory_gib"] == 999.0  # the most of both


@pytest.mark.slow
def test_double_precision(tmp_path):
    command = [sys.executable, "-m", "jaxdyna.experiments.cartpole", *TINY, "--arms", "dyna"]
    command += ["--out", str(tmp_path)]
    environment = os.environ | {"JAX_ENABLE_X64": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow  # a study as the next one
def test_readings_report(tmp_path):
    rows = ["model-free, learning rate 0.01", "true environment as the model"]
    _, text = study("readings", rows, tmp_path)
    assert all(f"| {name} |" in text for name in rows)
    assert f"the difference to «{rows[0]}» is paired" in text
    assert (tmp_path / "variants.png").exists()


@pytest.mark.slow
def test_accuracy_report(tmp_path):
    rows = ["dyna (tuned preset)", "hidden layers of 4", "2 model updates an episode"]
    results, text = study("accuracy", rows, tmp_path)
    assert "Rank correlation" in text and (tmp_path / "accuracy.png").exists()
    errors = {name: np.mean(arm["model_error"]) for name, arm in results["arms"].items()}
    assert 0 < errors["dyna (tuned preset)"] < errors["hidden layers of 4"]


@pytest.mark.slow
def test_data_report(tmp_path):
    command = respelled(["cartpole_data", *tiny.DATA])[1:]
    assert run(*command, "--block", "2", "--out", str(tmp_path)) == 0
    said = json.loads((tmp_path / "results.json").read_text())["arms"]["study"]
    text = (tmp_path / "report.md").read_text()
    for row in said["change_r2"].values():
        assert all(cell["mean"] < 1 and len(cell["per_seed"]) == 2 for cell in row.values())
    assert set(said["open_loop_error"]["random policy"]) == {"1", "10", "25", "50"}
    assert (tmp_path / "horizon.png").exists() and "| random policy |" in text


@pytest.mark.parametrize("part", [part.name for part in PARTS])
def test_help_names_the_contracts_options(part, capsys):
    with pytest.raises(SystemExit) as stop:
        run("--part", part, "--help")
    assert stop.value.code == 0
    shown = capsys.readouterr().out
    for option in ("part", "preset", "seeds", "seed", "episodes", "arms", "out", "resume", "sweep",
                   "shard", "block"):  # fmt: skip
        assert f"--{option}" in shown
    assert "0x" not in shown and "--dyna.num-episodes" not in shown


def test_a_run_stops_some_episodes_after_it_has_solved(tmp_path):
    """Without gravity and force nothing ever falls, so that the first window solves."""
    still = ["--hparams.env.force-mag", "0", "--hparams.env.gravity", "0"]
    still += ["--hparams.env.reset-bound", "0.01"]
    arguments = ["--arms", "model_free", "--stop-after-solved", "20", *still]
    for extra, length in (([], 125), (["--stop-after-solved", "None"], 160)):
        play(tmp_path, "--episodes", "160", *arguments, *extra)
        curves = read_curves(tmp_path / "curves.npz")["model_free"]
        assert curves["real_return"].shape == (2, length)
    solve = json.loads((tmp_path / "results.json").read_text())["arms"]["model_free"]
    assert solve["episodes_to_solve"]["mean"] == 100 and solve["first_solved"]["mean"] == 1
    assert solve["real_steps_to_solve"]["mean"] == 0 and solve["final_return"]["mean"] == 200
