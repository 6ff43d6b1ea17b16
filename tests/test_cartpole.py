"""CartPole agrees with Gymnasium's own."""

import gymnasium
import jax
import numpy as np
import pytest

from jaxdyna.envs import CartPole, CartPoleState

COUNT = 10_000


def gymnasium_step(env, state, action):
    env.reset(seed=0)
    env.state = state
    obs, reward, terminated, _, _ = env.step(int(action))
    return env.state, obs, reward, terminated


@pytest.fixture(scope="module")
def truth():
    """Gymnasium's answers to random states, inside the limits and beyond, and actions."""
    generator = np.random.default_rng(0)
    states = generator.uniform(-1, 1, (COUNT, 4)) * [3.0, 4.0, 0.3, 4.0]
    states = states.astype(np.float32).astype(np.float64)
    actions = generator.integers(0, 2, COUNT)
    env = gymnasium.make("CartPole-v1").unwrapped
    answers = [gymnasium_step(env, *pair) for pair in zip(states, actions, strict=True)]
    return states, actions, *(np.array(column) for column in zip(*answers, strict=True))


def our_steps(states, actions, dtype):
    env = CartPole()
    columns = [jax.numpy.asarray(column, dtype) for column in states.T]
    state = CartPoleState(*columns, time=jax.numpy.zeros(len(states), jax.numpy.int32))
    keys = jax.random.split(jax.random.key(0), len(states))
    step = jax.vmap(env.step, in_axes=(0, 0, 0, None))
    return jax.jit(step)(keys, state, actions, env.default_params)


def test_steps_agree_to_float32_rounding(truth):
    states, actions, _, obs, reward, terminated = truth
    ours, _, our_reward, our_terminated, truncated, _ = our_steps(states, actions, np.float32)
    assert ours.dtype == np.float32
    np.testing.assert_allclose(ours, obs, rtol=3e-6, atol=3e-7)
    np.testing.assert_array_equal(our_reward, reward)
    assert not truncated.any()
    near = (np.abs(np.abs(obs[:, 0]) - 2.4) < 1e-5) | (np.abs(np.abs(obs[:, 2]) - 0.2094395) < 1e-6)
    np.testing.assert_array_equal(our_terminated[~near], terminated[~near])
    assert near.sum() < 10 < terminated.sum() < COUNT - 10


def test_steps_agree_under_x64(truth):
    states, actions, next_states, obs, _, terminated = truth
    with jax.enable_x64(True):
        ours, state, _, our_terminated, _, _ = our_steps(states, actions, np.float64)
        columns = np.stack([state.x, state.x_dot, state.theta, state.theta_dot], axis=1)
    assert columns.dtype == np.float64
    np.testing.assert_allclose(columns, next_states, rtol=1e-13, atol=1e-15)
    np.testing.assert_array_equal(ours, obs)
    np.testing.assert_array_equal(our_terminated, terminated)


@pytest.mark.parametrize(("max_steps", "name"), [(200, "CartPole-v0"), (500, "CartPole-v1")])
@pytest.mark.filterwarnings("ignore:.*out of date.*:DeprecationWarning")
def test_episodes_agree(max_steps, name):
    """Ends and time limits included. The state is set to Gymnasium's before every step: falling is
    unstable, so that the last bit's difference would grow to 1e-4 within an episode.
    """
    theirs, env, lengths = gymnasium.make(name), CartPole(), []
    params = env.default_params.replace(max_steps=max_steps)
    with jax.enable_x64(True):
        step = jax.jit(env.step)
        for seed in range(6):
            obs, _ = theirs.reset(seed=seed)
            _, state = env.reset(jax.random.key(seed), params)
            for _ in range(max_steps):
                x, x_dot, theta, theta_dot = theirs.unwrapped.state
                state = state.replace(x=x, x_dot=x_dot, theta=theta, theta_dot=theta_dot)
                balanced = obs[2] + 0.5 * obs[3] + 0.05 * obs[1] + 0.02 * obs[0] > 0
                action = int(balanced) if seed % 2 else 1
                obs, *outcome, _ = theirs.step(action)
                ours, state, *our_outcome, _ = step(jax.random.key(0), state, action, params)
                np.testing.assert_array_equal(ours, obs)
                assert [float(our_outcome[0]), *map(bool, our_outcome[1:])] == outcome
                if any(outcome[1:]):
                    break
            lengths.append(int(state.time))
    assert max(lengths) == max_steps and min(lengths) < 100


def test_start_states_are_uniform_within_the_bound():
    env = CartPole()
    reset = jax.vmap(env.reset, in_axes=(0, None))
    obs, state = reset(jax.random.split(jax.random.key(0), 5000), env.default_params)
    assert np.abs(obs).max() <= 0.05
    np.testing.assert_allclose(obs.std(0), 0.1 / np.sqrt(12), rtol=0.05)
    np.testing.assert_array_equal(obs[:, 2], state.theta)
    assert (np.asarray(state.time) == 0).all()
