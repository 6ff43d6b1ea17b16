"""Pong's experiments: episodes, judging, true games beside dreams, command lines and reports."""

import json
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny
from parts import assert_same
from renamed import respelled

from jaxdyna.dyna.frames import draw_state
from jaxdyna.envs import CHANNELS, AtariPong, FrameStack, Palette, Pong, Replayed
from jaxdyna.envs.pong_screen import in_channels, middles, mixture_of, picture_of, shares_of
from jaxdyna.experiments.engine import InputError, Work, main
from jaxdyna.experiments.engine.storage import write_curves
from jaxdyna.experiments.pong import PARTS, frames, trained
from jaxdyna.experiments.pong.arms import Guided, GuidedParams, arms, points
from jaxdyna.experiments.pong.data import choose, collect, play, screens, states, take
from jaxdyna.experiments.pong.options import PAPER, TUNED
from jaxdyna.experiments.pong.world import OBJECTS, RULES, game_of, in_colours
from jaxdyna.experiments.report.sections import equal_episodes
from jaxdyna.experiments.report.summaries import comparisons
from jaxdyna.fields import changed
from jaxdyna.networks import SignedReward
from jaxdyna.optimizers import Trained
from jaxdyna.replay import frames as frame_replay
from jaxdyna.statistics import summarise
from jaxdyna.types import DynamicsModel, Prediction, Transition

OPTIONS = frames.PongFrames(steps=60, horizon=10)
GAME, PARAMS = game_of(OPTIONS), RULES.replace(max_steps=OPTIONS.steps)
SOURCE = states(GAME, PARAMS)


def run(*argv):
    return main(*PARTS, argv=argv, prog="python -m jaxdyna.experiments.pong")


def todays(command):
    return respelled(["pong", *command])[1:]


@pytest.fixture(scope="module")
def played():
    return jax.jit(lambda key: play(SOURCE, 60, 4, True, key))(jax.random.key(3))


def test_players_follow_the_ball():
    keys = jax.random.split(jax.random.key(0), 64)
    act = jax.jit(jax.vmap(choose, (None, None, None, None, None, 0)))

    def chosen(skill, ball, seen):
        actions = act(skill, 0.0, ball, 80.0, seen, jax.random.clone(keys))
        return set(np.asarray(actions).tolist())

    for ball, allowed in ((120.0, {3, 5}), (20.0, {2, 4}), (79.0, {0, 1})):
        assert chosen(1.0, ball, True) == allowed
    assert chosen(1.0, 0.0, False) == {0, 1}
    assert chosen(0.0, 0.0, True) == set(range(6))


def test_kept_episodes_look_as_the_stacked_game_does(played):
    """Frames are drawn when they are needed, and are the same as if they had been kept."""
    first = take(SOURCE, played, jnp.array([0]), jnp.array([0]))
    obs, _ = FrameStack(GAME).reset(jax.random.key(0), PARAMS)
    np.testing.assert_array_equal(first.obs[0], obs)
    times = jnp.arange(20, 40)
    later = take(SOURCE, played, jnp.ones_like(times), times)
    np.testing.assert_array_equal(later.next_obs[:-1], later.obs[1:])
    assert not later.truncated.any()
    assert take(SOURCE, played, jnp.array([0]), jnp.array([59])).truncated.all()

    @jax.jit
    def follows(time):
        now = jax.tree.map(lambda leaf: leaf[1, time], played.world)
        after = jax.tree.map(lambda leaf: leaf[1, time + 1], played.world)
        _, new, reward, *_ = GAME.step(jax.random.key(0), now, played.action[1, time], PARAMS)
        same = (GAME.frame(new) == GAME.frame(after)).all() & (reward == played.reward[1, time])
        return same, (now.wait == 0) & (after.wait == 0)

    same, unserved = jax.vmap(follows)(times)
    assert unserved.any() and same[unserved].all()  # only serves are random


