"""Rewritten convolutions and their gradients against autodiff of plain ones."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn

from jaxdyna.networks import layers, q_networks
from jaxdyna.networks.convolution import convolve, correlate, spread
from jaxdyna.networks.q_networks import PlainQ


def plain(x, kernel, padding):
    return jax.lax.conv_general_dilated(
        x, kernel, (1, 1), [(padding, padding)] * 2, dimension_numbers=("NHWC", "HWIO", "NHWC")
    )


@pytest.mark.parametrize(
    ("size", "padding", "channels"),
    [(1, 0, 5), (3, 1, 5), (4, 0, 5), (4, 3, 5), (5, 2, 5), (5, 4, 5), (3, 0, 60), (2, 1, 60)],
)
def test_gradients_agree_with_autodiff(size, padding, channels):
    """Also where many channels come in and few go out."""
    keys = jax.random.split(jax.random.key(0), 3)
    x = jax.random.normal(keys[0], (4, 9, 8, channels))
    kernel = jax.random.normal(keys[1], (size, size, channels, 6)) / (size * channels**0.5)
    shape = plain(x, kernel, padding).shape
    assert shape[1:3] == (9 + 2 * padding - size + 1, 8 + 2 * padding - size + 1)
    weight = jax.random.normal(keys[2], shape)

    def loss(function):
        return lambda *arguments: (weight * jnp.tanh(function(*arguments, padding))).sum()

    value, gradients = jax.value_and_grad(loss(convolve), (0, 1))(x, kernel)
    expected, autodiff = jax.value_and_grad(loss(plain), (0, 1))(x, kernel)
    np.testing.assert_allclose(value, expected, rtol=1e-5)
    for mine, theirs in zip(gradients, autodiff, strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=2e-4, atol=2e-5)


def test_a_gpu_runs_the_library_s_own(monkeypatch):
    """Nothing of what is written for a CPU is traced elsewhere."""

    def traced():
        one = jnp.ones((2, 6, 6, 3)), jnp.ones((3, 3, 3, 2)), jnp.ones((4, 3)), jnp.ones((3, 2))

        def loss(x, kernel, rows, weights):
            return convolve(x, kernel, 0).sum() + layers._dense(rows, weights).sum()

        return str(jax.make_jaxpr(jax.grad(loss, (0, 1, 2, 3)))(*one))

    here = traced()
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert here.count("conv_general_dilated[") == 1 and traced().count("conv_general_dilated[") == 3
    assert "optimization_barrier" in here and "optimization_barrier" not in traced()


def test_a_batch_inside_vmap_is_the_batch():
    x = jax.random.normal(jax.random.key(0), (6, 7, 7, 3))
    kernel = jax.random.normal(jax.random.key(1), (3, 3, 3, 2))
    one_by_one = jax.vmap(lambda one: convolve(one[None], kernel, 1)[0])(x)
    np.testing.assert_allclose(one_by_one, convolve(x, kernel, 1), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(("size", "channels", "features"), [(1, 3, 2), (3, 5, 2), (4, 2, 6)])
def test_pictures_with_the_batch_last_are_the_same(size, channels, features):
    """Values and gradients of a convolution, and of its transpose."""
    keys = jax.random.split(jax.random.key(0), 4)
    x = jax.random.normal(keys[0], (3, 9, 7, channels))
    kernel = jax.random.normal(keys[1], (size, size, channels, features)) / size

    def turned(x):  # from [N, H, W, C] to [C, H, W, N], and back
        return x.transpose(3, 1, 2, 0)

    y, back = jax.vjp(lambda *given: plain(*given, 0), x, kernel)
    small, large = jax.random.normal(keys[2], y.shape), jax.random.normal(keys[3], x.shape)
    value, gradients = jax.vjp(correlate, turned(x), kernel)
    np.testing.assert_allclose(turned(value), y, rtol=1e-4, atol=1e-5)
    by_x, by_kernel = gradients(turned(small))
    for mine, theirs in zip((turned(by_x), by_kernel), back(small), strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-4, atol=1e-4)

    def transposed(y, kernel):
        return jax.vjp(lambda x: plain(x, kernel, 0), x)[1](y)[0]

    grown, expected = jax.vjp(transposed, small, kernel)
    value, gradients = jax.vjp(spread, turned(small), kernel)
    np.testing.assert_allclose(turned(value), grown, rtol=1e-4, atol=1e-4)
    by_y, by_kernel = gradients(turned(large))
    for mine, theirs in zip((turned(by_y), by_kernel), expected(large), strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("patch", [1, 2])
def test_plain_values_are_the_same_in_either_layout(monkeypatch, patch):
    """A CPU's pictures have the batch last; the dense layer's inputs are in one order."""
    network, x = PlainQ(3, (4, 5), 6, patch), jax.random.uniform(jax.random.key(0), (3, 12, 14, 2))
    params = network.init(jax.random.key(1), x)
    values = []
    for axis in (0, 3):
        for module in (layers, q_networks):
            monkeypatch.setattr(module, "channel_axis", lambda axis=axis: axis)
        values.append(network.apply(params, x))
    np.testing.assert_allclose(*values, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("axis", [0, 3])
def test_a_normalised_convolution_by_its_definition(monkeypatch, axis):
    """On a CPU's pictures and on others', values and gradients."""
    monkeypatch.setattr(layers, "channel_axis", lambda: axis)

    def arranged(x):
        return x if axis else x.transpose(3, 1, 2, 0)

    def by_definition(params, x):
        kernel, scale, shift = (params["params"][name] for name in ("kernel", "scale", "shift"))
        y = plain(x, kernel, 0)
        y = (y - y.mean((0, 1, 2))) / jnp.sqrt(y.var((0, 1, 2)) + 1e-5)
        return nn.relu(scale * y + shift)

    layer, keys = layers.NormalisedConvolution(3, 2), jax.random.split(jax.random.key(0), 4)
    x = 1 + jax.random.normal(keys[0], (4, 5, 6, 2))
    drawn = jax.random.normal(keys[1], (2, 3))
    params = layer.init(keys[2], arranged(x))["params"]
    params = {"params": {**params, "scale": drawn[0], "shift": drawn[1]}}
    weight = jax.random.normal(keys[3], (4, 4, 5, 3))

    def mine(params, x):
        return (arranged(weight) * layer.apply(params, arranged(x)) ** 2).sum()

    def theirs(params, x):
        return (weight * by_definition(params, x) ** 2).sum()

    got, wanted = (jax.value_and_grad(loss, (0, 1))(params, x) for loss in (mine, theirs))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-3), got, wanted)


def test_a_product_has_the_gradients_of_a_matrix_product():
    """Of batches with any leading axes, of weights for each run too."""
    keys = jax.random.split(jax.random.key(5), 3)
    x = jax.random.normal(keys[0], (3, 2, 6, 5))
    kernel = jax.random.normal(keys[1], (3, 5, 7))
    weight = jax.random.normal(keys[2], (3, 2, 6, 7))

    def gradients(multiply):
        def loss(x, kernel, weight):
            return (jnp.sin(multiply(x, kernel)) * weight).sum()

        return jax.jit(jax.vmap(jax.value_and_grad(loss, (0, 1))))(x, kernel, weight)

    ours, theirs = gradients(layers.product), gradients(jnp.matmul)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-5), ours, theirs)
