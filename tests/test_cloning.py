"""Experts in real episodes, and agents that imitate them."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from parts import AGENT, DYNA, ENV, SMALL, assert_close, assert_same, hparams, random_act

from jaxdyna import rollout, sweep
from jaxdyna.agents import CloningConfig, ReinforceConfig, ReinforceHParams, cloning, policy_logits
from jaxdyna.agents.cloning import cross_entropy_loss, margin_loss
from jaxdyna.dyna import Expert, make_train

EXAMPLE = (jax.ShapeDtypeStruct((4,), np.float32), jax.ShapeDtypeStruct((), np.int32))
LOGITS = policy_logits(2, ReinforceConfig(hidden=(8,)))
CONFIG = CloningConfig(updates=60, batch=32, capacity=600, learning_rate=0.05)
IMITATOR = cloning(AGENT, LOGITS, EXAMPLE, CONFIG)
UPDATE, UPDATE_EXPERT = jax.jit(IMITATOR.update), jax.jit(IMITATOR.update_expert)
OWN = jax.jit(AGENT.update)


def lean_to(state, obs, key, hparams):
    """Pushes to the side that the pole falls to: an expert that needs no model."""
    return (obs[2] + obs[3] > 0).astype(jnp.int32)


@jax.jit
def _shown(key):
    def act(obs, key):
        return lean_to(None, obs, key, None)

    return rollout(ENV, act, key, ENV.default_params, 8, num_steps=60)


def shown(seed):
    return _shown(jax.random.key(seed))


@jax.jit
def at_random(key):
    return rollout(ENV, random_act, key, ENV.default_params, 4, num_steps=20)


def test_losses_by_hand():
    outputs = jnp.array([1.0, 2.0, 0.5])
    expected = optax.softmax_cross_entropy_with_integer_labels(outputs, 1)
    np.testing.assert_allclose(cross_entropy_loss(outputs, 1), expected, rtol=1e-6)
    np.testing.assert_allclose(margin_loss(outputs, 0), 1.8)
    np.testing.assert_allclose(margin_loss(outputs, 1), 0.0)
    np.testing.assert_allclose(margin_loss(outputs, 1, margin=1.5), 0.5)


def test_what_was_shown_is_imitated():
    state = IMITATOR.init(jax.random.key(0), ReinforceHParams())
    new, metrics = UPDATE_EXPERT(state, shown(1), jax.random.key(2), ReinforceHParams())
    assert jax.tree.structure(new) == jax.tree.structure(state)
    assert np.isfinite(metrics["loss"])
    seen = shown(3)
    choose = jax.jit(jax.vmap(jax.vmap(LOGITS, (None, 0)), (None, 0)))
    chosen = choose(new.imitating, seen.obs)
    right = (chosen.argmax(-1) == seen.action)[seen.mask]
    assert right.mean() > 0.9
    assert new.shown.size == shown(1).mask.sum()
    assert_same(new.agent, state.agent)  # who shows may plan by what the agent has learned
    nothing = shown(1)._replace(mask=shown(1).mask & False)
    assert_same(UPDATE_EXPERT(state, nothing, jax.random.key(2), ReinforceHParams())[0], state)


def test_imitation_is_taken_over_when_the_agent_goes_on_by_itself():
    state = IMITATOR.init(jax.random.key(0), ReinforceHParams())
    state, _ = UPDATE_EXPERT(state, shown(1), jax.random.key(2), ReinforceHParams())
    obs = shown(3).obs[0, 5]
    action = IMITATOR.act(state, obs, jax.random.key(3), ReinforceHParams())
    imitating = state.agent.replace(params=state.imitating)
    assert action == AGENT.act(imitating, obs, jax.random.key(3), ReinforceHParams())
    episodes = at_random(jax.random.key(4))
    for _ in range(2):  # once only: then the agent's own parameters count
        expected, _ = OWN(imitating, episodes, jax.random.key(5), ReinforceHParams())
        state, _ = UPDATE(state, episodes, jax.random.key(5), ReinforceHParams())
        assert_close(state.agent, expected)
        imitating = expected


def test_imitation_waits_where_there_is_nothing_to_learn_from():
    """As dreams are that are masked out as long as an expert plays, who may plan by the agent."""
    state = IMITATOR.init(jax.random.key(0), ReinforceHParams())
    state, _ = UPDATE_EXPERT(state, shown(1), jax.random.key(2), ReinforceHParams())
    episodes = at_random(jax.random.key(4))
    nothing = episodes._replace(weight=np.zeros(episodes.mask.shape, np.float32))
    assert_same(UPDATE(state, nothing, jax.random.key(5), ReinforceHParams())[0], state)


def test_it_is_the_agent_in_everything_else():
    state = IMITATOR.init(jax.random.key(0), ReinforceHParams())
    episodes = at_random(jax.random.key(1))
    own, _ = OWN(state.agent, episodes, jax.random.key(2), ReinforceHParams())
    new, _ = UPDATE(state, episodes, jax.random.key(2), ReinforceHParams())
    assert_close(new.agent, own)
    assert_same(new.shown, state.shown)
    obs = episodes.obs[0, 0]
    action = IMITATOR.act(state, obs, jax.random.key(3), ReinforceHParams())
    assert action == AGENT.act(state.agent, obs, jax.random.key(3), ReinforceHParams())


def test_whose_episode_it_is_by_hand():
    """The agent's are the first N = 2, and those after the expert's."""
    assert Expert(lean_to, 2).plays(np.arange(6), SMALL).tolist() == [0, 0, 1, 1, 0, 0]
    assert Expert(lean_to).plays(np.arange(6), SMALL).tolist() == [0, 0, 1, 1, 1, 1]


TEN = replace(SMALL, num_episodes=10, num_steps=60, dream_updates=0)
LONGER = hparams(env=ENV.default_params.replace(max_steps=60))
WITHOUT = DYNA._replace(dream=None, diagnose=None)


def run(dyna):
    return jax.jit(make_train(dyna, TEN))(jax.random.key(0), LONGER)


@pytest.fixture(scope="module")
def alone():
    return run(WITHOUT)


def test_an_expert_plays_its_own_episodes_and_is_imitated(alone):
    expert = Expert(lean_to, episodes=3)
    state, metrics = run(WITHOUT._replace(agent=IMITATOR, expert=expert))
    mine, others = np.asarray(metrics["real_return"]), np.asarray(alone[1]["real_return"])
    np.testing.assert_array_equal(mine[:2], others[:2])  # N = 2: the agent gathers data
    assert mine[2:5].min() > 40 and mine[5:].mean() > 1.5 * others[5:].mean()
    assert state.agent.shown.added == mine[2:5].sum()
    trained = np.isfinite(np.asarray(metrics["model_loss"]))
    np.testing.assert_array_equal(trained, [True] * 4 + [False] * 6)  # then no one looks at it


def test_an_expert_sees_the_model_and_may_play_to_the_end():
    def act(state, obs, key, hparams):
        prediction = DYNA.model.predict(state.model.params, obs, jnp.int32(1), key)
        return (prediction.next_obs[2] > 0).astype(jnp.int32)

    def learn_nothing(state, transitions, key, hparams):
        return state, {"loss": jnp.float32(0)}

    agent = AGENT._replace(update_expert=learn_nothing)
    dyna = WITHOUT._replace(agent=agent, expert=Expert(act))
    keys = jax.random.split(jax.random.key(0), 2)
    _, metrics = sweep(make_train(dyna, TEN), keys, LONGER)
    np.testing.assert_array_equal(metrics["agent_loss"][0, :, 2:], 0)
    assert np.isfinite(metrics["model_loss"]).all()


@pytest.mark.parametrize("name", ["updates", "batch", "capacity", "learning_rate"])
def test_clear_errors(name):
    with pytest.raises(ValueError, match=f"{name} is 0"):
        replace(CONFIG, **{name: 0})
