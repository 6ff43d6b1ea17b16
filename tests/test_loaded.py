"""What a run leaves: its policies and dreams, opened anywhere, refused where they are another's."""

import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from PIL import Image
from pole import PARTS, POLE

import jaxdyna
from jaxdyna.experiments import catch, evaluate
from jaxdyna.experiments.cartpole import CARTPOLE
from jaxdyna.experiments.engine import Engine, main, programs, runs_of, storage
from jaxdyna.experiments.engine.checkpoint import Store
from jaxdyna.experiments.engine.trained import KEPT, Keeper
from jaxdyna.experiments.report import frames
from jaxdyna.fields import changed

TESTS = Path(__file__).parent
TODAY = TESTS / "data" / "kept"
"""Left by ``play`` below when the format was 1: a later version must open it, or say why not."""
PAGE = (TESTS.parent / "docs" / "running-experiments.md").read_text()


LONGER = ["--dyna.num-steps", "100", "--hparams.env.max-steps", "100"]
"""Than all policies balance."""


def play(out, *arguments):
    argv = ["--arms", "model_free", "dyna", "--seeds", "3", "--keep-runs", "2", *LONGER, *arguments]
    assert main(*PARTS, argv=[*argv, "--out", str(out)], prog="python -m pole") == 0
    return out


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A copy of what a run left, elsewhere."""
    out = play(tmp_path_factory.mktemp("played") / "out", "--film")
    return shutil.move(out, tmp_path_factory.mktemp("copied") / "cartpole-tuned")


@pytest.fixture
def copy(folder, tmp_path):
    return Path(shutil.copytree(folder, tmp_path / "copy"))


def edited(copy, **changes):
    """With other results; its curves say that they are theirs."""
    curves = storage.read_curves(copy / "curves.npz")
    results = storage.read_json(copy / "results.json") | changes
    storage.write_json(copy / "results.json", results)
    storage.write_curves(copy / "curves.npz", curves, storage.identity(results))
    return results


def test_a_kept_policy_earns_what_the_report_says(folder):
    left = jaxdyna.load(folder)
    assert left.kept == {"model_free": [0, 1], "dyna": [0, 1]}
    for arm, seeds in left.kept.items():
        said = left.results["arms"][arm]["kept_return"]["per_seed"]
        assert [left.returns(arm, seed).mean() for seed in seeds] == said[:2] and said[2] is None
        assert ", ".join(f"{one:.10g}" for one in said[:2]) in (folder / "report.md").read_text()
    assert len({left.returns("dyna", 0, 5).tobytes(), left.returns("dyna", 1, 5).tobytes()}) == 2


def test_policy_and_worlds_are_played_like_any_other(folder):
    run = jaxdyna.load(folder).trained("dyna", 1)
    assert jaxdyna.load(folder).trained("model_free").dream is None
    true = jaxdyna.rollout(run.env, run.policy, jax.random.key(0), run.params, 3)
    assert 5 < true.reward.sum(-1).min() <= true.reward.sum(-1).max() <= 100
    dream = partial(jaxdyna.rollout, run.dream, run.policy, env_params=run.dream_params)
    dreamed = dream(key=jax.random.key(1), num_episodes=20)
    assert dreamed.obs.shape == (20, 20, 4) and np.isfinite(dreamed.obs).all()
    starts = np.asarray(run.dream_params.start[0])
    assert len(np.unique(starts, axis=0)) > 2  # first observations of the real episodes
    assert (dreamed.obs[:, None, 0] == starts).all(-1).any(-1).all()
    model = run.dream_params.env.model
    inner = run.dream.env.predict(model, dreamed.obs[0, 0], dreamed.action[0, 0], jax.random.key(2))
    np.testing.assert_allclose(inner.next_obs, dreamed.next_obs[0, 0], rtol=1e-5)
    shorter = run.dream_params.replace(max_steps=1)
    _, state = run.dream.reset(jax.random.key(3), shorter)
    *_, terminated, truncated, _ = run.dream.step(jax.random.key(4), state, jnp.int32(0), shorter)
    assert terminated or truncated


@pytest.mark.filterwarnings("ignore:.*Box observation space m")
def test_a_dream_is_a_world_of_gymnasium(folder):
    jaxdyna.load(folder).register("Dream-v0")  # of the first arm that dreams
    check_env(gymnasium.make("Dream-v0").unwrapped)
    several = gymnasium.make_vec("Dream-v0", num_envs=3)
    several.reset(seed=0)
    assert np.isfinite(several.step(np.zeros(3, int))[0]).all()
    with pytest.raises(ValueError, match=r"no dream is kept in .* of model_free"):
        jaxdyna.load(folder).register("Dream-v1", "model_free")


def test_evaluate_prints_it(folder, capsys):
    assert evaluate.main([str(folder), "--arms", "dyna"]) == 0
    rows = [line.split(" | ") for line in capsys.readouterr().out.splitlines() if "dyna" in line]
    assert len(rows) == 2 and all(row[2] == row[3] for row in rows)
    assert evaluate.main([str(folder), "--episodes", "30", "--gymnasium"]) == 0
    rows = [line.split(" | ") for line in capsys.readouterr().out.splitlines() if " | 1 " in line]
    for row in rows:  # CartPole's own, of 100 steps at the most
        assert abs(float(row[2]) - float(row[3])) < 5 and float(row[5].strip(" |")) <= 100
    for argv, said in (
        ([str(folder), "--arms", "dy"], "has no arm dy: there are model_free, dyna"),
        ([str(folder / "kept")], "has no result of a run"),
    ):
        with pytest.raises(SystemExit):
            evaluate.main(argv)
        assert said in capsys.readouterr().err


def test_a_report_shows_its_film(folder):
    with Image.open(folder / "film.gif") as film:
        assert film.n_frames > 5 and film.height > 2 * 200  # dyna above, and dreaming
    assert "(film.gif)" in (folder / "report.md").read_text()
    assert "data:image/gif;base64" in (folder / "report.html").read_text()


def test_films_of_what_is_kept(tmp_path, capsys, monkeypatch):
    """CartPole's dreams are drawn as the cart that they speak of."""
    path, made = tmp_path / "a.gif", frames.film
    filmed = []
    monkeypatch.setattr(frames, "film", lambda *of: (filmed.append(of), made(*of)))
    assert evaluate.main([str(TODAY), "--film", str(path)]) == 0
    [(_, columns, together)] = filmed
    assert [*columns] == ["dyna: true", "dyna: dreamed", "model_free: true"] and together == 2
    first, last = columns["dyna: true"][0], columns["dyna: true"][-1]
    assert first[0].shape == (200, 300, 3) and first[1] == "step 0, return 0"
    assert last[1] == f"step {len(columns['dyna: true']) - 1}, return {last[1].split()[3]} over"
    np.testing.assert_array_equal(first[0], columns["dyna: dreamed"][0][0])
    np.testing.assert_array_equal(first[0], columns["model_free: true"][0][0])
    moved = columns["dyna: dreamed"][5][0]
    assert (moved != first[0]).any() and (moved != columns["dyna: true"][5][0]).any()
    with Image.open(path) as film:
        assert film.n_frames == max(map(len, columns.values())) and film.width == 2 * 300 + 12
    for argv, said in (
        (["--film", "a.avi"], "let it end in .gif or .mp4"),
        (["--film", str(tmp_path / "no" / "a.gif")], "cannot write"),
        (["--film", str(path), "--arms", "dyna", "--seed", "7"], "are kept, not 7"),
    ):
        with pytest.raises(SystemExit):
            evaluate.main([str(TODAY), *argv])
        assert said in capsys.readouterr().err