@pytest.mark.parametrize("palette", [CHANNELS, Palette()], ids=["objects", "rgb"])
def test_only_the_chosen_objects_are_the_truth(played, palette):
    """Beside a model that sees nothing."""
    coloured = Pong(4, 4, palette)
    some = take(states(coloured, PARAMS), played, jnp.array([0, 1]), jnp.array([10, 11]))
    episodes = jax.tree.map(lambda leaf: leaf[:, None], some)
    example = jax.tree.map(lambda leaf: leaf[0], some)
    moment = jax.tree.map(lambda leaf: leaf[jnp.array([0, 1]), jnp.array([10, 11])], played.world)
    shapes = jax.tree.map(lambda leaf: leaf[0], moment)
    held = frame_replay.init(8, 4, example, beside=shapes)
    held = frame_replay.add(held, episodes, jax.tree.map(lambda leaf: leaf[:, None], moment))

    def blind(params, obs, action, key):
        empty = jnp.broadcast_to(jnp.array(palette.background, obs.dtype), obs[..., :3].shape)
        dark = jnp.concatenate([obs[..., 3:], empty], -1)
        return Prediction(dark, jnp.float32(7), jnp.float32(0), jnp.float32(0))

    def step(env):
        params = GuidedParams(PARAMS.replace(max_steps=1), held)

        @jax.jit
        def go(key):
            first, second = jax.random.split(key)
            _, state = env.reset(first, params)
            return env.step(second, state, jnp.int32(2), params)

        return go(jax.random.key(4))

    game = FrameStack(coloured)
    whole, _, reward, terminated, truncated, _ = step(Replayed(game, draw_state))
    assert abs(float(reward)) <= 1 and truncated and not terminated
    there = in_channels(whole[..., -3:], palette) > 0
    assert there.any((0, 1)).all()
    for truth in ((0,), (1,), (2,), (0, 1), (0, 2), (1, 2), (0, 1, 2)):
        seen, _, said, *_ = step(Guided(game, draw_state, blind, truth, palette))
        only = jnp.where(np.isin(np.arange(3), truth), there, False)
        np.testing.assert_array_equal(seen[..., -3:], picture_of(only, palette))
        np.testing.assert_array_equal(seen[..., :-3], whole[..., :-3])
        assert said == 7


def test_objects_are_told_by_their_colours(played):
    """Exactly on the game's frames; of a pale one there is less."""
    world = jax.tree.map(lambda leaf: leaf[:, 5::9], played.world)
    frame = jax.vmap(jax.vmap(Pong(4, 4, Palette()).frame))(world)
    masks = jax.vmap(jax.vmap(SOURCE.objects))(world)
    np.testing.assert_array_equal(shares_of(frame, Palette()), masks)
    np.testing.assert_array_equal(picture_of(masks, Palette()), frame)
    pale = mixture_of(masks / 3, Palette())
    np.testing.assert_allclose(shares_of(pale, Palette()), masks / 3, atol=1e-5)


def test_a_model_of_channels_sees_the_same_in_colours(played):
    """Its predictions are painted, and what it learns from is the game's frames in channels."""
    coloured, at = states(Pong(4, 4, Palette()), PARAMS), (jnp.array([0, 1]), jnp.array([10, 20]))
    plain, painted = take(SOURCE, played, *at), take(coloured, played, *at)
    np.testing.assert_array_equal(in_channels(painted.obs, Palette()), plain.obs)

    def predict(params, obs, action, key):
        turned = jnp.concatenate([obs[..., 3:], obs[::-1, :, -3:]], axis=-1)
        return Prediction(turned, jnp.float32(2), jnp.float32(0), obs.sum())

    def update(state, transitions, key, hparams):
        return transitions.obs, {"loss": transitions.next_obs.sum()}

    model = DynamicsModel(lambda key, hparams: None, predict, update)
    assert in_colours(model, CHANNELS) is model
    seeing = in_colours(model, Palette())
    said = seeing.predict(None, painted.obs[0], 0, jax.random.key(0))
    np.testing.assert_array_equal(said.next_obs[..., :-3], painted.obs[0, ..., 3:])
    np.testing.assert_array_equal(said.next_obs[..., -3:], painted.obs[0, ::-1, :, -3:])
    assert said.reward == 2 and said.uncertainty == plain.obs[0].sum()
    seen, metrics = seeing.update(None, painted, jax.random.key(1), None)
    np.testing.assert_array_equal(seen, plain.obs)
    assert metrics["loss"] == plain.next_obs.sum()


