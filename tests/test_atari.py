"""The Atari game as a pure function, against Gymnasium's own; skipped without the atari extra."""

import signal
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from parts import assert_same

from jaxdyna.envs import CHANNELS, AtariPong, FrameStack, Palette, atari
from jaxdyna.envs.gymnasium import check_atari
from jaxdyna.envs.pong_screen import masks_by_colour, paint
from jaxdyna.experiments.engine import main
from jaxdyna.experiments.engine.progress import Bars
from jaxdyna.experiments.engine.storage import read_curves
from jaxdyna.experiments.pong import PARTS
from jaxdyna.experiments.pong.arms import scores
from jaxdyna.rollout import rollout

ONE_NO_OP = 1


def run(*argv):
    return main(*PARTS, argv=argv, prog="python -m jaxdyna.experiments.pong")


def test_without_the_extra_a_line_says_how_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "ale_py", None)
    with pytest.raises(ImportError, match=r"pip install 'jaxdyna\[atari\]'"):
        check_atari()
    with pytest.raises(ImportError, match=r"pip install 'jaxdyna\[atari\]'"):
        AtariPong()


def test_a_game_that_cannot_be_read_refuses_what_reads_it(capsys):
    with pytest.raises(SystemExit) as error:
        run("--game", "ale", "--arms", "dyna", "true_ball")
    assert error.value.code == 2
    assert "--arms true_ball dream in the pure game" in capsys.readouterr().err


@pytest.fixture
def env():
    pytest.importorskip("ale_py")
    return AtariPong(scale=1)


def played(env, actions, key, **params):
    """Screens and rewards of one game, by jitted steps."""
    params = env.default_params.replace(**params)
    obs, state = jax.jit(env.reset)(key, params)
    step, seen, rewards = jax.jit(env.step), [obs], []
    for action in actions:
        obs, state, reward, *_ = step(key, state, action, params)
        seen.append(obs)
        rewards.append(float(reward))
    return np.stack(seen), np.array(rewards)


def test_plays_as_gymnasium_does(env):
    theirs = gymnasium.make("ALE/Pong-v5", repeat_action_probability=0.0, obs_type="rgb")
    theirs.reset(seed=0)
    theirs.unwrapped.ale.act(0)
    actions = np.random.default_rng(0).integers(0, env.num_actions, 150)
    screens, rewards = played(env, actions, jax.random.key(0), no_ops=ONE_NO_OP)
    for number, action in enumerate(actions):
        screen, reward, *_ = theirs.step(action)
        assert reward == rewards[number]
        np.testing.assert_array_equal(screen, screens[number + 1])
    assert rewards.min() == -1, "no point was played"
    assert env.action_space(None).n == theirs.action_space.n


def test_batches_episodes_and_repeats_are_the_same_game(env):
    stack = FrameStack(AtariPong(scale=4))
    params = stack.default_params

    def act(obs, key):
        return jax.random.randint(key, (), 0, stack.num_actions)

    def play(key):
        return rollout(stack, act, key, params, 3, num_steps=12)

    keys = jax.random.split(jax.random.key(1), 2)
    both = jax.jit(jax.vmap(play))(jax.random.clone(keys))
    one = jax.jit(play)
    for number in range(2):
        alone = one(jax.random.clone(keys)[number])
        jax.tree.map(
            lambda many, one, at=number: np.testing.assert_array_equal(many[at], one), both, alone
        )
    assert len(np.unique(both.obs[:, :, -1].reshape(6, -1), axis=0)) > 1, "all games are the same"


def test_a_small_frame_shows_the_objects_of_the_screen(env):
    small = AtariPong(scale=4)
    actions = [2] * 30
    screens, _ = played(env, actions, jax.random.key(2))
    frames, _ = played(small, actions, jax.random.key(2))
    masks = masks_by_colour(jnp.asarray(screens), 4, Palette())
    shown = paint(jnp.zeros(frames.shape, jnp.uint8), masks, CHANNELS)
    np.testing.assert_array_equal(frames, shown)
    assert frames[-1].any((0, 1)).all(), "an object is missing"


def test_who_does_nothing_loses_a_whole_game(env):
    small = AtariPong(frame_skip=8, scale=8)
    points = scores(
        small, lambda obs, key: jnp.int32(0), jax.random.key(3), small.default_params, games=2
    )
    np.testing.assert_array_equal(points, [-21, -21])


def test_the_emulators_own_limit_is_no_end_of_the_game(env, monkeypatch):
    """Of 20 frames here, the one of doing nothing among them; the literature's is of 108,000."""
    few = {"repeat_action_probability": 0.0, "max_num_frames_per_episode": 20}

    def emulator(game):
        made = gymnasium.make(f"ALE/{game}-v5", **few)
        made.reset(seed=0)
        return made.unwrapped.ale

    monkeypatch.setattr(atari, "atari_emulator", emulator)
    monkeypatch.setattr(atari, "_here", threading.local())
    monkeypatch.setattr(atari, "_threads", lambda: ThreadPoolExecutor(1))
    params = env.default_params.replace(no_ops=ONE_NO_OP)
    _, state = env.reset(jax.random.key(0), params)
    ends = []
    for _ in range(5):
        _, state, _, terminated, truncated, _ = env.step(jax.random.key(0), state, 0, params)
        ends.append((bool(terminated), bool(truncated)))
    assert ends == [(False, False)] * 4 + [(False, True)]


@pytest.mark.parametrize(
    ("settings", "words"), [({"frame_skip": 0}, "at least 1"), ({"scale": 3}, "divisor of 160")]
)
def test_settings_that_cannot_be_are_refused(settings, words):
    with pytest.raises(ValueError, match=words):
        AtariPong(**settings)


TINY = [
    "--game", "ale", "--quick", "--seeds", "1", "--episodes", "24", "--steps", "12",
    "--dyna.dream-steps", "4", "--agent.updates", "1", "--agent.batch", "2",
    "--arms", "model_free",
]  # fmt: skip


@pytest.mark.slow
def test_interrupted_and_resumed_is_uninterrupted(env, tmp_path, monkeypatch):
    """Ctrl-C in the middle of learning: the emulator's games go on bit for bit."""
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert run(*TINY, "--out", str(whole)) == 0
    tell = Bars.tell

    def interrupt(self, name, stage, done, over):
        tell(self, name, stage, done, over)
        if stage == "running" and done:
            signal.raise_signal(signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(Bars, "tell", interrupt)
        assert run(*TINY, "--out", str(parts)) == 130
    assert any((parts / "checkpoints").glob("model_free*"))
    assert run(*TINY, "--out", str(parts), "--resume") == 0
    assert_same(*(read_curves(folder / "curves.npz")["model_free"] for folder in (whole, parts)))
    assert "the Atari 2600 game" in (parts / "report.md").read_text()
