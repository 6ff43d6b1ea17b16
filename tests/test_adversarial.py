"""The adversarial loss, patches, and frames in shades."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from parts import assert_close, assert_same

from jaxdyna.experiments.pong.options import TUNED
from jaxdyna.experiments.pong.world import paper_model
from jaxdyna.losses import bce, deceive, discern, l2
from jaxdyna.models import (
    AdversarialHParams,
    AdversaryConfig,
    PixelConfig,
    PixelHParams,
    discriminator,
    gan_adam,
    pixels,
)
from jaxdyna.networks import EncoderDecoder, LocalDynamics, Patched, from_patches, to_patches
from jaxdyna.types import Transition

SHAPE = (8, 8, 3)
CONFIG = PixelConfig(Patched(LocalDynamics(12, (8,)), 2), loss=l2, reward=None, shades=True)
FIG4 = replace(
    CONFIG, network=Patched(EncoderDecoder(12, (8, 8, 8), (2, 2, 2), 16), 2), optimizer=gan_adam
)
ADVERSARY = discriminator(SHAPE)


@pytest.fixture(scope="module")
def batch():
    """A dot in one of two places, both of them marked in the stack: nothing tells which."""
    after = np.zeros((64, *SHAPE), np.uint8)
    after[np.arange(64), 3, np.random.default_rng(0).choice([2, 5], 64)] = 200
    marks = np.zeros((8, 8, 12), np.uint8)
    marks[3, 2, 9] = marks[3, 5, 10] = 255
    stack = np.broadcast_to(marks, (64, 8, 8, 12))
    no = np.zeros(64, bool)
    made = Transition(
        stack,
        np.zeros(64, np.int32),
        np.zeros(64, np.float32),
        np.concatenate([stack[..., 3:], after], -1),
        no,
        no,
        ~no,
    )
    return jax.tree.map(jnp.asarray, made)


@cache
def make(*adversary, config=CONFIG):
    model = pixels(SHAPE, 2, config, 4, *adversary)
    return model._replace(init=jax.jit(model.init), update=jax.jit(model.update))


@cache
def trainer(model, steps):
    @jax.jit
    def run(key, hparams, batch):
        def step(state, _):
            return model.update(state, batch, jax.random.key(0), hparams)

        return jax.lax.scan(step, model.init(key, hparams), length=steps)

    return run


def train(model, hparams, batch, steps):
    return trainer(model, steps)(jax.random.key(1), hparams, batch)


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


class Brightness:
    """Takes bright pictures for true ones."""

    def init(self, key, pictures):
        return jnp.float32(1)

    def apply(self, params, pictures):
        return params * pictures.mean((1, 2, 3))


@jax.jit
def judged():
    """A picture of 1 against one of -2, and another pair that is masked out."""
    adversary, hparams = discriminator(SHAPE, AdversaryConfig(Brightness())), AdversarialHParams()
    state = adversary.init(jax.random.key(0), hparams)
    truth, made = (jnp.ones(SHAPE) * jnp.array([[[[a]]], [[[b]]]]) for a, b in ((1, -9), (-2, 7)))
    return adversary.update(state, made, truth, jnp.array([1.0, 0.0]), hparams)[1]


def test_a_discriminators_loss_by_hand():
    said = judged()
    expected = -np.log(1 / (1 + np.exp(-1))) - np.log(1 - 1 / (1 + np.exp(2)))
    np.testing.assert_allclose(said["discriminator_loss"], expected, rtol=1e-6)
    assert said["discriminator_accuracy"] == 1


@pytest.mark.slow
@pytest.mark.parametrize("config", [CONFIG, FIG4], ids=["local", "fig4"])
def test_a_weight_of_zero_is_the_squared_error_alone(batch, config):
    """To rounding, though the discriminator learns. Adam makes whole steps of the rounding in
    biases that BatchNorm takes out again: of Fig. 4 the losses are the same, not all the weights.
    """
    hparams = AdversarialHParams(1e-3, 0.0, 1e-3)
    judged, alone = make(ADVERSARY, config=config), make(config=config)
    if config is FIG4:  # BatchNorm can make nothing of stacks that are all the same
        lit = jax.random.bernoulli(jax.random.key(2), shape=batch.obs.shape)
        batch = batch._replace(obs=lit.astype(jnp.uint8) * 255)
    with_adversary, learned = train(judged, hparams, batch, 20)
    # The same first weights: the adversary's come from a key of their own.
    start = judged.init(jax.random.key(1), hparams)
    plain = alone.init(jax.random.key(1), PixelHParams()).replace(
        params=start.params, opt_state=start.opt_state
    )
    losses = []
    for _ in range(20):
        plain, metrics = alone.update(plain, batch, jax.random.key(0), PixelHParams(1e-3))
        losses.append(metrics["frame_loss"])
    np.testing.assert_allclose(learned["frame_loss"], losses, rtol=1e-4)
    assert losses[-1] < 0.95 * losses[0]
    if config is CONFIG:
        assert_close(with_adversary.params, plain.params, 1e-6)
    moved = jax.tree.map(
        lambda new, old: jnp.abs(new - old).max(),
        with_adversary.adversary.params,
        start.adversary.params,
    )
    assert max(map(float, jax.tree.leaves(moved))) > 1e-3


def test_both_learn_by_adam_with_a_short_memory():
    """A first step's running mean is (1 - 0.5) times the gradient, of its square (1 - 0.999)."""
    gradient = {"w": jnp.array(2.0)}
    pong = paper_model(TUNED).optimizer
    for make_optimizer in (gan_adam, AdversaryConfig().optimizer, pong):
        optimizer = make_optimizer(1e-3)
        state = optimizer.update(gradient, optimizer.init(gradient), gradient)[1]
        moments = optax.tree.get(state, "mu")["w"], optax.tree.get(state, "nu")["w"]
        np.testing.assert_allclose(moments, [0.5 * 2, 0.001 * 4], rtol=1e-6)


def test_who_judges_a_cross_entropy_is_shown_probabilities(batch):
    """Not log odds: an adversary that only tells numbers outside [0, 1] finds none."""
    config = replace(CONFIG, loss=bce)

    def outside(state, made):
        return jnp.where((made < 0) | (made > 1), 1.0, 0.0).sum((1, 2, 3))

    judge = ADVERSARY._replace(unmasked=outside, update=lambda state, *_: (state, {}))
    model = make(judge, config=config)
    state = model.init(jax.random.key(0), AdversarialHParams())
    _, metrics = model.update(state, batch, jax.random.key(1), AdversarialHParams())
    assert metrics["adversarial_loss"] == 0


@pytest.mark.slow
def test_the_squared_error_blurs_and_the_adversary_minds(batch):
    """Two places, one prediction: alone half a dot in each; with the adversary no longer."""
    shown = {}
    model = make(ADVERSARY)
    order = np.argsort(batch.next_obs[:, 3, 2, 9])
    few = jax.tree.map(lambda leaf: leaf[np.r_[order[:8], order[-8:]]], batch)  # half in each
    for weight in (0.0, 10.0):
        hparams = AdversarialHParams(5e-3, weight, 5e-3)
        state, metrics = train(model, hparams, few, 150)
        frame = jax.jit(model.predict)(
            state.params, batch.obs[0], batch.action[0], jax.random.key(2)
        ).next_obs[..., 9:]
        shown[weight] = np.asarray(frame[3, [2, 5]]).mean(-1)
        assert frame.dtype == jnp.uint8
        assert metrics["discriminator_accuracy"].shape == (150,)
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