def test_a_serve_is_a_ball_that_was_not_there_or_far_away():
    """A ball that flies on, one that vanishes and comes back, one served at once elsewhere."""
    columns = [[4, 6, 8, 10], [4, None, None, 20], [38, 20, 18, 16]]
    ball = np.zeros((3, 4, 40, 40), bool)
    for episode, row in enumerate(columns):
        for time, column in enumerate(row):
            if column is not None:
                ball[episode, time, 7, column : column + 2] = True
    expected = [[True] * 3, [True, True, False], [False] * 3]
    np.testing.assert_array_equal(frames.unserved(jnp.array(ball)), expected)


@pytest.mark.parametrize("part", ["pong", "frames"])
def test_without_the_atari_extra_one_line_says_how_to_get_it(part, tmp_path, monkeypatch, capsys):
    (tmp_path / "report.md").write_text("an earlier run's")
    monkeypatch.setitem(sys.modules, "ale_py", None)
    with pytest.raises(SystemExit) as stop:
        run("--game", "ale", "--part", part, "--out", str(tmp_path))
    said = capsys.readouterr().err
    assert stop.value.code == 2 and "jaxdyna[atari]" in said and len(said.splitlines()) == 1
    assert (tmp_path / "report.md").exists()


def test_points_are_counted_for_either_side():
    reward = jnp.array([[1.0, -1, 0, -1, 1]])
    flags = jnp.zeros((1, 5), bool)
    real = Transition(reward, reward, reward, reward, flags, flags, jnp.arange(5)[None] < 4)
    said = points(real, None, PARAMS)
    assert (said["won"], said["lost"]) == (1, 2)


def test_a_middle_row_is_told_from_a_small_frame(played):
    state = jax.tree.map(lambda leaf: leaf[0, 12], played.world)
    row = middles(GAME.frame(state) > 0, 0, scale=4)[OBJECTS["own paddle"]]
    assert abs(float(row) - (int(state.own) + 8)) <= 3


def test_the_real_game_is_collected():
    pytest.importorskip("ale_py")
    source = screens(AtariPong(4, 4), 20)
    real = collect(source, 20, 2, True, jax.random.key(0))
    assert real.world.shape == (2, 21, 40, 40) and real.action.shape == (2, 20)
    seen = np.asarray(picture_of(source.objects(jnp.array(real.world)), source.palette))
    assert set(np.unique(seen)) == {0, 255}
    np.testing.assert_array_equal(source.keep(jnp.array(seen), None), real.world)
    sizes = seen[:, -1].any((1, 2))
    assert sizes[:, OBJECTS["own paddle"]].all() and sizes[:, OBJECTS["opponent"]].all()
    some = take(source, jax.tree.map(jnp.array, real), jnp.array([1]), jnp.array([19]))
    np.testing.assert_array_equal(some.next_obs[0, ..., -3:], seen[1, 20])


def test_arms_are_compared_where_all_have_played():
    """By hand: what only some runs have played does not count; differences are run by run."""
    short = np.repeat([[0.0, 1.0], [2.0, 3.0]], 10, axis=1)
    long = np.repeat([[-1.0, 0.0, 9.0], [0.0, 2.0, 9.0]], 10, axis=1)
    long[1, 25:] = np.nan
    played = {"model_free": long, "max_updates": long - 1, "dyna": short}

    def said(baselines, **played):
        curves = {name: {"real_return": returns} for name, returns in played.items()}
        return equal_episodes(baselines)(SimpleNamespace(curves=curves))

    text = said(("model_free", "max_updates"), **played)
    assert "episodes 1 to 20" in text
    assert "| arm | return | less that of model_free | less that of max_updates |" in text
    assert "| dyna | 1.50 | +1.25 | +2.25 |" in text
    assert "| max_updates | -0.75 | -1.00 | - |" in text
    assert said(("dyna",), dyna=short) == said(("placebo",), **played) == ""


def test_ratios_by_hand():
    """Unsolved runs count with what they played."""

    def arm(episodes, steps):
        solved, walked = np.array(episodes, float), np.array(steps, float)
        return {"episodes_to_solve": summarise(solved, at_least=41),
                "real_steps_to_solve": summarise(walked, at_least=600)}  # fmt: skip

    arms = {
        "model_free": arm([39, np.inf], [200, np.inf]), "dyna": arm([20, 20], [100, 300]),
        "more_updates": arm([40, 40], [400, 400]), "placebo": arm([np.inf] * 2, [np.inf] * 2),
    }  # fmt: skip
    assert comparisons({"arms": arms}, {"dyna": 0.62}) == [
        "dyna needs **0.50** of model_free's episodes (the paper's is 0.62).",
        "more_updates needs **1.00** of model_free's episodes.",
        "placebo needs **1.02** of model_free's episodes.",
        "Unsolved runs count with what they played.",
        "dyna needs **0.50** of more_updates's episodes.",
    ]
    steps = comparisons({"arms": arms}, {}, "real_steps_to_solve")
    assert steps[0].startswith("dyna needs **0.50** of model_free's real steps")


