"""What every environment, agent and dynamics model owes the others."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from parts import ENV, assert_close, assert_same, random_act

from jaxdyna import rollout
from jaxdyna.agents import ReinforceConfig, ReinforceHParams, reinforce
from jaxdyna.agents.reinforce import over_batch, per_step, within_episode
from jaxdyna.envs import CartPole, Catch, GreyFrames, Maze, Pong
from jaxdyna.models import (
    LearnedEnvironment,
    LearnedParams,
    SupervisedConfig,
    SupervisedHParams,
    supervised,
    uniform_start,
)
from jaxdyna.models.evaluation import one_step, one_step_sums, open_loop
from jaxdyna.statistics import r_squared

ADAM = {"sum_loss": False, "optimizer": optax.adam, "normalise": True}
MODELS = {
    "paper": supervised(4, 2, SupervisedConfig()),
    "scaled": supervised(4, 2, SupervisedConfig(sum_loss=False, normalise=True, hidden=(32,))),
    "delta": supervised(4, 2, SupervisedConfig(**ADAM, delta=True, one_hot=True, hidden=(32,))),
    "ensemble": supervised(4, 2, SupervisedConfig(**ADAM, delta=True, ensemble=3, hidden=(32,))),
}
AGENTS = {
    rule.__name__: reinforce((4,), 2, ReinforceConfig(advantage=rule))
    for rule in (within_episode, over_batch, per_step)
}


def learned_world():
    model = MODELS["delta"]
    world = LearnedEnvironment(ENV, model.predict, uniform_start(-0.05, 0.05))
    weights = model.init(jax.random.key(0), SupervisedHParams()).params
    return world, LearnedParams(weights, start=jnp.zeros(4), max_steps=9)


WORLDS = {
    "cartpole": lambda: (CartPole(), CartPole().default_params),
    "maze": lambda: (Maze(), Maze().default_params),
    "catch": lambda: (Catch(), Catch().default_params),
    "catch_frames": lambda: (Catch(frames=True), Catch().default_params),
    "pong": lambda: (Pong(), Pong().default_params),
    "grey": lambda: (GreyFrames(Pong()), Pong().default_params),
    "learned": learned_world,
}


def poisoned(episodes):
    """NaN wherever nothing is."""

    def poison(leaf):
        mask = episodes.mask.reshape(episodes.mask.shape + (1,) * (leaf.ndim - 2))
        floats = jnp.issubdtype(leaf.dtype, jnp.floating)
        return jnp.where(mask, leaf, jnp.nan) if floats else leaf

    return jax.tree.map(poison, episodes)


@jax.jit
def play(key):
    return rollout(ENV, random_act, key, ENV.default_params, 40, num_steps=60)


@pytest.fixture(scope="module")
def episodes():
    return play(jax.random.key(1))


@pytest.mark.parametrize("world", WORLDS)
def test_environment(world):
    env, params = WORLDS[world]()
    assert hash(env) == hash(WORLDS[world]()[0]) or world == "learned"
    obs, state = env.reset(jax.random.key(0), params)
    space = env.observation_space(params)
    assert obs.shape == space.shape and obs.dtype == space.dtype
    assert env.action_space(params).n == env.num_actions
    answer = env.step(jax.random.key(1), state, jnp.int32(0), params)
    jitted = jax.jit(env.step)(jax.random.key(1), state, jnp.int32(0), params)
    assert_close(jitted, answer)
    next_obs, next_state, reward, terminated, truncated, info = answer
    assert next_obs.shape == obs.shape and isinstance(info, dict)
    assert jax.tree.structure(next_state) == jax.tree.structure(state)
    assert jax.tree.map(jnp.shape, next_state) == jax.tree.map(jnp.shape, state)
    assert reward.shape == terminated.shape == truncated.shape == ()
    assert terminated.dtype == jnp.bool_ and jnp.result_type(truncated) == jnp.bool_
    assert params.max_steps == env.default_params.replace(max_steps=params.max_steps).max_steps


@pytest.mark.parametrize("name", AGENTS)
def test_agent(name, episodes):
    agent, hparams = AGENTS[name], ReinforceHParams()
    state = agent.init(jax.random.key(0), hparams)
    action = agent.act(state, episodes.obs[0, 0], jax.random.key(1), hparams)
    assert action.shape == () and action.dtype == jnp.int32
    new, metrics = agent.update(state, episodes, jax.random.key(2), hparams)
    assert jax.tree.structure(new) == jax.tree.structure(state)
    assert np.isfinite(metrics["loss"])
    assert not np.array_equal(jax.tree.leaves(new.params)[0], jax.tree.leaves(state.params)[0])
    assert_close(jax.jit(agent.update)(state, episodes, jax.random.key(2), hparams)[0], new)


@pytest.mark.parametrize("name", AGENTS)
def test_agent_weighs_transitions(name, episodes):
    agent, hparams, key = AGENTS[name], ReinforceHParams(), jax.random.key(3)
    state = agent.init(jax.random.key(0), hparams)

    @jax.jit
    def update(transitions):
        return agent.update(state, transitions, jax.random.clone(key), hparams)[0]

    def weighing(weight):
        return episodes._replace(weight=jnp.full(episodes.mask.shape, weight))

    assert_same(update(weighing(0.0)), state)
    assert_same(update(episodes._replace(mask=episodes.mask & False)), state)
    assert_close(update(weighing(1.0)), update(episodes))
    assert_same(update(poisoned(episodes)), update(episodes))
    full, half = (update(weighing(weight)).params for weight in (1.0, 0.5))
    for new, less, old in zip(*map(jax.tree.leaves, (full, half, state.params)), strict=True):
        np.testing.assert_allclose(less - old, (new - old) / 2, atol=2e-5)


@pytest.mark.parametrize("name", MODELS)
def test_model(name, episodes):
    model, hparams = MODELS[name], SupervisedHParams(learning_rate=1e-3)
    state = model.init(jax.random.key(0), hparams)
    obs, action = episodes.obs[0, 0], episodes.action[0, 0]
    prediction = model.predict(state.params, obs, action, jax.random.key(1))
    assert prediction.next_obs.shape == (4,) and 0 <= prediction.terminated <= 1
    assert prediction.reward.shape == prediction.uncertainty.shape == ()
    assert (prediction.uncertainty > 0) == (name == "ensemble")
    key = jax.random.key(2)
    eager = model.update(state, episodes, key, hparams)
    assert_close(
        jax.jit(model.update)(state, episodes, jax.random.clone(key), hparams), eager, 1e-4
    )


@pytest.mark.parametrize("name", MODELS)
def test_model_ignores_what_is_masked(name, episodes):
    model, hparams, key = MODELS[name], SupervisedHParams(learning_rate=1e-3), jax.random.key(2)
    state = model.init(jax.random.key(0), hparams)

    @jax.jit
    def update(transitions):
        return model.update(state, transitions, jax.random.clone(key), hparams)[0]

    assert_same(update(poisoned(episodes)), update(episodes))
    assert_same(update(episodes._replace(mask=episodes.mask & False)), state)


@pytest.mark.parametrize("name", MODELS)
def test_model_learns_the_world(name, episodes):
    """Full-batch training beats its start, and the better ones the guess of a mean change."""
    model = MODELS[name]
    learning_rate = {"paper": 2e-5, "scaled": 0.02}.get(name, 5e-3)
    hparams = SupervisedHParams(learning_rate)

    @jax.jit
    def train(key):
        def step(carry, _):
            state, key = carry
            key, key_now = jax.random.split(key)
            state, metrics = model.update(state, episodes, key_now, hparams)
            return (state, key), metrics["loss"]

        key_init, key = jax.random.split(key)
        return jax.lax.scan(step, (model.init(key_init, hparams), key), length=300)

    (state, _), losses = train(jax.random.key(4))
    assert losses[-1] < 0.5 * losses[0]
    new = play(jax.random.key(5))
    sums = jax.jit(one_step_sums(model.predict))(state.params, new, jax.random.key(6))
    assert sums["count"] == new.mask.sum() and sums["end_true"] == new.terminated.sum()
    target = "state" if name in ("paper", "scaled") else "change"
    explained = r_squared(
        sums["state_error"], sums[f"{target}_sum"], sums[f"{target}_square"], sums["count"]
    )
    print(name, explained)
    assert explained.min() > {"paper": 0.0, "scaled": 0.9}.get(name, 0.7)


def test_open_loop_feeds_predictions_back(episodes):
    model = MODELS["delta"]
    params = model.init(jax.random.key(0), SupervisedHParams()).params
    obs, action = episodes.obs[0, 0], episodes.action[0, :5]
    free = open_loop(model.predict, params, obs, action, jax.random.key(1))
    for time in range(5):
        expected = model.predict(params, obs, action[time], jax.random.key(2))
        np.testing.assert_allclose(free.next_obs[time], expected.next_obs, rtol=1e-5, atol=1e-6)
        obs = expected.next_obs
    first = one_step(model.predict, params, episodes, jax.random.key(3))
    assert first.next_obs.shape == episodes.obs.shape
    np.testing.assert_allclose(first.next_obs[0, 0], free.next_obs[0], rtol=1e-5, atol=1e-6)


def test_reinforce_learns_cartpole():
    """A few dozen updates from batches of real episodes more than double the return."""
    agent, hparams = AGENTS["per_step"], ReinforceHParams(learning_rate=0.02)

    @jax.jit
    def train(key):
        def step(carry, _):
            state, key = carry
            key, key_play, key_update = jax.random.split(key, 3)

            def act(obs, key):
                return agent.act(state, obs, key, hparams)

            played = rollout(ENV, act, key_play, ENV.default_params, 16)
            state, _ = agent.update(state, played, key_update, hparams)
            return (state, key), (played.reward * played.mask).sum(1).mean()

        key_init, key = jax.random.split(key)
        return jax.lax.scan(step, (agent.init(key_init, hparams), key), length=60)[1]

    returns = train(jax.random.key(0))
    assert returns[-5:].mean() > 2.5 * returns[:5].mean()


def test_clear_errors():
    with pytest.raises(ValueError, match="at least 1"):
        SupervisedConfig(ensemble=0)
