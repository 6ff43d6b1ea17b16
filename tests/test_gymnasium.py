"""The bridge to Gymnasium: registered names, its own checks, batches, and learned worlds."""

import os
import pickle
import subprocess
import sys
from copy import copy, deepcopy
from dataclasses import replace
from pathlib import Path

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from parts import ENV, MODEL, hparams, perfect_predict

import jaxdyna
from jaxdyna.envs import Catch, FrameStack, HostEnv, Maze, register
from jaxdyna.models import LearnedEnvironment, LearnedParams, uniform_start

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*out of date.*:DeprecationWarning"),
    pytest.mark.filterwarnings("ignore:.*Box observation space m.*:UserWarning"),
]
CARTPOLES = {"jaxdyna/CartPole-v0": 200, "jaxdyna/CartPole-v1": 500}
DREAM = "jaxdyna-test/Learned-v0"
NAMES = [name for name in gymnasium.registry if name.startswith("jaxdyna/")]


@pytest.mark.filterwarnings("ignore:.*symmetric and normalized")  # of actions
@pytest.mark.parametrize("name", NAMES)
def test_gymnasium_accepts_it(name):
    check_env(gymnasium.make(name, render_mode="rgb_array").unwrapped)


@pytest.mark.parametrize(("name", "limit"), CARTPOLES.items())
def test_time_limit_truncates(name, limit):
    env = gymnasium.make(name)
    obs, _ = env.reset(seed=1)
    for _ in range(limit):
        assert env.observation_space.contains(obs)
        action = int(obs[2] + 0.5 * obs[3] + 0.05 * obs[1] + 0.02 * obs[0] > 0)
        obs, reward, terminated, truncated, _ = env.step(action)
        assert reward == 1
    assert truncated and not terminated


def test_a_seed_decides_everything():
    def play(seed):
        env = gymnasium.make("jaxdyna/CartPole-v0")
        first, _ = env.reset(seed=seed)
        again, _ = env.reset()
        return first, again

    assert all(np.array_equal(*pair) for pair in zip(play(3), play(3), strict=True))
    first, again = play(3)
    assert not np.array_equal(first, again)
    assert not np.array_equal(first, play(4)[0])


def test_frames_show_the_cart_move():
    env = gymnasium.make("jaxdyna/CartPole-v0", render_mode="rgb_array")
    env.reset(seed=0)
    before = env.render()
    for _ in range(8):
        env.step(1)
    after = env.render()
    assert before.shape == after.shape and before.dtype == np.uint8
    dark = [np.argwhere(frame.sum(-1) < 200)[:, 1].mean() for frame in (before, after)]
    assert dark[1] > dark[0]


@pytest.mark.parametrize("name", NAMES)
def test_vector_environments(name):
    envs = gymnasium.make_vec(name, num_envs=3, render_mode="rgb_array")
    obs, _ = envs.reset(seed=0)
    for _ in range(3):
        assert envs.observation_space.contains(obs)
        obs, reward, terminated, truncated, _ = envs.step(envs.action_space.sample())
        assert reward.shape == terminated.shape == truncated.shape == (3,)
    frames = envs.render()
    assert len(frames) == 3 and frames[0].dtype == np.uint8 and frames[0].shape[-1] == 3


def test_the_maze_truncates_after_200_steps():
    env = gymnasium.make("jaxdyna/Maze-v0")
    obs, _ = env.reset(seed=1)
    assert obs.shape == (16, 16, 3) and obs[15, 0, 2] == obs[0, 15, 1] == 255
    ends = [env.step(4)[2:4] for _ in range(200)]
    assert ends == [(False, False)] * 199 + [(False, True)]


def test_info_says_what_happened():
    env = gymnasium.make("jaxdyna/Maze-v0")
    env.reset(seed=0)
    info = env.step(4)[4]
    assert {"collision", "at_goal"} <= set(info) and not info["at_goal"]
    many = gymnasium.make_vec("jaxdyna/Maze-v0", num_envs=3)
    many.reset(seed=0)
    infos = many.step(np.full(3, 4))[4]
    assert infos["at_goal"].shape == (3,) and infos["_at_goal"].all()