def test_a_signed_reward_is_a_difference_of_probabilities():
    head, features = SignedReward(), jnp.ones((5, 4))
    params = head.init(jax.random.key(0), features, features)
    zero = jax.tree.map(jnp.zeros_like, params)
    assert (head.apply(zero, features, features)[0] == 0).all()
    sure = {"params": {"Dense_0": {"kernel": jnp.zeros((4, 2)), "bias": jnp.array([9.0, -9.0])}}}
    np.testing.assert_allclose(head.apply(sure, features, features)[0], 1, atol=1e-3)


def test_weights_are_kept_and_found_again(tmp_path):
    """Where there are fewer models than runs, they are given in turn."""
    params = {"weight": jnp.arange(6.0).reshape(2, 3), "bias": jnp.ones(3)}
    model = DynamicsModel(lambda key, hparams: Trained(params, ()), None, None)
    work = Work(None, None, judge=lambda state, *rest: {"recall": jnp.float32(1)})
    learner = SimpleNamespace(model=Trained(params, ()))
    judged = trained.kept(work).judge(learner, None, None, None)
    assert judged.pop("recall") == 1
    twice = {name: np.stack([leaf, leaf + 10]) for name, leaf in judged.items()}
    write_curves(tmp_path / "curves.npz", {"l2@mixed": twice})
    options = changed(PAPER, {"models": tmp_path})
    found = trained.given(options, "l2", model)(SimpleNamespace(seed=np.array([4, 1])))
    swept = changed(options, {"hparams.agent.learning_rate": 0.5})
    assert trained.given(swept, "l2", model) == trained.given(options, "l2", model)
    made = options.resolved().models_made
    write_curves(tmp_path / "curves.npz", {"l2@mixed": {**twice, "more": np.ones(2)}})
    assert None is not made != options.resolved().models_made  # so that no run is resumed with them
    assert_same(found, jax.tree.map(lambda leaf: np.stack([leaf, leaf + 10]), params))
    wider = Trained(params | {"bias": jnp.ones(4)}, ())
    larger = DynamicsModel(lambda key, hparams: wider, None, None)
    for name, other in (("ours", model), ("l2", larger)):
        with pytest.raises(InputError, match=f"no model {name} is kept there"):
            trained.given(options, name, other).check()


@pytest.mark.parametrize(
    ("weight", "config", "said"),
    [(np.nan, {}, "a model l2 diverged"), (1.0, {"frames": "objects"}, "differ in --frames")],
)
def test_weights_of_another_world_or_none_are_refused(weight, config, said, tmp_path):
    model = DynamicsModel(lambda key, hparams: Trained(jnp.ones(3), ()), None, None)
    write_curves(tmp_path / "curves.npz", {"l2@mixed": {"weights_0": np.full((2, 3), weight)}})
    (tmp_path / "results.json").write_text(json.dumps({"config": config}))
    with pytest.raises(InputError, match=said):
        trained.given(changed(PAPER, {"models": tmp_path}), "l2", model).check()


@pytest.mark.slow
def test_models_are_trained_kept_and_dreamed_in(tmp_path, capsys):
    """The paper's preset in models that learn nothing more, and what it says without them."""
    sizes = ["--frames", "rgb", "--widths", "2", "2", "2", "--dense", "8"]
    models, out = tmp_path / "models", tmp_path / "out"
    train = [*todays(tiny.PONG_MODEL), *sizes, "--keep", "--policies", "mixed", "--loss-every", "1"]
    assert run(*train, "--arms", "l2", "--out", str(models)) == 0
    report = (models / "report.md").read_text()
    assert "(training.png)" in report and "| point lost |" in report
    play = [*tiny.NEW["pong-paper"][1:], "--models", str(models), "--seeds", "2", "--out", str(out)]
    assert run(*play, "--arms", "dyna_l2", "true_own_opponent") == 0
    results = json.loads((out / "results.json").read_text())
    assert results["config"]["dyna"]["model_updates"] == 0
    assert (np.isfinite(results["arms"]["dyna_l2"]["final_return"]["per_seed"])).all()
    with pytest.raises(SystemExit, match="2"):  # before anything is played
        run(*play[:-1], str(tmp_path / "none"), "--arms", "model_free", "dyna")
    assert "no model ours is kept there" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):
        run(*play, "--widths", "2", "2", "3", "--arms", "dyna_l2")
    assert "its models differ in --widths" in capsys.readouterr().err


