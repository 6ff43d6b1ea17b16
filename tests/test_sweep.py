"""Seeds x settings in one call."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from parts import DYNA, SMALL, assert_close, assert_same, hparams

from jaxdyna import sweep
from jaxdyna.agents import ReinforceHParams
from jaxdyna.dyna import make_train
from jaxdyna.models import DreamHParams, SupervisedHParams
from jaxdyna.trees import where_needed

SWEPT = {
    "fake_weight": jnp.array([0.0, 1.0, 1.0]),
    "num_real_first": jnp.array([2, 2, 4]),
    "dream": DreamHParams(jnp.array([0.5, 0.2, 0.5]), jnp.array([jnp.inf] * 3)),
    "agent": ReinforceHParams(
        learning_rate=jnp.array([0.01, 0.02, 0.01]), discount=jnp.array([0.99, 0.9, 0.99])
    ),
    "model": SupervisedHParams(learning_rate=jnp.array([0.01, 0.01, 0.005])),
}


TRAIN = chex.assert_max_traces(make_train(DYNA, SMALL), n=1)


@pytest.fixture(scope="module")
def swept():
    return sweep(TRAIN, jax.random.split(jax.random.key(0), 2), hparams(**SWEPT))


def test_every_row_is_the_separate_run(swept):
    _, metrics = swept
    assert metrics["real_return"].shape == (3, 2, SMALL.num_episodes)
    alone = jax.jit(make_train(DYNA, SMALL))
    for setting in range(3):
        changes = jax.tree.map(lambda values, at=setting: values[at], SWEPT)
        for seed, key in enumerate(jax.random.split(jax.random.key(0), 2)):
            _, expected = alone(key, hparams(**changes))
            row = jax.tree.map(lambda leaf, at=(setting, seed): leaf[at], metrics)
            assert_close(row, expected, 1e-3)
    assert len(np.unique(metrics["agent_loss"][:, 0, -1])) == 3


def test_other_values_need_no_second_program(swept):
    changes = jax.tree.map(lambda values: (values / 2).astype(values.dtype), SWEPT)
    _, metrics = sweep(TRAIN, jax.random.split(jax.random.key(0), 2), hparams(**changes))
    assert not np.array_equal(metrics["agent_loss"], swept[1]["agent_loss"])


def test_blocks_give_the_same_rows_in_the_same_order():
    def train(key, scale):
        return jax.random.uniform(key) * scale

    def keys():
        return jax.random.split(jax.random.key(0), 5)

    scale = jnp.array([1.0, 2.0])
    at_once = sweep(train, keys(), scale)
    for block in (1, 2, 3, 5, 9):
        assert_same(sweep(train, keys(), scale, block=block), at_once)


def test_it_compiles_once_for_a_shape():
    @chex.assert_max_traces(n=1)
    def train(key, hparams):
        return jax.random.uniform(key) * hparams["scale"]

    for scale in (jnp.array([1.0, 2.0]), jnp.array([3.0, 4.0])):
        out = sweep(train, jax.random.split(jax.random.key(0), 5), {"scale": scale, "other": 1.0})
        assert out.shape == (2, 5)
    assert_close(out[0] / 3, out[1] / 4)


def test_seeds_are_dealt_out_to_all_devices():
    """Also where their number cannot be divided by that of the devices."""

    def keys(seeds):
        return jax.random.split(jax.random.key(0), seeds)

    def train(key, scale):
        return jax.random.uniform(key) * scale

    assert len(jax.devices()) == 2
    for seeds, devices in ((1, 1), (5, 2), (6, 2)):
        for block in (None, 1, 2):
            dealt = sweep(train, keys(seeds), jnp.array([1.0, 2.0]), block)
            assert len(dealt.sharding.device_set) == devices
            assert_same(dealt[1], 2 * jax.vmap(jax.random.uniform)(keys(seeds)))


def test_nothing_swept_still_has_an_axis_for_settings():
    out = sweep(lambda key, hparams: hparams, jax.random.split(jax.random.key(0), 2), 7.0)
    np.testing.assert_array_equal(out, [[7, 7]])


def test_work_that_no_run_needs_is_not_done():
    """Under nested vmaps, in a loop, on several devices; and there are gradients of it."""
    done = []

    def run(needed, x):
        def work():
            jax.debug.callback(lambda: done.append(1))
            return jnp.sin(x)

        return where_needed(needed, work, x)

    def train(key, needed):
        x = jax.random.uniform(key)
        return jax.lax.scan(lambda x, _: (run(needed & (x > 0.5), x), None), x, length=2)[0]

    def keys():
        return jax.random.split(jax.random.key(2), 4)

    draws = np.asarray(jax.vmap(jax.random.uniform)(keys()))
    once = np.where(draws > 0.5, np.sin(draws), draws)
    twice = np.where(once > 0.5, np.sin(once), once)
    assert (twice != draws).any() and (twice == draws).any()
    for needed, expected in (([False, False], [draws, draws]), ([False, True], [draws, twice])):
        done.clear()
        out = sweep(train, keys(), jnp.array(needed))
        jax.effects_barrier()
        np.testing.assert_allclose(out, expected, rtol=1e-6)
        assert bool(done) == any(needed)
    slopes = [jax.grad(run, 1)(needed, 0.3) for needed in (True, False)]
    np.testing.assert_allclose(slopes, [np.cos(0.3), 1], rtol=1e-6)


def test_clear_errors():
    with pytest.raises(ValueError, match=r"lengths \[2, 3\]"):
        sweep(lambda k, h: h, jax.random.split(jax.random.key(0), 2), (jnp.ones(2), jnp.ones(3)))
