"""The Maze's model experiment: command line, report, resume."""

import contextlib
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny
from parts import assert_same

from jaxdyna import frame_replay
from jaxdyna.experiments import (
    frame_session,
    maze,
    maze_bench,
    maze_frames,
    maze_judge,
    maze_model,
    maze_tables,
    plots_frames,
)
from jaxdyna.experiments.maze_options import Options, world
from jaxdyna.experiments.storage import read_curves
from jaxdyna.rollout import rollout
from jaxdyna.types import Prediction


def play(out, *more):
    return maze.main([*tiny.MAZE_MODEL, "--out", str(out), *more])


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    out = tmp_path_factory.mktemp("maze")
    assert play(out, "--arms", "paper", "lean") == 0
    return out


def test_it_leaves_a_table_and_figures(finished):
    results = json.loads((finished / "results.json").read_text())
    assert {arm: sorted(stages) for arm, stages in results["arms"].items()} == {
        "paper": ["2", "6"], "lean": ["2", "6"]
    }  # fmt: skip
    judged = results["arms"]["lean"]["6"]
    assert set(judged["f1"]) == {"agent", "obstacles", "goal"}
    assert all(len(score["per_seed"]) == 2 for score in judged["f1"].values())
    rewards = judged["reward_right"].values()
    assert sum(kind["steps"] for kind in [*rewards][:3]) == 2 * 2 * 30
    report = (finished / "report.md").read_text()
    assert "| paper's figures | 100 | 0.92 | 0.83 | 0.99 |" in report
    for name in ("fig7_paper.png", "fig7_lean.png", "thresholds.png", "losses.png", "horizon.png"):
        assert f"({name})" in report
        assert (finished / name).read_bytes().startswith(b"\x89PNG")
    assert (finished / "dream_lean.gif").read_bytes().startswith(b"GIF89a")
    assert "nan" not in report.lower()


def test_an_interrupted_run_goes_on_where_it_was(finished, tmp_path, monkeypatch):
    """Interrupted within a stage and between arms, then resumed: the same, bit for bit."""
    monkeypatch.setattr(frame_session, "PIECE_UPDATES", 2)
    part, arms = tmp_path / "part", ["--arms", "paper", "lean"]
    real, made = maze_frames.EXPERIMENT, []

    def interrupting(options, arm):
        made.append(arm)
        if len(made) == 2:
            raise KeyboardInterrupt
        return real.make_study(options, arm)

    with monkeypatch.context() as patch:
        patch.setattr(frame_session, "deferred_interrupt", lambda: contextlib.nullcontext([2]))
        assert play(part, *arms) == 130
        assert read_curves(part / "curves.npz") == {}
    record = json.loads((part / "results.json").read_text())
    spent = record["timing"].pop("arms")["paper"]["stages"]["2"]
    (part / "results.json").write_text(
        json.dumps(record | {"timing": record["timing"] | {"arms": {}}})
    )
    monkeypatch.setattr(maze_frames, "EXPERIMENT", real._replace(make_study=interrupting))
    made.append("paper")
    with pytest.raises(SystemExit) as stop:
        play(part, *arms, "--resume", "--steps", "31")
    assert stop.value.code == 2
    assert play(part, *arms, "--resume") == 130
    assert play(part, *arms, "--resume") == 0
    assert not (part / "checkpoints").exists()
    ours, whole = (read_curves(folder / "curves.npz") for folder in (part, finished))
    assert set(whole) == {"paper@2", "paper@6", "lean@2", "lean@6"}
    assert_same(ours, whole)
    timing = json.loads((part / "results.json").read_text())["timing"]
    assert timing["arms"]["paper"]["stages"]["2"] > spent > 0  # what a killed run had taken


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--episodes", "5"], "less than the first of --stages"),
        (["--arms", "papre"], "papre"),
        (["--widths", "4"], "three numbers"),
        (["--collision-reward", "nan"], "--collision-reward"),
        (["--size", "9"], "larger --size"),
        (["--obstacles", "-1"], "num_obstacles"),
        (["--steps", "30", "--horizon", "21"], "where dreams end"),
        (["--lean.updates", "0"], "at least 1"),
        (["--out", "/proc/nowhere"], "choose another folder"),
        (["--resume", "--out", "never-there-jaxdyna"], "nothing to resume"),
    ],
)
def test_bad_input_is_one_line(arguments, words, capsys):
    with pytest.raises(SystemExit) as stop:
        maze.main(["--part", "model", *arguments])
    said = capsys.readouterr().err
    assert stop.value.code == 2 and words in said and len(said.splitlines()) == 1
    assert not Path("never-there-jaxdyna").exists()


def test_a_stage_sees_its_own_episodes_only():
    options = Options(steps=12, horizon=2, episodes=5, stages=(2, 5))
    key = jax.random.key(0)
    whole = maze_model.collect(options, key, 5)
    few = maze_model.first_episodes(whole, 2, 12)
    alone = maze_model.collect(options, jax.random.clone(key), 2)
    assert int(few.size) == int(alone.size) == 24
    numbers = jnp.arange(24)
    assert_same(frame_replay.take(few, numbers), frame_replay.take(alone, numbers))
    drawn = frame_replay.draw_numbers(few, jax.random.key(1), (2000,))
    assert (drawn.min(), drawn.max()) == (0, 23)