def test_vector_environment_resets_in_the_step_after_the_end():
    envs = gymnasium.make_vec("jaxdyna/CartPole-v0", num_envs=3)
    obs, _ = envs.reset(seed=0)
    assert envs.observation_space.contains(obs)
    ended = np.zeros(3, bool)
    resets = 0
    for _ in range(60):
        obs, reward, terminated, truncated, _ = envs.step(np.array([0, 1, 0]))
        np.testing.assert_array_equal(reward, np.where(ended, 0, 1))
        assert (np.abs(obs[ended]) <= 0.05).all()
        resets += ended.sum()
        ended = terminated | truncated
    assert resets >= 6


@pytest.fixture(scope="module", autouse=True)
def dream():
    """A learned CartPole, registered."""
    world = LearnedEnvironment(ENV, MODEL.predict, uniform_start(-0.05, 0.05))
    weights = MODEL.init(jax.random.key(0), hparams().model).params
    register(DREAM, world, LearnedParams(weights, start=np.zeros(4, np.float32), max_steps=7))


def test_a_learned_world_is_a_gymnasium_environment():
    env = gymnasium.make(DREAM)
    env.reset(seed=0)
    ends = []
    while not any(ends):
        ends.extend(env.step(0)[2:4])
    assert 2 <= len(ends) <= 2 * 7


def test_clear_errors():
    with pytest.raises(ValueError, match=r"call reset\(\) first"):
        HostEnv(ENV).step(0)
    world = LearnedEnvironment(ENV, perfect_predict, uniform_start(-0.1, 0.1))
    blind = replace(world, real=Catch())
    for error in (ValueError, TypeError):  # upon a TypeError Stable-Baselines3 goes on without
        with pytest.raises(error, match="cannot be rendered"):
            HostEnv(blind, blind.default_params.replace(start=jnp.zeros(50)), "rgb_array")
    with pytest.raises(ValueError, match="nothing is registered"):
        HostEnv("jaxdyna-test/Forgotten-v0")


def test_an_action_may_be_of_jax_and_must_be_a_number():
    env = HostEnv(ENV)
    env.reset(seed=0)
    env.step(jnp.int32(1))
    with pytest.raises(ValueError, match="is not in Discrete"):
        env.step(True)


def test_after_the_end_nothing_is_paid_and_gymnasium_warns():
    env = HostEnv(ENV, ENV.default_params.replace(max_steps=1))
    env.reset(seed=0)
    obs, reward, *end, _ = env.step(0)
    assert reward == 1 and end == [False, True]
    with pytest.warns(UserWarning, match="after the end"):
        again, reward, *still, _ = env.step(0)
    assert reward == 0 and still == end
    np.testing.assert_array_equal(again, obs)
    env.reset(seed=0)
    assert env.step(0)[1] == 1


def length(env, limit=1000):
    """Steps of an episode in which the pole is balanced."""
    obs, _ = env.reset(seed=1)
    for step in range(1, limit + 1):
        action = int(obs[2] + 0.5 * obs[3] + 0.05 * obs[1] + 0.02 * obs[0] > 0)
        obs, *_, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            return step
    return None


@pytest.mark.parametrize("limit", [7, 510, -1])
def test_max_episode_steps_is_the_only_clock(limit):
    env = gymnasium.make("jaxdyna/CartPole-v1", max_episode_steps=limit)
    assert length(env, 520) == (limit if limit > 0 else None)


def test_max_episode_steps_of_many():
    envs = gymnasium.make_vec("jaxdyna/CartPole-v1", num_envs=2, max_episode_steps=7)
    envs.reset(seed=0)
    truncated = [envs.step(np.array([step % 2] * 2))[3].tolist() for step in range(7)]
    assert truncated == [[False] * 2] * 6 + [[True] * 2]
    with pytest.raises(ValueError, match="at least 1"):
        gymnasium.make_vec("jaxdyna/CartPole-v1", max_episode_steps=0)


@pytest.mark.parametrize(("name", "limit"), [*CARTPOLES.items(), (DREAM, 7)])
def test_specs_know_the_limit_and_survive_json(name, limit):
    spec = gymnasium.spec(name)
    assert spec.max_episode_steps == limit
    again = gymnasium.make(EnvSpec.from_json(gymnasium.make(name).spec.to_json()))
    assert again.spec.max_episode_steps == limit
    np.testing.assert_array_equal(again.reset(seed=3)[0], gymnasium.make(name).reset(seed=3)[0])