def test_a_film_as_mp4(tmp_path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    column = [(np.full((15, 17, 3), shade, np.uint8), "") for shade in range(0, 250, 10)]
    frames.film(tmp_path / "a.mp4", {"a": column, "b": column[:5]})
    count, seconds = ffmpeg.count_frames_and_secs(str(tmp_path / "a.mp4"))
    assert count == 25 and abs(seconds - 25 * frames.PAUSE_MS / 1000) < 0.2


def test_what_is_others_or_damaged_is_refused(copy):
    kept = copy / "kept" / "dyna"
    left, whole = jaxdyna.load(copy), (kept / "0.npz").read_bytes()
    shutil.copy(kept / "1.npz", kept / "0.npz")
    with pytest.raises(ValueError, match=r"another run's than results\.json"):
        left.trained("dyna", 0)
    (kept / "0.npz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=r"0\.npz is damaged"):
        left.trained("dyna", 0)
    (kept / "0.npz").unlink()
    with pytest.raises(ValueError, match=r"0\.npz is damaged .*No such file"):
        left.trained("dyna", 0)
    with pytest.raises(ValueError, match=r"the seeds \[0, 1\] are kept, not 2: --keep-runs"):
        left.trained("dyna", 2)
    config = left.results["config"]
    config["dyna"] |= {"dream_episodes": 3}  # which no network depends on
    edited(copy, config=config)
    assert jaxdyna.load(copy).trained("dyna", 1)


def test_later_versions(copy):
    before = storage.read_json(copy / "results.json")
    config = before["config"]
    del config["block"], config["hparams"]["agent"]["discount"], config["dyna"]["eval_every"]
    edited(copy, config=config)  # of a version that had not these settings yet
    left = jaxdyna.load(copy)
    assert left.options.dyna.eval_every == 0
    assert left.returns("dyna").mean() == before["arms"]["dyna"]["kept_return"]["per_seed"][0]
    edited(copy, format=before["format"] + 1)
    with pytest.raises(ValueError, match="later version of jaxdyna: update"):
        jaxdyna.load(copy)


def test_a_run_of_format_1_is_still_opened(capsys):
    left = jaxdyna.load(TODAY)
    for arm in ("model_free", "dyna"):
        said = left.results["arms"][arm]["kept_return"]["per_seed"][0]
        assert left.returns(arm).mean() == pytest.approx(said, abs=0.5)  # on any machine
    run = left.trained("dyna")
    dreamed = run.dream.step(
        jax.random.key(0), run.dream.reset(jax.random.key(0), run.dream_params)[1], jnp.int32(1),
        run.dream_params,
    )  # fmt: skip
    assert np.isfinite(dreamed[0]).all()


def test_a_network_of_another_size_is_named():
    left = jaxdyna.load(TODAY)
    made = left.entries["dyna"].make()
    keeper, file = (
        Keeper(made.work.init, made.work.trained, made.hparams),
        TODAY / "kept" / "dyna" / "0.npz",
    )
    kept, name = storage.read_arrays(file), ".state.agent.params['params']['Dense_0']['kernel']"
    assert keeper.differs(kept) == ""
    kept[name] = np.zeros((4, 9), np.float32)
    assert keeper.differs(kept) == f"{name} was float32[4, 9] and is float32[4, 8]"
    del kept[name]
    assert keeper.differs(kept) == f"{name} was not there and is float32[4, 8]"


def test_an_experiment_of_ones_own_is_found_by_its_module(copy):
    assert edited(copy)["module"] == "pole"
    edited(copy, module="nowhere_at_all")
    with pytest.raises(ValueError, match="pole is in the module nowhere_at_all, which cannot be"):
        jaxdyna.load(copy)
    assert jaxdyna.load(copy, POLE).kept["dyna"] == [0, 1]


def test_nothing_is_kept_where_nothing_is_asked_for(tmp_path, capsys):
    out = play(tmp_path / "none", "--arms", "model_free", "--keep-runs", "0", "--film")
    assert not (out / "kept").exists() and jaxdyna.load(out).kept == {}
    assert "There is no film" in capsys.readouterr().out and not (out / "film.gif").exists()
    play(out, "--arms", "model_free", "--keep-runs", "1")
    assert [path.name for path in out.glob("kept/*/*")] == ["0.npz"]
    play(out, "--arms", "model_free", "--keep-runs", "0")  # an earlier result goes whole
    assert not (out / "kept").exists()
    (before,) = (path.parent for path in out.glob("previous/*/kept"))
    assert jaxdyna.load(before).trained("model_free")


def test_a_run_that_was_killed_once_over_keeps_what_it_has_learned(tmp_path):
    options = POLE.presets["tuned"].resolved()
    arm = POLE.arms(options)["dyna"]()
    runs = runs_of([arm], [0, 1], 0)
    store = partial(Store, tmp_path / "checkpoints")
    played = [Engine(keep=1).play(arm.work, runs, store=store()).curves for _ in range(2)]
    for first, again in zip(*played, strict=True):
        assert first.keys() == again.keys()
        assert all(np.array_equal(first[name], again[name], equal_nan=True) for name in first)
    kept = [[name for name in run if name.startswith(KEPT)] for run in played[1]]
    assert kept[0] and not kept[1]


@pytest.mark.parametrize("arm", ["model_free", "dyna"])
def test_replays_and_optimisers_are_not_kept(arm):
    options = catch.CATCH.presets["lean"].resolved()
    made = catch.CATCH.arms(options)[arm]()
    names = Keeper(made.work.init, made.work.trained, made.hparams).names
    wanted = {"model_free": ["agent.target"], "dyna": [None, "agent.target", "model.params"]}[arm]
    assert {re.match(r"\.state\.(\w+\.\w+)|\.starts", name)[1] for name in names} == set(wanted)


def test_planners_keep_nothing():
    options = changed(CARTPOLE.presets["lean"], {"episodes": 30}).resolved()
    arms = CARTPOLE.arms(options)
    assert arms["mpc"]().work.trained is None and arms["mpc_init"]().work.trained is not None


@pytest.mark.slow
def test_the_page_does_what_it_says(folder, tmp_path, monkeypatch):
    (tmp_path / "runs").mkdir()
    shutil.copytree(folder, tmp_path / "runs" / "cartpole-tuned")
    monkeypatch.chdir(tmp_path)
    names = {}
    for block in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL):
        exec(block, names)
    assert names["dreams"].reward.shape == (8, 50) and names["returns"].shape == (100,)


@pytest.mark.slow
def test_in_a_new_process_from_another_folder(folder, tmp_path):
    environment = os.environ | {"PYTHONPATH": f"{TESTS.parent}{os.pathsep}{TESTS}"}
    command = [sys.executable, "-m", "jaxdyna.experiments.evaluate", str(folder)]
    done = subprocess.run(
        command, check=True, cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    rows = [
        line.split(" | ") for line in done.stdout.splitlines() if line.startswith(("| d", "| m"))
    ]
    assert len(rows) == 4 and all(row[2] == row[3] for row in rows), done.stderr


def test_an_earlier_stage_is_played_again(folder, tmp_path, capsys):
    left = jaxdyna.load(folder)
    last, early = left.at(10**6), left.at(3)
    assert early.kept == {"model_free": [0, 1, 2], "dyna": [0, 1, 2]}  # whether kept or not
    with programs.kept():
        assert last.returns("dyna", 1, 5).tolist() == left.returns("dyna", 1, 5).tolist()
        earned = early.returns("dyna", 1).tolist()
        # as of a run that ends there, with the same seeds
        shorter = play(tmp_path / "out", "--episodes", "3", "--arms", "dyna")
        assert earned == jaxdyna.load(shorter).returns("dyna", 1).tolist()
        assert earned != left.returns("dyna", 1).tolist()
        nothing = {
            name: values for name, values in left.curves["dyna"].items() if "kept" not in name
        }
        bare = replace(left, curves={"dyna": nothing})  # as with --keep-runs 0
        bare.at(3).film(tmp_path / "a.gif", seed=2)
    with Image.open(tmp_path / "a.gif") as film:
        assert film.n_frames > 5
    assert evaluate.main([str(folder), "--stage", "3", "--arms", "dyna", "--seed", "2"]) == 0
    said = capsys.readouterr().out
    assert "after 3 real episodes" in said and "| dyna | 2 | - |" in said
    with pytest.raises(ValueError, match="stage"):
        left.at(0)


def test_a_run_that_broke_has_no_later_stage(folder):
    left = jaxdyna.load(folder)
    curves = left.curves["dyna"] | {"diverged": np.array([[0, 1.0], [0, 0], [0, 0]])}
    broken = replace(left, curves={"dyna": curves})
    assert broken.at(1).kept == {"dyna": [0, 1, 2]} and broken.at(2).kept == {"dyna": [1, 2]}
    with pytest.raises(ValueError, match=r"\[1, 2\] are kept, not 0: others broke before"):
        broken.at(2).returns("dyna", 0)