def test_arms_differ_by_what_their_names_say():
    options = TUNED.resolved()
    made = {name: make() for name, make in arms(options).items()}
    assert made["dyna"].work == made["placebo"].work != made["dyna_l2"].work
    assert not made["placebo"].hparams.model_trains
    assert made["more_updates"].hparams.agent.fake_share == 0
    again = arms(options)
    assert all(make().work == made[name].work for name, make in again.items())
    assert len({arm.work for arm in made.values()}) == len(made) - 1
    sticky = changed(options, {"hparams.env.repeat_action_probability": 0.25})
    game = arms(sticky)["oracle"]().hparams.env
    assert game == made["oracle"].hparams.env.replace(repeat_action_probability=0.25)
    assert game.max_steps == options.steps


@pytest.mark.parametrize("arm", ["model_free", pytest.param("true_own", marks=pytest.mark.slow)])
def test_learning_leaves_what_the_contract_asks_for(arm, tmp_path):
    assert run(*todays(tiny.PONG), "--arms", arm, "--out", str(tmp_path)) == 0
    results = json.loads((tmp_path / "results.json").read_text())
    assert results["experiment"] == "pong" and set(results["arms"]) == {arm}
    said = results["arms"][arm]
    for name in ("episodes_to_solve", "first_solved", "real_steps_to_solve", "final_return"):
        assert len(said[name]["per_seed"]) == 1
    assert "last 20 reaches 0" in said["solve_rule"]
    report = (tmp_path / "report.md").read_text()
    assert "(returns.png)" in report and (tmp_path / "returns.png").exists()


@pytest.mark.slow
def test_frame_prediction_leaves_tables_and_figures(tmp_path):
    assert run(*todays(tiny.PONG_MODEL), "--arms", "ours", "--out", str(tmp_path)) == 0
    results = json.loads((tmp_path / "results.json").read_text())
    assert set(results["arms"]) == {"ours@random", "ours@mixed"}
    judged = results["arms"]["ours@mixed"]
    assert set(judged["recall"]) == set(OBJECTS) and set(judged["dreams"]["lit"]) == {"1", "2"}
    report = (tmp_path / "report.md").read_text()
    for name in ("fig9.png", "fig9_random.png", "horizon.png", "dream.gif"):
        assert f"({name})" in report and (tmp_path / name).exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--game", "ale", "--arms", "true_ball"], "--game jax"),
        (["--game", "ale", "--arms", "oracle"], "--game jax"),
        (["--arms"], "--arms"),
        (["--steps", "0"], "--steps"),
        (["--game", "ale", "--arms", "true_own_opponent"], "--arms true_own_opponent"),
        (["--convolutions", "8", "0", "8"], "--convolutions"),
        (["--hparams.env.max-steps", "9"], "--steps"),
        (["--hparams.env.opponent-rest", "0"], "--hparams.env.opponent-rest"),
        (["--game", "ale", "--hparams.env.opponent-speed", "1"], "--game jax"),
        (["--game", "ale", "--hparams.env.serve-delay", "9"], "--game jax"),
        (["--dropout", "1"], "--dropout"),
        (["--part", "frames", "--dropout", "-0.1"], "--dropout"),
        (["--scale", "3"], "--scale"),
        (["--part", "frames", "--steps", "701"], "between 1 and 700"),
        (["--part", "frames", "--horizon", "195"], "--horizon"),
        (["--part", "frames", "--policies"], "--policies"),
    ],
)
def test_bad_input_is_one_line(arguments, words, capsys):
    with pytest.raises(SystemExit) as stop:
        run(*arguments)
    said = capsys.readouterr().err
    assert stop.value.code == 2 and words in said and len(said.splitlines()) == 1
