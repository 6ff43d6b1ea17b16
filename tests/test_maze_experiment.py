"""The Maze's model experiment: command line, report, resume."""

import contextlib
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from parts import assert_same

from jaxdyna.experiments import maze, maze_model, plots_frames
from jaxdyna.experiments.maze_options import Options
from jaxdyna.experiments.storage import read_curves

TINY = [
    "--quick", "--seeds", "2", "--episodes", "6", "--stages", "2", "6", "--ablation-stage", "6",
    "--steps", "30", "--horizon", "10", "--held-out", "2", "--paper.updates", "3",
    "--lean.updates", "3", "--widths", "4", "4", "4", "--dense", "16", "--lean-widths", "4", "4",
]  # fmt: skip


def play(out, *more):
    return maze.main([*TINY, "--out", str(out), *more])


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    out = tmp_path_factory.mktemp("maze")
    assert play(out, "--arms", "paper", "lean") == 0
    return out


def made_up_study(options, arm):
    """Counts of the right shapes that tell arm, key and stage apart, and train nothing."""

    def advance(run, stage, _):
        key, before = run
        drawn = jax.random.uniform(key, (19, 3, 3)) * (stage + before) * len(arm)
        dream = jnp.tile(drawn[:1], (options.horizon, 1, 1))
        frames = jnp.full((4, 16, 16, 3), 100, jnp.uint8)
        key = jax.random.clone(key)
        return (key, before + stage), {
            "one_step": drawn, "mass": drawn[0, :, :2] + 1, "reward": drawn[0, :, :2].astype(int),
            "dream_lit": dream, "dream_drawn": dream, "seen": jnp.tile(frames, (1, 1, 1, 4)),
            "truth": frames, "belief": frames / 255, "film_truth": frames, "film_dream": frames,
            "last_loss": drawn.sum(),
        }  # fmt: skip

    return maze_model.Study(lambda key, _: (key, jnp.int32(0)), advance)


def test_it_leaves_a_table_and_figures(finished):
    results = json.loads((finished / "results.json").read_text())
    assert {arm: sorted(stages) for arm, stages in results["arms"].items()} == {
        "paper": ["2", "6"], "lean": ["2", "6"]
    }  # fmt: skip
    judged = results["arms"]["lean"]["6"]
    assert set(judged["f1"]) == {"agent", "obstacles", "goal"}
    assert all(len(score["per_seed"]) == 2 for score in judged["f1"].values())
    rewards = judged["reward_right"].values()
    assert sum(kind["of"] for kind in rewards) == 2 * 2 * 30
    report = (finished / "report.md").read_text()
    assert "| paper's figures | 100 | 0.92 | 0.83 | 0.99 |" in report
    for name in ("fig7_paper.png", "fig7_lean.png", "thresholds.png", "losses.png", "horizon.png"):
        assert f"({name})" in report
        assert (finished / name).read_bytes().startswith(b"\x89PNG")
    assert (finished / "dream_lean.gif").read_bytes().startswith(b"GIF89a")
    assert "nan" not in report.lower()


def test_an_interrupted_run_goes_on_where_it_was(tmp_path, monkeypatch):
    made, arms = [], ["--arms", "paper", "lean", "lean_l2"]
    monkeypatch.setattr(maze, "make_study", made_up_study)
    assert play(tmp_path / "whole", *arms) == 0

    def interrupting(options, arm):
        made.append(arm)
        if len(made) == 2:
            raise KeyboardInterrupt
        return made_up_study(options, arm)

    monkeypatch.setattr(maze, "make_study", interrupting)
    part = tmp_path / "part"
    assert play(part, *arms) == 130
    assert set(read_curves(part / "curves.npz")) == {"paper@2", "paper@6"}
    monkeypatch.setattr(maze, "deferred_interrupt", lambda: contextlib.nullcontext([2]))
    assert play(part, *arms, "--resume") == 130  # within an arm, between two stages
    assert set(read_curves(part / "curves.npz")) == {"paper@2", "paper@6", "lean@2"}
    monkeypatch.undo()
    monkeypatch.setattr(maze, "make_study", interrupting)
    with pytest.raises(SystemExit) as stop:
        play(part, *arms, "--resume", "--steps", "31")
    assert stop.value.code == 2
    assert play(part, *arms, "--resume") == 0
    assert made == ["paper", "lean", "lean", "lean", "lean_l2"]
    assert not (part / "checkpoints").exists()
    ours, whole = (read_curves(tmp_path / name / "curves.npz") for name in ("part", "whole"))
    assert set(whole) == {"paper@2", "paper@6", "lean@2", "lean@6", "lean_l2@2", "lean_l2@6"}
    assert_same(ours, whole)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--episodes", "5"], "less than the first of --stages"),
        (["--arms", "papre"], "papre"),
        (["--widths", "4"], "three numbers"),
        (["--horizon", "200"], "--horizon"),
        (["--lean.updates", "0"], "at least 1"),
        (["--out", "/proc/nowhere"], "choose another folder"),
        (["--resume", "--out", "/tmp/never-there-jaxdyna"], "nothing to resume"),
    ],
)
def test_bad_input_is_one_line(arguments, words, capsys):
    with pytest.raises(SystemExit) as stop:
        maze.main(arguments)
    said = capsys.readouterr().err
    assert stop.value.code == 2 and words in said and len(said.splitlines()) == 1


def test_a_stage_sees_its_own_episodes_only():
    whole = maze_model.collect(jax.random.key(0), 5, 12)
    few = maze_model.collect(jax.random.key(0), 5, 12)
    assert int(whole.size) == 60 and int(whole.episodes_added) == 5
    assert_same(few, whole)
    for episode in range(5):
        first = few.frame[12 * episode]
        assert first[15, 0, 2] == 255  # every episode starts bottom left


def test_counts_by_hand():
    truth = jnp.zeros((2, 3, 3, 3), bool).at[0, 0, 0, 2].set(True).at[1, 1, 1, 0].set(True)
    lit = truth.at[0, 2, 2, 2].set(True).at[1, 1, 1, 0].set(False)
    counts = np.asarray(maze_model._counts(lit, truth, (0, 1, 2)))
    np.testing.assert_array_equal(counts, [[1, 2, 1], [0, 0, 1], [0, 0, 0]])
    np.testing.assert_allclose(maze_model.f1(counts), [2 / 3, 0, 0])


def test_presets_and_stages():
    options = Options(episodes=120)
    assert options.played_stages == (10, 30, 100)
    assert options.stages_of("paper_l1") == (10, 30, 100)
    assert Options(ablation_stage=20).stages_of("lean_l2") == (10,)


def test_a_trail_shows_the_newest_frame_brightest():
    stack = np.zeros((2, 2, 12))
    stack[0, 0, 0] = stack[1, 1, 9] = 1.0
    shown = plots_frames.trail(stack)
    assert shown[1, 1, 0] == 1 and 0 < shown[0, 0, 0] < 0.5
