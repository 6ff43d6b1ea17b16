"""The one rollout, on true and learned environments."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from parts import (
    ENV,
    LEARNED,
    MODEL,
    assert_close,
    assert_same,
    hparams,
    perfect_predict,
    random_act,
)

from jaxdyna import rollout
from jaxdyna.envs import CartPole
from jaxdyna.models import (
    DreamHParams,
    LearnedEnvironment,
    LearnedParams,
    probability_rule,
    threshold_rule,
    uncertain,
)
from jaxdyna.models.environment import as_observed
from jaxdyna.types import Prediction

PARAMS = ENV.default_params


@partial(jax.jit, static_argnums=(1, 2))
def _play(key, episodes, num_steps):
    return rollout(ENV, random_act, key, PARAMS, episodes, num_steps=num_steps)


def play(key=0, episodes=16, num_steps=None):
    return _play(jax.random.key(key), episodes, num_steps)


def test_shapes_and_dtypes():
    episodes = play()
    assert episodes.obs.shape == episodes.next_obs.shape == (16, 200, 4)
    for part in (episodes.action, episodes.reward, episodes.terminated, episodes.mask):
        assert part.shape == (16, 200)
    assert episodes.mask.dtype == episodes.terminated.dtype == episodes.truncated.dtype == bool


def test_every_episode_is_one_run_and_ends_once():
    episodes = jax.tree.map(np.asarray, play())
    lengths = episodes.mask.sum(1)
    assert lengths.min() >= 8 and lengths.max() < 200
    for row, length in enumerate(lengths):
        assert episodes.mask[row, :length].all()
        ends = episodes.terminated[row] | episodes.truncated[row]
        assert ends.nonzero()[0].tolist() == [length - 1]
        np.testing.assert_array_equal(
            episodes.obs[row, 1:length], episodes.next_obs[row, : length - 1]
        )
        assert episodes.reward[row].sum() == length
        np.testing.assert_array_equal(
            episodes.obs[row, length:],
            np.tile(episodes.next_obs[row, length - 1], (200 - length, 1)),
        )
        assert (episodes.reward[row, length:] == 0).all()


def test_termination_and_truncation_are_apart():
    episodes = play(episodes=64, num_steps=15)
    assert episodes.mask.shape == (64, 15)
    outlasted = np.asarray(episodes.mask.all(1) & ~episodes.terminated[:, -1])
    assert 0 < outlasted.sum() < 64
    np.testing.assert_array_equal(episodes.truncated[:, -1], outlasted)
    assert not np.asarray(episodes.truncated[:, :-1]).any()
    assert not np.asarray(episodes.truncated & episodes.terminated).any()


def test_stored_transitions_are_the_environments_own():
    episodes = play(episodes=4)
    valid = np.asarray(episodes.mask)
    predict = jax.jit(jax.vmap(perfect_predict, (None, 0, 0, None)))
    truth = predict(PARAMS, episodes.obs[valid], episodes.action[valid], jax.random.key(1))
    np.testing.assert_allclose(truth.next_obs, episodes.next_obs[valid], rtol=1e-5, atol=1e-7)
    np.testing.assert_array_equal(truth.terminated > 0, episodes.terminated[valid])


def sample_rule(prediction, params, key):
    return jax.random.bernoulli(key, prediction.terminated)


@pytest.mark.parametrize(
    "rule", [threshold_rule, pytest.param(sample_rule, marks=pytest.mark.slow)]
)
def test_a_perfect_model_is_the_true_environment(rule):
    """Same keys, same policy: the wrapped true dynamics give the true rollout: bit for bit where
    every operation runs by itself, to rounding where the compiler fuses the two programs.
    """
    world = LearnedEnvironment(
        ENV, perfect_predict, lambda key, start: ENV.reset(key, start)[0], rule
    )
    params = LearnedParams(model=PARAMS, start=PARAMS, max_steps=30)
    true_params = PARAMS.replace(max_steps=30)

    def play_both(episodes, num_steps=None):
        settings = {"num_steps": num_steps}
        real = rollout(ENV, random_act, jax.random.key(5), true_params, episodes, **settings)
        return real, rollout(world, random_act, jax.random.key(5), params, episodes, **settings)

    real, fake = jax.jit(play_both, static_argnums=0)(32)
    assert 0 < np.asarray(real.truncated).sum() < 32
    for name in ("action", "reward", "terminated", "truncated", "mask"):
        np.testing.assert_array_equal(getattr(real, name), getattr(fake, name))
    assert_close(real, fake, 2e-6)
    if rule is sample_rule:
        with jax.disable_jit():
            assert_same(*play_both(2, num_steps=4))


def test_dreams_end_by_the_threshold_and_the_horizon():
    weights = MODEL.init(jax.random.key(0), hparams().model).params
    world = LearnedEnvironment(ENV, MODEL.predict, lambda key, start: start)
    dream = jax.jit(lambda key, params: rollout(world, random_act, key, params, 3, num_steps=9))
    for threshold, length in ((1.0, 9), (0.0, 1)):
        params = LearnedParams(weights, jnp.zeros(4), DreamHParams(threshold), max_steps=9)
        episodes = dream(jax.random.key(1), params)
        np.testing.assert_array_equal(episodes.mask.sum(1), [length] * 3)
    assert LEARNED.num_actions == 2
    assert LEARNED.observation_space(params) == ENV.observation_space(PARAMS)


def counting_world(max_steps, ends=99):
    """Counts its steps, and ends after so many."""
    return COUNTING, LearnedParams(float(ends), jnp.zeros(4), max_steps=max_steps)


def _count(ends, obs, action, key):
    end = jnp.where(obs[0] + 1 >= ends, 1.0, 0.0)
    return Prediction(obs + 1, jnp.float32(1), end, jnp.float32(0))


COUNTING = LearnedEnvironment(ENV, _count, lambda key, start: start)


@pytest.mark.parametrize(("ends", "outcomes"), [(99, [0, 0, 2]), (3, [0, 0, 1]), (2, [0, 1])])
def test_a_dream_is_truncated_at_its_horizon(ends, outcomes):
    """1: terminated, 2: truncated; never both."""
    env, params = counting_world(3, ends)
    step, (_, state) = jax.jit(env.step), env.reset(jax.random.key(0), params)
    for outcome in outcomes:
        _, state, _, *ended, _ = step(jax.random.key(1), state, jnp.int32(0), params)
        assert ended[0] + 2 * ended[1] == outcome


def test_nothing_moves_after_the_end():
    """What is recorded of the padding is the last state's."""
    env, params = counting_world(9, ends=2)
    play = jax.jit(
        lambda key: rollout(
            env, random_act, key, params, 2, num_steps=5, record=lambda state, *_: state.time
        )
    )
    np.testing.assert_array_equal(play(jax.random.key(0))[1], [[0, 1, 2, 2, 2]] * 2)


