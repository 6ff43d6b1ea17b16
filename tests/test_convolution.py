"""The rewritten gradient of a convolution against autodiff."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdyna.networks.convolution import convolve


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


def test_a_batch_inside_vmap_is_the_batch():
    x = jax.random.normal(jax.random.key(0), (6, 7, 7, 3))
    kernel = jax.random.normal(jax.random.key(1), (3, 3, 3, 2))
    one_by_one = jax.vmap(lambda one: convolve(one[None], kernel, 1)[0])(x)
    np.testing.assert_allclose(one_by_one, convolve(x, kernel, 1), rtol=1e-5, atol=1e-5)