def test_counts_by_hand():
    truth = jnp.zeros((2, 3, 3, 3), bool).at[0, 0, 0, 2].set(True).at[1, 1, 1, 0].set(True)
    lit = truth.at[0, 2, 2, 2].set(True).at[1, 1, 1, 0].set(False)
    counts = np.asarray(maze_judge._counts(lit, truth, (0, 1, 2)))
    np.testing.assert_array_equal(counts, [[1, 2, 1], [0, 0, 1], [0, 0, 0]])
    np.testing.assert_allclose(maze_judge.f1(counts), [2 / 3, 0, 0])


def played(options, key):
    env, params = world(options)
    steps, count = options.steps, options.held_out
    return rollout(env, maze_model.random_act, key, params, count, num_steps=steps)


def remembers(new, late):
    """Predicts what happened when it saw just that; or, late, that nothing changes."""

    def predict(params, obs, action, key):
        same = (new.obs == obs).all((-1, -2, -3)) & (new.action == action)
        where = jnp.unravel_index(jnp.argmax(same), same.shape)
        follows = jnp.concatenate([obs[..., 3:], obs[..., -3:]], -1)
        follows = follows if late else new.next_obs[where]
        return Prediction(follows, new.reward[where] - late, jnp.float32(0), jnp.float32(0))

    def believe(params, obs, action):
        key = jax.random.key(0)
        return jax.vmap(lambda o, a: predict(params, o, a, key).next_obs[..., -3:] / 255)(
            obs, action
        )

    return maze_judge.Predictor(believe, predict, predict)


def test_who_is_always_right_is_judged_so():
    options = Options(size=5, obstacles=3, steps=24, horizon=10, held_out=4, kernels=(2, 2, 2))
    new = played(options, jax.random.key(1))
    judged, late = (
        maze_judge.judge(options, remembers(new, slow), None, new, jax.random.key(2))
        for slow in (False, True)
    )
    for name in ("one_step", "dream_lit", "dream_drawn"):
        np.testing.assert_array_equal(maze_judge.f1(np.asarray(judged[name])), 1)
        scores = maze_judge.f1(np.asarray(late[name]))
        assert scores[..., 1].mean() < 0.4  # obstacles move, but where they turn
    collisions, goals, others, first = np.asarray(judged["reward"][:, 1])
    assert collisions == (new.reward < 0).sum() > 0 and collisions + goals + others == 4 * 24
    assert first == (new.reward[:, 0] < 0).sum()
    np.testing.assert_array_equal(judged["reward"][:, 0], judged["reward"][:, 1])
    assert late["reward"][:, 0].sum() == 0
    lit = judged["one_step"][0, :, 2]
    np.testing.assert_allclose(judged["mass"], np.stack([lit, 0 * lit], -1))
    assert late["mass"][1, 1] > 0.5 * lit[1]
    np.testing.assert_array_equal(judged["film_dream"], new.next_obs[0, 10:20, ..., -3:])


def described(lit, drawn, sure=0.9, spilled=0.1):
    def by_class(values):
        one = {"mean": float(np.mean(values)), "per_seed": list(values)}
        return dict.fromkeys(("agent", "obstacles", "goal"), one)

    dreams = {"lit": {"10": by_class(lit)}, "drawn": {"10": by_class(drawn)}}
    said = {"dream_f1": dreams, "believed": by_class([sure]), "spilled": by_class([spilled])}
    return {"arms": {"lean": {"100": said}}}


def test_the_report_claims_no_more_than_the_runs_show():
    for lit, drawn, verdict in [
        ([0.9, 0.8, 0.9], [0.7, 0.7, 0.6], "threshold drifts less"),
        ([0.7, 0.7, 0.6], [0.9, 0.8, 0.9], "drawn drifts less"),
        ([0.9, 0.5, 0.7], [0.7, 0.7, 0.7], "cannot be told apart"),
        ([0.7, 0.7, 0.7], [0.7, 0.7, 0.7], "cannot be told apart"),
    ]:
        assert verdict in maze_tables.drift_said(described(lit, drawn))
    for sure, spilled, word in [(0.9, 0.9, "sharp"), (0.5, 0.5, "blurred"), (0.1, 0.0, "dark")]:
        assert f"`lean` is {word}" in maze_tables.blur_said(
            described([1], [1], sure, spilled), "100"
        )


def test_the_benchmark_says_what_it_needs_and_compares(tmp_path, monkeypatch, capsys):
    def missing(*_):
        raise ImportError

    monkeypatch.setattr(maze_bench, "torch_steps", missing)
    with pytest.raises(SystemExit) as stop:
        maze_bench.main(["--out", str(tmp_path)])
    assert stop.value.code == 2 and "pip install 'jaxdyna[bench]'" in capsys.readouterr().err
    header, rows = maze_bench.compared({"ours": [1.0, 2.0, 3.0], "PyTorch": [4.0]}, "PyTorch")
    assert rows[0] == ["ours", "2.00", "1.50 to 2.50", "0.50"] and len(header) == 4
    called = []
    taken = maze_bench.take_turns({name: lambda n=name: called.append(n) for name in "ab"}, 2)
    assert called == list("baabbaab") and [len(values) for values in taken.values()] == [2, 2]


def test_presets_and_stages():
    options = Options(episodes=120)
    assert options.played_stages == (10, 30, 100)
    assert options.stages_of("paper_l1") == (100,)
    assert Options(ablation_stage=22).stages_of("lean_l2") == (30,)


def test_a_trail_shows_the_newest_frame_brightest():
    stack = np.zeros((2, 2, 12))
    stack[0, 0, 0] = stack[1, 1, 9] = 1.0
    shown = plots_frames.trail(stack)
    assert shown[1, 1, 0] == 1 and 0 < shown[0, 0, 0] < 0.5
