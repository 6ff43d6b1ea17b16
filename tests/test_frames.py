"""Frame models as work: episodes, judging, reports, command lines; in the Maze and in Catch."""

import json
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny
from parts import assert_same
from renamed import respelled

from jaxdyna.experiments.catch.frames import TUNED as CATCH
from jaxdyna.experiments.engine import main
from jaxdyna.experiments.engine.checkpoint import Store
from jaxdyna.experiments.engine.storage import read_curves
from jaxdyna.experiments.frames import grids, training
from jaxdyna.experiments.frames.judging import counts, judge, show
from jaxdyna.experiments.frames.scores import f1, precision, recall, scored
from jaxdyna.experiments.frames.training import Training
from jaxdyna.experiments.frames.worlds import Asked, Stage
from jaxdyna.experiments.maze.frames import FRAMES, TUNED, MazeFrames
from jaxdyna.experiments.report.frames import trail
from jaxdyna.fields import SettingError, changed, plain, restored
from jaxdyna.replay import frames as frame_replay
from jaxdyna.rollout import rollout
from jaxdyna.types import Prediction

PROG = "python -m jaxdyna.experiments.maze --part frames"
MAZE = respelled(["maze", *tiny.MAZE_MODEL])[3:]
SMALL = MazeFrames(
    size=5, obstacles=3, steps=24, horizon=10, held_out=4, kernels=(2, 2, 2), episodes=5,
    stages=(2, 5),
)  # fmt: skip


def play(out, *more):
    return main(FRAMES, argv=[*MAZE, "--loss-every", "2", "--out", str(out), *more], prog=PROG)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    out = tmp_path_factory.mktemp("frames")
    assert play(out, "--arms", "paper", "lean") == 0
    return out


def test_it_leaves_a_table_and_figures(finished):
    results = json.loads((finished / "results.json").read_text())
    assert list(results["arms"]) == ["paper@2", "paper@6", "lean@2", "lean@6"]
    judged = results["arms"]["lean@6"]
    assert (judged["arm"], judged["setting"]) == ("lean", "6")
    assert list(judged["f1"]) == ["agent", "obstacles", "goal"]
    assert all(len(score["per_seed"]) == 2 for score in judged["f1"].values())
    assert set(judged["dreams"]) == {"lit", "drawn"}
    rewards = judged["reward_right"].values()
    assert sum(kind["steps"] for kind in [*rewards][:3]) == 2 * 2 * 30
    assert results["arms"]["paper@6"]["reward_right"] == {}
    report = (finished / "report.md").read_text()
    assert "| paper's figures | 100 | 0.92 | 0.83 | 0.99 |" in report
    names = ("training", "fig7_paper", "fig7_lean", "thresholds", "losses", "horizon")
    for name in (f"{name}.png" for name in names):
        assert f"({name})" in report
        assert (finished / name).read_bytes().startswith(b"\x89PNG")
    assert (finished / "dream.gif").read_bytes().startswith(b"GIF89a")
    assert "nan" not in report.lower()
    assert max(line.count("|") for line in report.splitlines()) <= 7


def test_it_keeps_losses_and_pictures_of_the_first_run(finished):
    judged = read_curves(finished / "curves.npz")["lean@6"]
    shapes = {name: values.shape for name, values in judged.items() if name.startswith("show_")}
    assert shapes == {
        "show_frame_loss": (3,), "show_seen": (16, 16, 12), "show_truth": (16, 16, 3),
        "show_belief": (16, 16, 3), "show_film_truth": (10, 16, 16, 3),
        "show_film_dream": (10, 16, 16, 3),
    }  # fmt: skip


def test_it_looks_at_losses_on_new_and_old_episodes(finished):
    """After every second of three gradient steps: the same transitions, in either run others."""
    for name, judged in read_curves(finished / "curves.npz").items():
        for whose in ("new", "old"):
            loss = judged[f"{whose}_loss"]
            assert loss.shape == (2, 3) and (np.isfinite(loss) == [False, True, False]).all()
        assert len(set(np.ravel([judged["new_loss"][:, 1], judged["old_loss"][:, 1]]))) == 4, name