@pytest.mark.parametrize("name", ["jaxdyna/CartPole-v0", DREAM])
@pytest.mark.parametrize("copied", [lambda env: pickle.loads(pickle.dumps(env)), deepcopy, copy])
def test_environments_are_pickled_and_copied_in_the_midst_of_an_episode(name, copied):
    env = gymnasium.make(name).unwrapped
    env.reset(seed=0)
    env.step(0)
    again = copied(env)
    for one, other in zip(env.step(1)[:4], deepcopy(again).step(1)[:4], strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_dream_is_unpickled_where_nothing_of_it_is_registered(tmp_path):
    env = gymnasium.make(DREAM)
    obs, _ = env.reset(seed=0)
    (tmp_path / "env").write_bytes(pickle.dumps(env))
    (tmp_path / "obs").write_bytes(obs.tobytes())
    code = (
        "import pickle; env = pickle.load(open('env', 'rb'));"
        "assert env.reset(seed=0)[0].tobytes() == open('obs', 'rb').read(); env.step(1)"
    )
    environment = os.environ | {"PYTHONPATH": str(Path(jaxdyna.__file__).parents[1])}
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, check=True)


def test_a_dream_shows_what_the_real_environment_would():
    """As Stable-Baselines3's ``make_vec_env`` asks for it."""
    env = gymnasium.make(DREAM, render_mode="rgb_array")
    obs, _ = env.reset(seed=0)
    seen = ENV.render(ENV.state_of(obs), ENV.default_params)
    np.testing.assert_array_equal(env.render(), seen)
    assert len(gymnasium.make_vec(DREAM, num_envs=2, render_mode="rgb_array").metadata) == 3


def test_a_dream_of_several_vectors_shows_the_newest():
    world = LearnedEnvironment(FrameStack(ENV, 2), lambda *inputs: None, lambda key, start: start)
    seen = jnp.float32([0.3, 0, 0.2, 0, -0.5, 0, 0.1, 0])
    newest = ENV.render(ENV.state_of(seen[4:]), ENV.default_params)
    np.testing.assert_array_equal(world.render(world.state_of(seen), None), newest)


def test_a_dream_of_frames_shows_its_newest():
    stack = FrameStack(Maze(size=4, num_obstacles=1))
    world = LearnedEnvironment(stack, lambda *inputs: None, lambda key, start: start)
    obs, _ = stack.reset(jax.random.key(0), stack.default_params)
    frame = world.render(world.state_of(obs.at[..., :9].set(0)), None)
    assert frame.shape == (256, 256, 3) and frame.dtype == np.uint8
    np.testing.assert_array_equal(frame[::64, ::64], obs[..., 9:])


@pytest.mark.parametrize("name", ["jaxdyna/CartPole-v0", DREAM])
def test_an_episode_begins_within_given_bounds(name):
    env, theirs = gymnasium.make(name), gymnasium.make("CartPole-v1")
    bounds = {"low": -0.3, "high": 0.2}
    obs, _ = env.reset(seed=4, options=bounds)
    np.testing.assert_allclose(obs, theirs.reset(seed=4, options=bounds)[0], rtol=1e-6)
    after = env.step(1)[0]
    if name != DREAM:
        np.testing.assert_allclose(after, theirs.step(1)[0], rtol=1e-4, atol=1e-6)
    assert (abs(env.reset(seed=4, options={})[0]) <= 0.05).all()


@pytest.mark.parametrize("name", ["jaxdyna/CartPole-v0", DREAM])
def test_an_episode_begins_where_it_is_told(name):
    env, obs = gymnasium.make(name), np.float32([0.1, -0.2, 0.05, 0.3])
    begun, _ = env.reset(options={"obs": obs})
    np.testing.assert_array_equal(begun, obs)
    state = env.unwrapped.env.state_of(jnp.asarray(obs))
    action = jnp.int32(1)
    after = env.unwrapped.env.step(jax.random.key(0), state, action, env.unwrapped.params)[0]
    np.testing.assert_allclose(env.step(1)[0], after, rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("jaxdyna/CartPole-v0", {"low": 1, "high": 0}),
        ("jaxdyna/CartPole-v0", {"obs": [0.0, 0.0]}),
        ("jaxdyna/Maze-v0", {"obs": np.zeros((16, 16, 3))}),
        ("jaxdyna/CartPole-v0", {"start": 0}),
        ("jaxdyna/Maze-v0", {"low": 0, "high": 1}),
    ],
)
def test_options_that_mean_nothing_are_refused(name, options):
    for env in (gymnasium.make(name), gymnasium.make_vec(name, num_envs=2)):
        with pytest.raises(ValueError, match="options"):
            env.reset(options=options)
