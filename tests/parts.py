"""Small parts that several tests put together."""

import json

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna import rollout
from jaxdyna.agents import ReinforceConfig, ReinforceHParams, reinforce
from jaxdyna.dyna import Dream, Dyna, DynaConfig, DynaHParams
from jaxdyna.envs import CartPole
from jaxdyna.models import (
    LearnedEnvironment,
    LearnedParams,
    SupervisedConfig,
    SupervisedHParams,
    supervised,
)
from jaxdyna.models.evaluation import one_step_sums
from jaxdyna.replay import ring
from jaxdyna.types import Prediction

ENV = CartPole()
AGENT = reinforce((4,), 2, ReinforceConfig(hidden=(8,)))
MODEL = supervised(4, 2, SupervisedConfig(hidden=(16,), normalise=True, sum_loss=False))
LEARNED = LearnedEnvironment(ENV, MODEL.predict, lambda key, starts: ring.sample(starts, key, ()))
SMALL = DynaConfig(
    num_episodes=6, num_real_first=2, num_steps=20, model_updates=2, model_batch=8, dream_episodes=2
)

MODEL_FREE = Dyna(ENV, AGENT)
DYNA = Dyna(
    ENV,
    AGENT,
    MODEL,
    Dream(
        LEARNED,
        lambda state, hparams: LearnedParams(
            state.model.params, state.starts, hparams.dream, max_steps=20
        ),
    ),
    one_step_sums(MODEL.predict),
)
ORACLE = Dyna(ENV, AGENT, dream=Dream(ENV, lambda state, hparams: hparams.env))


def hparams(**changes):
    """Default hyper-parameters of a run."""
    return DynaHParams(
        ReinforceHParams(), SupervisedHParams(), ENV.default_params.replace(max_steps=20)
    ).replace(**changes)


def random_act(obs, key):
    """A uniformly random policy."""
    return jax.random.randint(key, (), 0, 2)


def perfect_predict(params, obs, action, key):
    """CartPole's own dynamics as a model's ``predict``."""
    _, state = ENV.reset(jax.random.key(0), params)
    state = state.replace(x=obs[0], x_dot=obs[1], theta=obs[2], theta_dot=obs[3])
    next_obs, _, reward, terminated, _, _ = ENV.step(key, state, action, params)
    return Prediction(next_obs, reward, terminated.astype(jnp.float32), jnp.float32(0))


def assert_same(left, right):
    """Bit for bit equality of two pytrees, keys included."""

    def raw(leaf):
        is_key = jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        return np.asarray(jax.random.key_data(leaf) if is_key else leaf)

    assert jax.tree.structure(left) == jax.tree.structure(right)
    for one, other in zip(jax.tree.leaves(left), jax.tree.leaves(right), strict=True):
        np.testing.assert_array_equal(raw(one), raw(other))


def assert_close(left, right, tolerance=1e-5):
    """Equality up to float32 rounding."""
    assert jax.tree.structure(left) == jax.tree.structure(right)
    for one, other in zip(jax.tree.leaves(left), jax.tree.leaves(right), strict=True):
        np.testing.assert_allclose(one, other, rtol=tolerance, atol=tolerance)


def returns_of(env, agent, hparams, steps, episodes):
    """Of so many real episodes of so many steps, learning after each: ``[episodes]``."""

    def episode(carry, _):
        state, key = carry
        key, key_play, key_learn = jax.random.split(key, 3)
        played = rollout(
            env, lambda obs, key: agent.act(state, obs, key, hparams), key_play,
            env.default_params.replace(max_steps=steps), 1,
        )  # fmt: skip
        state, _ = agent.update(state, played, key_learn, hparams)
        return (state, key), played.reward.sum()

    @jax.jit
    def train(key):
        key_init, key = jax.random.split(key)
        start = (agent.init(key_init, hparams), key)
        return jax.lax.scan(episode, start, length=episodes)[1]

    return train(jax.random.key(0))


def lines(folder):
    """Of the log in a run's folder, without the time; none is there twice."""
    said = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    assert all(line.pop("time") > 1e9 for line in said)
    by_run = {(line["arm"], line["seed"], line["step"]): line for line in said}
    assert len(by_run) == len(said)
    return by_run
