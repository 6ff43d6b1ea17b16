"""The adversarial loss, patches, and frames in shades."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from parts import assert_close, assert_same

from jaxdyna.losses import deceive, discern, l2
from jaxdyna.models import (
    AdversarialHParams,
    PixelConfig,
    PixelHParams,
    discriminator,
    pixels,
)
from jaxdyna.networks import LocalDynamics, Patched, from_patches, to_patches
from jaxdyna.types import Transition

SHAPE = (8, 8, 3)
CONFIG = PixelConfig(Patched(LocalDynamics(12, (8,)), 2), loss=l2, reward=None, shades=True)
ADVERSARY = discriminator(SHAPE)


@pytest.fixture(scope="module")
def batch():
    """A dot in one of two places, both of them marked in the stack: nothing tells which."""
    place = jax.random.bernoulli(jax.random.key(0), shape=(64,))
    frames = jnp.zeros((64, *SHAPE), jnp.uint8)
    left, right = (frames.at[:, 3, column].set(200) for column in (2, 5))
    after = jnp.where(place[:, None, None, None], left, right)
    marks = jnp.zeros((8, 8, 12), jnp.uint8).at[3, 2, 9].set(255).at[3, 5, 10].set(255)
    stack = jnp.broadcast_to(marks, (64, 8, 8, 12))
    zeros, no = jnp.zeros(64), jnp.zeros(64, bool)
    return Transition(
        stack,
        jnp.zeros(64, jnp.int32),
        zeros,
        jnp.concatenate([stack[..., 3:], after], -1),
        no,
        no,
        ~no,
    )


def make(*adversary):
    model = pixels(SHAPE, 2, CONFIG, 4, *adversary)
    return model._replace(init=jax.jit(model.init), update=jax.jit(model.update))


def train(model, hparams, batch, steps):
    @jax.jit
    def run(key):
        def step(state, _):
            return model.update(state, batch, jax.random.key(0), hparams)

        return jax.lax.scan(step, model.init(key, hparams), length=steps)

    return run(jax.random.key(1))


def test_patches_go_there_and_back():
    picture = jnp.arange(2 * 6 * 4 * 3).reshape(2, 6, 4, 3)
    patches = to_patches(picture, 2)
    assert patches.shape == (2, 3, 2, 12)
    np.testing.assert_array_equal(patches[1, 2, 0], picture[1, 4:6, 0:2].reshape(-1))
    np.testing.assert_array_equal(from_patches(patches, 2), picture)


def test_losses_by_hand():
    real, fake = 1.5, -0.5
    odds = [1 / (1 + np.exp(-logit)) for logit in (real, fake)]
    np.testing.assert_allclose(deceive(jnp.float32(fake)), -np.log(odds[1]), rtol=1e-6)
    expected = -np.log(odds[0]) - np.log(1 - odds[1])
    np.testing.assert_allclose(discern(jnp.float32(real), jnp.float32(fake)), expected, rtol=1e-6)


def test_a_weight_of_zero_is_the_squared_error_alone(batch):
    """To rounding, though the discriminator learns."""
    hparams = AdversarialHParams(1e-3, 0.0, 1e-3)
    judged, alone = make(ADVERSARY), make()
    with_adversary, _ = train(judged, hparams, batch, 20)
    # The same first weights: the adversary's come from a key of their own.
    start = judged.init(jax.random.key(1), hparams)
    plain = alone.init(jax.random.key(1), PixelHParams()).replace(
        params=start.params, opt_state=start.opt_state
    )
    for _ in range(20):
        plain, _ = alone.update(plain, batch, jax.random.key(0), PixelHParams(1e-3))
    assert_close(with_adversary.params, plain.params, 1e-6)
    moved = jax.tree.map(
        lambda new, old: jnp.abs(new - old).max(),
        with_adversary.adversary.params,
        start.adversary.params,
    )
    assert max(map(float, jax.tree.leaves(moved))) > 1e-3


def test_the_squared_error_blurs_and_the_adversary_minds(batch):
    """Two places, one prediction: alone half a dot in each; with the adversary no longer."""
    shown = {}
    model = make(ADVERSARY)
    order = np.argsort(batch.next_obs[:, 3, 2, 9])
    few = jax.tree.map(lambda leaf: leaf[np.r_[order[:8], order[-8:]]], batch)  # half in each
    for weight in (0.0, 10.0):
        hparams = AdversarialHParams(5e-3, jnp.float32(weight), 5e-3)
        state, metrics = train(model, hparams, few, 300)
        frame = jax.jit(model.predict)(
            state.params, batch.obs[0], batch.action[0], jax.random.key(2)
        ).next_obs[..., 9:]
        shown[weight] = np.asarray(frame[3, [2, 5]]).mean(-1)
        assert frame.dtype == jnp.uint8
        assert metrics["discriminator_accuracy"].shape == (300,)
    np.testing.assert_allclose(shown[0.0], 100, atol=25)
    assert np.abs(shown[10.0] - 100).max() > 40, shown


def test_what_is_masked_teaches_neither(batch):
    hparams = AdversarialHParams(1e-3, 1.0, 1e-3)
    model = make(ADVERSARY)
    state = model.init(jax.random.key(3), hparams)

    def new(transitions):
        return model.update(state, transitions, jax.random.key(0), hparams)[0]

    assert_same(new(batch._replace(mask=batch.mask & False)), state)
    half = batch._replace(mask=jnp.arange(64) < 32)
    garbage = half._replace(next_obs=half.next_obs.at[32:].set(77))
    assert_close(new(garbage), new(half), 1e-5)