def test_rules_of_the_end_by_hand():
    """Above the thresholds, not at them."""
    params = LearnedParams(None, hparams=DreamHParams(0.5, 1.0))

    def ends(rule, terminated, uncertainty):
        said = Prediction(jnp.zeros(1), jnp.float32(0), terminated, uncertainty)
        return bool(rule(said, params, None))

    cases = [(0.5, 1.0), (0.51, 1.0), (0.5, 1.01)]
    assert [ends(threshold_rule, *case) for case in cases] == [False, True, True]
    assert [ends(probability_rule, *case) for case in cases] == [False, True, False]


def test_dreams_are_broken_off_in_doubt():
    def predict(params, obs, action, key):
        obs = obs + 1
        return Prediction(obs, jnp.float32(1), jnp.float32(0.9), obs[0])

    world = LearnedEnvironment(
        ENV, predict, lambda key, start: start, probability_rule, truncates=uncertain
    )
    dream = jax.jit(lambda key, params: rollout(world, random_act, key, params, 2, num_steps=9))
    for doubt, end, length in ((3.0, 1.0, 4), (3.0, 0.5, 1), (np.inf, 1.0, 9)):
        params = LearnedParams(None, jnp.zeros(4), DreamHParams(end, doubt), max_steps=9)
        episodes = dream(jax.random.key(1), params)
        np.testing.assert_array_equal(episodes.mask.sum(1), [length] * 2)
        last = episodes.terminated[:, length - 1], episodes.truncated[:, length - 1]
        np.testing.assert_array_equal(last, [[end < 0.9] * 2, [end == 1.0] * 2])


