"""The bridge to Gymnasium: registered names, its own checks, batches, and learned worlds."""

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from parts import ENV, MODEL, hparams, perfect_predict

import jaxdyna  # noqa: F401  (registers the environments)
from jaxdyna.envs import HostEnv, register
from jaxdyna.models import LearnedEnvironment, LearnedParams, uniform_start

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*out of date.*:DeprecationWarning"),
    pytest.mark.filterwarnings("ignore:.*Box observation space m.*:UserWarning"),
]
CARTPOLES = {"jaxdyna/CartPole-v0": 200, "jaxdyna/CartPole-v1": 500}
NAMES = [name for name in gymnasium.registry if name.startswith("jaxdyna/")]


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


def test_a_learned_world_is_a_gymnasium_environment():
    key = jax.random.key(0)
    world = LearnedEnvironment(ENV, MODEL.predict, uniform_start(-0.05, 0.05))
    weights = MODEL.init(key, hparams().model).params
    params = LearnedParams(weights, start=np.zeros(4, np.float32), max_steps=7)
    register("jaxdyna-test/Learned-v0", world, params)
    env = gymnasium.make("jaxdyna-test/Learned-v0")
    env.reset(seed=0)
    ends = []
    while not any(ends):
        ends.extend(env.step(0)[2:4])
    assert 2 <= len(ends) <= 2 * 7


def test_clear_errors():
    with pytest.raises(ValueError, match=r"call reset\(\) first"):
        HostEnv(ENV).step(0)
    world = LearnedEnvironment(ENV, perfect_predict, uniform_start(-0.1, 0.1))
    with pytest.raises(ValueError, match="cannot be rendered"):
        HostEnv(world, world.default_params, render_mode="rgb_array")


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
