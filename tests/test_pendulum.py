"""Pendulum agrees with Gymnasium's own."""

from functools import partial

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st

from jaxdyna.envs import Pendulum, PendulumParams, PendulumState

COUNT, STEPS = 5_000, 40


def gymnasium_step(env, state, action):
    env.state = state
    obs, reward, *_ = env.step(action)
    return env.state, obs, reward


@pytest.fixture(scope="module")
def truth():
    """Gymnasium's answers to random states, far beyond a turn, and torques, in bounds or not."""
    generator = np.random.default_rng(0)
    states = generator.uniform(-1, 1, (COUNT, 2)) * [9.0, 8.0]
    states = states.astype(np.float32).astype(np.float64)
    actions = generator.uniform(-3, 3, (COUNT, 1)).astype(np.float32).astype(np.float64)
    env = gymnasium.make("Pendulum-v1").unwrapped
    answers = [gymnasium_step(env, *pair) for pair in zip(states, actions, strict=True)]
    return states, actions, *(np.array(column) for column in zip(*answers, strict=True))


@jax.jit
def steps_of(states, times, actions, params):
    """The answers to states ``[N, 2]``, each by itself."""

    def one(state, time, action):
        return Pendulum().step(jax.random.key(0), PendulumState(*state, time), action, params)

    return jax.vmap(one)(states, times, actions)


def our_steps(states, actions, dtype, params=PendulumParams()):
    times = np.arange(len(states))
    answers = steps_of(states.astype(dtype), times, actions.astype(dtype), params)
    return jax.tree.map(np.asarray, answers)


def test_steps_agree_to_float32_rounding(truth):
    states, actions, _, obs, reward = truth
    ours, _, our_reward, terminated, truncated, _ = our_steps(states, actions, np.float32)
    assert ours.dtype == our_reward.dtype == np.float32
    np.testing.assert_allclose(ours, obs, rtol=3e-6, atol=3e-6)
    turn = np.abs(np.abs((states[:, 0] + np.pi) % (2 * np.pi) - np.pi) - np.pi) < 1e-5
    np.testing.assert_allclose(our_reward[~turn], reward[~turn], rtol=3e-5, atol=3e-6)
    assert not terminated.any() and (truncated == (np.arange(COUNT) >= 199)).all()


def test_steps_agree_under_x64(truth):
    states, actions, next_states, obs, reward = truth
    with jax.enable_x64(True):
        ours, state, our_reward, *_ = our_steps(states, actions, np.float64)
    columns = np.stack([state.theta, state.theta_dot], axis=1)
    assert columns.dtype == np.float64
    np.testing.assert_allclose(columns, next_states, rtol=1e-13, atol=1e-14)
    np.testing.assert_allclose(our_reward, reward, rtol=1e-13, atol=1e-14)
    np.testing.assert_allclose(ours, obs, rtol=2e-7, atol=1e-12)


@st.composite
def games(draw):
    """Other physics, a start, torques, and how long it lasts."""
    number = partial(st.floats, allow_subnormal=False)
    physics = {
        "gravity": draw(number(0, 30)), "mass": draw(number(0.1, 10)),
        "length": draw(number(0.2, 3)), "tau": draw(number(0.001, 0.1)),
        "max_speed": draw(number(0.5, 20)), "max_steps": draw(st.integers(1, STEPS)),
    }  # fmt: skip
    start = draw(st.tuples(number(-4, 4), number(-1, 1)))
    return PendulumParams(**physics), start, draw(st.lists(number(-3, 3), min_size=1, max_size=9))


@given(game=games())
@example(game=(PendulumParams(max_steps=STEPS), (0.1, 0.0), [0.5, -2.5]))
@settings(max_examples=40)
def test_episodes_agree(game):
    """Time limits included. Every step begins at Gymnasium's state."""
    params, start, torques = game
    theirs = gymnasium.make(
        "Pendulum-v1", max_episode_steps=params.max_steps, g=params.gravity,
        disable_env_checker=True,
    )  # fmt: skip
    theirs.reset(seed=0)
    truth = theirs.unwrapped
    truth.m, truth.l, truth.dt, truth.max_speed = (
        params.mass, params.length, params.tau, params.max_speed)  # fmt: skip
    truth.state = np.array(start)
    actions = np.resize(torques, (STEPS, 1))
    states, outcomes = [], []
    for action in actions[: params.max_steps]:
        states.append(truth.state)
        outcomes.append(theirs.step(action)[:4])
    played = len(states)
    with jax.enable_x64(True):
        answers = our_steps(np.resize(states, (STEPS, 2)), actions, np.float64, params)
        ours, _, *our_outcomes, _ = jax.tree.map(lambda leaf: leaf[:played], answers)
    obs, reward, terminated, truncated = map(np.array, zip(*outcomes, strict=True))
    np.testing.assert_allclose(ours, obs, rtol=2e-7, atol=1e-10)
    np.testing.assert_allclose(our_outcomes[0], reward, rtol=1e-10, atol=1e-10)
    np.testing.assert_array_equal(our_outcomes[1:], [terminated, truncated])
    assert truncated[-1] and not truncated[:-1].any()


def test_start_states_are_uniform_within_the_bounds():
    env = Pendulum()
    reset = jax.vmap(env.reset, in_axes=(0, None))
    obs, state = reset(jax.random.split(jax.random.key(0), 5000), env.default_params)
    drawn = np.stack([state.theta, state.theta_dot])
    assert (np.abs(drawn).max(1) <= [np.float32(np.pi), 1]).all()
    np.testing.assert_allclose(drawn.std(1), np.array([np.pi, 1]) / np.sqrt(3), rtol=0.05)
    np.testing.assert_allclose(obs[:, 0], np.cos(state.theta), atol=1e-6)
    back = jax.vmap(env.state_of)(obs)
    np.testing.assert_allclose(back.theta, state.theta, atol=2e-6)


def test_gymnasium_is_not_given_more_torque_than_it_says():
    env = gymnasium.make("jaxdyna/Pendulum-v0")
    env.reset(seed=0)
    assert env.step([0.5])[1] < 0  # numbers of 64 bits too
    with pytest.raises(ValueError, match="is not in Box"):
        env.step(np.float32([2.5]))


def test_frames_show_the_rod_where_it_is():
    red = np.array([204, 77, 77])
    for theta, place in ((0.0, (65, 100)), (np.pi, (135, 100)), (np.pi / 2, (100, 65))):
        state = PendulumState(jnp.float32(theta), jnp.float32(0), jnp.int32(0))
        frame = np.asarray(Pendulum().render(state, PendulumParams()))
        assert frame.shape == (200, 200, 3) and (frame[place] == red).all()
        assert (frame == red).all(-1).sum() < 200**2 / 10
