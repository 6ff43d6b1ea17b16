"""CartPole agrees with Gymnasium's own."""

from functools import partial
from itertools import cycle, islice

import gymnasium
import jax
import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st

from jaxdyna.envs import CartPole, CartPoleParams, CartPoleState

COUNT, STEPS = 10_000, 500


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


@jax.jit
def steps_of(states, times, actions, params):
    """The answers to states ``[T, 4]``, each by itself."""

    def one(state, time, action):
        return CartPole().step(jax.random.key(0), CartPoleState(*state, time), action, params)

    return jax.vmap(one)(states, times, actions)


@st.composite
def games(draw):
    """Other physics, a start, what is done over and over (0, 1, or else what balances)."""
    number = partial(st.floats, allow_subnormal=False)
    physics = {
        "gravity": draw(number(0, 30)), "masscart": draw(number(0.1, 10)),
        "masspole": draw(number(0.01, 5)), "length": draw(number(0.1, 3)),
        "force_mag": draw(number(-20, 20)), "tau": draw(number(0.001, 0.05)),
        "theta_threshold": draw(number(0.01, 1.5)), "x_threshold": draw(number(0.1, 5)),
        "max_steps": draw(st.integers(1, STEPS)),
    }  # fmt: skip
    start = draw(st.tuples(*[number(-0.05, 0.05)] * 4))
    return CartPoleParams(**physics), start, draw(st.lists(st.integers(0, 4), min_size=1))


@given(game=games())
@example(game=(CartPoleParams(max_steps=200), (0.03,) * 4, [2]))
@example(game=(CartPoleParams(max_steps=500), (0.03,) * 4, [2]))
@settings(max_examples=60)
def test_episodes_agree(game):
    """Ends and time limits included. Every step begins at Gymnasium's state: falling is unstable,
    so that the last bit's difference would grow to 1e-4 within an episode.
    """
    params, start, choices = game
    theirs = gymnasium.make(
        "CartPole-v1", max_episode_steps=params.max_steps, disable_env_checker=True
    )
    theirs.reset(seed=0)
    truth = theirs.unwrapped
    for name in ("gravity", "masscart", "masspole", "length", "force_mag", "tau"):
        setattr(truth, name, getattr(params, name))
    truth.total_mass = params.masspole + params.masscart
    truth.polemass_length = params.masspole * params.length
    truth.x_threshold, truth.theta_threshold_radians = params.x_threshold, params.theta_threshold
    truth.state = start
    states, actions, outcomes = [], [], []
    for choice in islice(cycle(choices), params.max_steps):
        x, x_dot, theta, theta_dot = truth.state
        balanced = theta + 0.5 * theta_dot + 0.05 * x_dot + 0.02 * x > 0
        states.append(truth.state)
        actions.append(choice if choice < 2 else int(balanced))
        outcomes.append(theirs.step(actions[-1])[:4])
        if any(outcomes[-1][2:]):
            break
    played = len(actions)
    states, actions = (np.resize(part, (STEPS, *np.shape(part)[1:])) for part in (states, actions))
    with jax.enable_x64(True):
        answers = steps_of(states, np.arange(STEPS), actions, params)
        ours, _, *our_outcomes, _ = jax.tree.map(lambda leaf: np.asarray(leaf)[:played], answers)
    obs, reward, terminated, truncated = map(np.array, zip(*outcomes, strict=True))
    np.testing.assert_allclose(ours, obs, rtol=2e-7, atol=1e-12)
    np.testing.assert_array_equal(our_outcomes, [reward, terminated, truncated & ~terminated])
    assert our_outcomes[1][-1] or our_outcomes[2][-1]


def test_start_states_are_uniform_within_the_bound():
    env = CartPole()
    reset = jax.vmap(env.reset, in_axes=(0, None))
    obs, state = reset(jax.random.split(jax.random.key(0), 5000), env.default_params)
    assert np.abs(obs).max() <= 0.05
    np.testing.assert_allclose(obs.std(0), 0.1 / np.sqrt(12), rtol=0.05)
    np.testing.assert_array_equal(obs[:, 2], state.theta)
    assert (np.asarray(state.time) == 0).all()