@pytest.mark.slow  # as CartPole's
def test_an_interrupted_run_goes_on_where_it_was(finished, tmp_path, monkeypatch):
    """Interrupted within a run and between two, then resumed: the same, bit for bit."""
    monkeypatch.setattr(training, "PIECE", 2)
    grids.work.cache_clear()
    part, arms, saved, save = tmp_path / "part", ["--arms", "lean"], [], Store.save

    def saving(store, number, run, seconds):
        save(store, number, run, seconds)
        saved.append(run.done)
        if len(saved) in (1, 5):
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Store, "due", lambda store, saved: True)
        patch.setattr(Store, "save", saving)
        assert play(part, *arms) == 130
        assert read_curves(part / "curves.npz") == {} and saved[0] == 2
        with pytest.raises(SystemExit) as stop:
            play(part, *arms, "--resume", "--steps", "31")
        assert stop.value.code == 2
        assert play(part, *arms, "--resume") == 130
    assert play(part, *arms, "--resume") == 0
    assert not (part / "checkpoints").exists()
    ours, whole = (read_curves(folder / "curves.npz") for folder in (part, finished))
    assert [*ours] == ["lean@2", "lean@6"]
    assert_same(ours, {name: whole[name] for name in ours})


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--episodes", "5"], "less than the first of --stages"),
        (["--arms", "papre"], "papre"),
        (["--widths", "4"], "--widths"),
        (["--collision-reward", "nan"], "--collision-reward"),
        (["--size", "9"], "smaller"),
        (["--obstacles", "-1"], "--obstacles"),
        (["--steps", "30", "--horizon", "21"], "where dreams end"),
        (["--lean.updates", "0"], "--lean.updates"),
        (["--stages", "0", "10"], "--stages"),
        (["--stop-after-solved", "1"], "leave it out"),
        (["--out", "/proc/nowhere"], "choose another folder"),
        (["--resume", "--out", "never-there-jaxdyna"], "nothing to resume"),
    ],
)
def test_bad_input_is_one_line(arguments, words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        main(FRAMES, argv=arguments, prog=PROG)
    said = capsys.readouterr().err
    assert stop.value.code == 2 and words in said and len(said.splitlines()) == 1
    assert not (tmp_path / "never-there-jaxdyna").exists()


def test_a_stage_is_a_run_of_the_same_program():
    made = grids.arms(TUNED)
    assert [name for name in made if name.startswith("paper@")] == [
        "paper@10", "paper@30", "paper@100", "paper@300"
    ]  # fmt: skip
    assert [name for name in made if name.startswith("lean_l1")] == ["lean_l1@100"]
    few, many = made["paper@10"](), made["paper@300"]()
    assert few.work is many.work and few.work is not made["paper_l2@100"]().work
    assert (few.units, many.units) == (8400, 20000)
    assert many.hparams == Stage(300, 20000, 3e-3)
    slower = changed(TUNED, {"paper.learning_rate": 1e-3, "episodes": 300})
    assert grids.arms(slower)["paper@30"]().work is few.work
    assert [*grids.arms(changed(TUNED, {"episodes": 99, "ablation_stage": 22}))] == [
        "paper@10", "paper@30", "paper_l2@30", "paper_l1@30", "paper_reward@30", "lean@10",
        "lean@30", "lean_l2@30", "lean_l1@30",
    ]  # fmt: skip
    assert restored(TUNED, json.loads(json.dumps(plain(slower)))) == slower
    with pytest.raises(SettingError, match=r"paper\.batch"):
        changed(TUNED, {"paper.batch": 0})


@pytest.mark.slow
def test_a_stage_sees_its_own_episodes_only():
    key, new = jax.random.split(jax.random.key(0))
    world = grids.random_episodes(replace(SMALL, steps=12, horizon=2), rare_share=0.5)
    few, weight, held_out = jax.jit(world.data)(key, new, Stage(2, 1, 1.0))
    one = replace(SMALL, steps=12, horizon=2, episodes=2, stages=(2,))
    alone = grids.random_episodes(one, rare_share=0.5)
    other, same, _ = jax.jit(alone.data)(jax.random.clone(key), jax.random.clone(new),
                                         Stage(2, 1, 1.0))  # fmt: skip
    assert int(few.size) == int(other.size) == 24 and held_out.reward.shape == (4, 12)
    numbers = jnp.arange(24)
    assert_same(frame_replay.take(few, numbers), frame_replay.take(other, numbers))
    np.testing.assert_array_equal(weight[:24], same)
    assert not weight[24:].any()
    drawn = frame_replay.draw_numbers(few, jax.random.key(1), (2000,), weight)
    assert (drawn.min(), drawn.max()) == (0, 23)


def test_counts_by_hand():
    truth = jnp.zeros((2, 3, 3, 3), bool).at[0, 0, 0, 2].set(True).at[1, 1, 1, 0].set(True)
    lit = truth.at[0, 2, 2, 2].set(True).at[1, 1, 1, 0].set(False)
    counted = np.asarray(counts(grids.random_episodes(SMALL, None), lit, truth, (0, 1, 2)))
    np.testing.assert_array_equal(counted, [[1, 2, 1], [0, 0, 1], [0, 0, 0]])
    np.testing.assert_allclose(f1(counted), [2 / 3, 0, 0])
    np.testing.assert_allclose(recall(counted), [1, 0, 0])
    np.testing.assert_allclose(precision(counted), [0.5, np.nan, np.nan])


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

    return Asked(believe, (("lit", predict), ("drawn", predict)), 0.5, rewards=True)


def played(options, key):
    """The options' world, and new episodes in it."""
    env, params = options.world()

    def act(obs, key):
        return jax.random.randint(key, (), 0, env.num_actions)

    new = rollout(env, act, key, params, options.held_out, num_steps=options.steps)
    return grids.random_episodes(options, None), new


def test_who_is_always_right_is_judged_so():
    world, new = played(SMALL, jax.random.key(1))
    data = (None, None, new)
    asked = [remembers(new, late) for late in (False, True)]
    judged, late = (judge(world, one, None, data, jax.random.key(2)) for one in asked)
    for name in ("one_step", "dream_lit", "dream_drawn"):
        np.testing.assert_array_equal(f1(np.asarray(judged[name])), 1)
        assert (
            f1(np.asarray(late[name]))[..., 1].mean() < 0.4
        )  # obstacles move, but where they turn
    collisions, goals, others, first = np.asarray(judged["reward"][:, 1])
    assert collisions == (new.reward < 0).sum() > 0 and collisions + goals + others == 4 * 24
    assert first == (new.reward[:, 0] < 0).sum()
    np.testing.assert_array_equal(judged["reward"][:, 0], judged["reward"][:, 1])
    assert late["reward"][:, 0].sum() == 0
    lit = judged["one_step"][0, :, 2]
    np.testing.assert_allclose(judged["mass"], np.stack([lit, 0 * lit], -1))
    assert late["mass"][1, 1] > 0.5 * lit[1]
    shown = show(world, asked[0], None, data, jax.random.key(3))
    np.testing.assert_array_equal(shown["film_dream"], new.next_obs[0, 10:20, ..., -3:])
    np.testing.assert_array_equal(shown["film_truth"], shown["film_dream"])
    np.testing.assert_array_equal(shown["seen"], new.obs[0, 9])
    np.testing.assert_allclose(255 * shown["belief"], shown["truth"])


def test_dreams_are_counted_apart_and_filmed_where_the_world_says_so():
    """Here: until an obstacle is in the upper left corner, filmed from where that lasts longest."""
    world, new = played(SMALL, jax.random.key(4))

    def until(truth):
        return jnp.cumsum(truth[:, 1:, 0, 0, 0], axis=1) == 0

    world = world._replace(
        starts=(2, 7), apart=until, film=lambda truth: until(truth).sum(1).argmax()
    )
    asked, data = remembers(new, late=False), (None, None, new)
    judged = judge(world, asked, None, data, jax.random.key(2))
    here = np.asarray(new.next_obs[:, :, 0, 0, -3] > 0)
    apart = np.stack([np.cumsum(here[:, start : start + 10], 1) == 0 for start in (2, 7)])
    np.testing.assert_array_equal(judged["steps_apart"], apart.sum((0, 1)))
    assert 0 < judged["steps_apart"][-1] < judged["steps_apart"][0]
    obstacles = judged["dream_lit_apart"][:, 1]
    assert (obstacles <= judged["dream_lit"][:, 1]).all() and (obstacles[:, 2] > 0).all()
    np.testing.assert_array_equal(obstacles[:, 0], obstacles[:, 2])
    assert judged["pixels"] == 2 * 4 * 25
    start = (2, 7)[apart[:, 0].sum(1).argmax()]
    shown = show(world, asked, None, data, jax.random.key(3))
    np.testing.assert_array_equal(
        shown["film_dream"], new.next_obs[0, start : start + 10, ..., -3:]
    )


@pytest.mark.slow  # others learn
def test_a_model_of_catch_learns_its_rules():
    """Where the ball falls and the paddle goes; what is earned takes longer."""
    options = replace(
        CATCH, episodes=60, stages=(60,), widths=(4, 4, 4), dense=8, lean_widths=(16, 16),
        lean=Training(500, 0, 32, 1e-2),
    )  # fmt: skip
    arm = grids.arms(options)["lean@60"]()
    stage = jax.tree.map(jnp.asarray, arm.hparams)
    key = jax.random.key(5)
    data = jax.jit(arm.work.data)(key, stage)
    state = jax.jit(arm.work.init)(jax.random.clone(key), stage)

    @partial(jax.jit, donate_argnums=0)
    def trained(state, data):
        def update(number, state):
            return arm.work.step(state, data, number, stage)[0]

        return jax.lax.fori_loop(0, arm.units, update, state)

    judged = jax.jit(arm.work.judge)(trained(state, data), data, jax.random.key(6), stage)
    curves = {name: np.asarray(values)[None] for name, values in judged.items()}
    said = scored(("ball", "paddle"), ("missed", "caught", "neither"), curves)
    assert min(score["mean"] for score in said["f1"].values()) > 0.95
    assert said["dreams"]["lit"]["5"]["f1"]["ball"]["mean"] > 0.9
    assert [kind["steps"] for kind in said["reward_right"].values()][2] == 20 * 8
    assert said["reward_right"]["neither"]["mean"] > 0.9
    assert said["reward_right"]["missed"]["mean"] > 0.4


def test_a_trail_shows_the_newest_frame_brightest():
    stack = np.zeros((2, 2, 12))
    stack[0, 0, 0] = stack[1, 1, 9] = 1.0
    shown = trail(stack)
    assert shown[1, 1, 0] == 1 and 0 < shown[0, 0, 0] < 0.5
