"""The linear-quadratic regulator of a fitted linear model."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from jaxdyna.agents import LinearRegulatorHParams, linear_regulator
from jaxdyna.agents.linear_regulator import LinearModel, regulator
from jaxdyna.dyna import Dyna, DynaConfig, DynaHParams, make_train
from jaxdyna.envs import CartPole
from jaxdyna.types import Transition

DRIFT = np.array([[0.0, 0.1, 0.0], [0.0, 0.0, 0.2], [0.3, 0.1, -0.1]], np.float32)
EFFECT = np.array([[0.0, 0.1, 0.0], [0.5, 0.0, -0.4], [-0.2, 0.0, 0.3]], np.float32)
HPARAMS = LinearRegulatorHParams()


def of_linear_world(seed):
    """Random transitions ``[4, 10]`` of it, half of each episode wrong, but masked out or without
    any weight.
    """
    draw = np.random.default_rng(seed)
    obs = draw.normal(size=(4, 10, 3)).astype(np.float32)
    action = draw.integers(0, 3, (4, 10))
    right = obs + obs @ DRIFT.T + EFFECT.T[action]
    fifth = np.arange(10)
    next_obs = np.where((fifth < 5)[:, None], right, np.where((fifth < 8)[:, None], 9.0, np.nan))
    flags = np.zeros((4, 10), bool)
    weight = np.broadcast_to(np.where(fifth < 5, 0.5, 0.0), (4, 10))
    mask = np.broadcast_to(fifth < 8, (4, 10))
    told = Transition(obs, action, weight * 0, next_obs, flags, flags, mask, weight)
    return jax.tree.map(jnp.asarray, told)


def test_it_recovers_a_linear_world_from_all_its_transitions():
    """Three of them leave open what the others tell."""
    agent = linear_regulator((3,), 3)
    state = agent.init(jax.random.key(0), HPARAMS)
    few = jax.tree.map(lambda leaf: leaf[:1, :3], of_linear_world(1))
    state, _ = agent.update(state, few, jax.random.key(1), HPARAMS)
    assert np.abs(state.model.drift - DRIFT).max() > 0.01
    state, metrics = agent.update(state, of_linear_world(2), jax.random.key(2), HPARAMS)
    np.testing.assert_allclose(state.model.drift, DRIFT, atol=2e-4)
    np.testing.assert_allclose(state.model.effect, EFFECT, atol=2e-4)
    assert 0 <= metrics["loss"] < 1e-6
    again, _ = agent.update(state, few, jax.random.key(3), HPARAMS)
    np.testing.assert_allclose(again.model.drift, DRIFT, atol=2e-4)


def best_first_push(model, cost, horizon):
    """Without Riccati: of all pushes over the horizon together, by one problem of least squares."""
    size, actions = model.effect.shape
    step = np.eye(size) + np.asarray(model.drift, float)
    push = np.asarray(model.effect - model.effect.mean(1, keepdims=True), float)
    rows = []
    for at in range(1, horizon + 1):
        moved = [np.linalg.matrix_power(step, at - 1 - by) @ push if by < at else 0 * push
                 for by in range(horizon)]  # fmt: skip
        rows.append(np.hstack(moved))
    free = np.vstack([np.linalg.matrix_power(step, at) for at in range(1, horizon + 1)])
    table = np.vstack([*rows, np.sqrt(cost) * np.eye(horizon * actions)])
    wanted = np.vstack([-free, np.zeros((horizon * actions, size))])
    return np.linalg.lstsq(table, wanted, rcond=None)[0][:actions]


@pytest.mark.parametrize("cost", [0.1, 3.0])
@pytest.mark.parametrize("horizon", [1, 2, 9])
def test_the_feedback_is_the_first_of_the_best_pushes(cost, horizon):
    model = LinearModel(jnp.array(DRIFT), jnp.array(EFFECT) + 1)
    said = regulator(model, cost, horizon)
    np.testing.assert_allclose(said, best_first_push(model, cost, horizon), atol=1e-4)


def test_a_far_horizon_is_the_fixed_point_of_the_riccati_equation():
    """As SciPy solves it, by another method (an ordered QZ decomposition)."""
    step, push = np.eye(3) + DRIFT, EFFECT - EFFECT.mean(1, keepdims=True)
    cost = scipy.linalg.solve_discrete_are(step, push, np.eye(3), 2 * np.eye(3))
    feedback = -np.linalg.solve(2 * np.eye(3) + push.T @ cost @ push, push.T @ cost @ step)
    said = regulator(LinearModel(jnp.array(DRIFT), jnp.array(EFFECT)), 2.0, 300)
    np.testing.assert_allclose(said, feedback, atol=1e-4)
    assert np.abs(np.linalg.eigvals(step)).max() > 1
    assert np.abs(np.linalg.eigvals(step + push @ np.asarray(said))).max() < 0.99


def test_random_actions_until_there_is_a_model():
    agent, obs = linear_regulator((3,), 3), jnp.array([1.0, -2.0, 0.5])
    state = agent.init(jax.random.key(0), HPARAMS)

    def actions(act, state):
        keys = jax.random.split(jax.random.key(1), 300)
        return set(np.asarray(jax.vmap(lambda key: act(state, obs, key, HPARAMS))(keys)).tolist())

    assert actions(agent.act, state) == {0, 1, 2} and len(actions(agent.act_greedy, state)) == 1
    state, _ = agent.update(state, of_linear_world(1), jax.random.key(2), HPARAMS)
    wanted = {int(np.argmax(np.asarray(state.params) @ np.asarray(obs)))}
    assert actions(agent.act, state) == actions(agent.act_greedy, state) == wanted


def test_it_balances_the_pole_from_its_second_or_third_episode_on():
    env = CartPole()
    dyna = Dyna(env, linear_regulator((4,), 2), memory=None)
    config = DynaConfig(num_episodes=6, num_steps=200)
    values = DynaHParams(HPARAMS, None, env.default_params)
    train = jax.jit(jax.vmap(make_train(dyna, config), (0, None)))
    lengths = np.asarray(train(jax.random.split(jax.random.key(0), 40), values)[1]["real_length"])
    assert lengths[:, 0].mean() < 40
    assert (lengths[:, 1] == 200).mean() > 0.6 and (lengths[:, 2:] == 200).mean() > 0.95