def test_jit_is_eager_and_rows_do_not_depend_on_each_other():
    def run(key, params):
        return rollout(ENV, random_act, key, params, 3, num_steps=12)

    eager, jitted = run(jax.random.key(2), PARAMS), jax.jit(run)
    assert_close(jitted(jax.random.key(2), PARAMS), eager)
    keys = jax.random.split(jax.random.key(3), 4)
    together = jax.jit(jax.vmap(run, (0, None)))(keys, PARAMS)
    for row, key in enumerate(jax.random.split(jax.random.key(3), 4)):
        assert_close(jax.tree.map(lambda leaf, row=row: leaf[row], together), jitted(key, PARAMS))


def test_a_swept_horizon_needs_no_second_program():
    def lengths(max_steps, num_steps=200):
        params = PARAMS.replace(max_steps=max_steps)
        real = rollout(ENV, random_act, jax.random.key(0), params, 8, num_steps=num_steps)
        return real.mask.sum(1)

    short, long = jax.jit(jax.vmap(lengths))(jnp.array([5, 200]))
    np.testing.assert_array_equal(short, [5] * 8)
    np.testing.assert_array_equal(long, play(episodes=8).mask.sum(1))
    with pytest.raises(ValueError, match="give rollout num_steps"):
        jax.jit(partial(lengths, num_steps=None))(jnp.int32(5))


def test_an_environment_may_answer_in_plain_python():
    class Endless(CartPole):
        def step(self, key, state, action, params):
            obs, state, *_ = super().step(key, state, action, params)
            return obs, state, 3, False, False, {}

    real = jax.jit(lambda key: rollout(Endless(), random_act, key, PARAMS, 2, num_steps=30))(
        jax.random.key(0)
    )
    assert real.mask.all() and real.truncated[:, -1].all() and not real.terminated.any()
    assert real.reward.dtype == jnp.float32 and (real.reward == 3).all()


def test_a_reward_that_is_no_scalar_is_told():
    class Wide(CartPole):
        def step(self, key, state, action, params):
            obs, state, reward, *rest = super().step(key, state, action, params)
            return obs, state, reward[None], *rest

    with pytest.raises(ValueError, match=r"a step of Wide earns an array \(1,\): make it a scalar"):
        rollout(Wide(), random_act, jax.random.key(0), PARAMS, 2, num_steps=3)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda obs, state, reward, *rest: (obs, state, reward, *rest[:2]),
            "does not return obs, s",
        ),
        (lambda obs, state, reward, *rest: (obs, state, None, *rest), "earns None"),
        (lambda obs, *rest: (jnp.tile(obs, 2), *rest), r"observes numbers \[8\] after numbers \[4"),
        (lambda obs, *rest: (jnp.int32(obs), *rest), "observes whole numbers"),
        (lambda obs, state, *rest: (obs, (state,), *rest), "a state of another structure"),
    ],
)
def test_what_no_step_returns_is_told(change, said):
    class Strange(CartPole):
        def step(self, key, state, action, params):
            return change(*super().step(key, state, action, params))

    with pytest.raises(ValueError, match=f"a step of Strange .*{said}"):
        rollout(Strange(), random_act, jax.random.key(0), PARAMS, 2, num_steps=3)


def test_clear_errors():
    with pytest.raises(ValueError, match="num_episodes is 0"):
        play(episodes=0)
    with pytest.raises(AssertionError, match="type"):
        jax.eval_shape(
            lambda key: rollout(ENV, lambda obs, key: obs[0], key, PARAMS, 2, num_steps=3),
            jax.random.key(0),
        )


def test_predicted_bytes_are_the_nearest():
    predicted = jnp.array([2.999, -3.0, 300.0, 2.4])
    np.testing.assert_array_equal(as_observed(predicted, jnp.uint8), [3, 0, 255, 2])
    np.testing.assert_array_equal(as_observed(predicted, jnp.float32), predicted)
