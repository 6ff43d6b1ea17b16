"""A convolution whose gradient is fast on a CPU inside `jax.lax.scan`.

XLA's CPU backend takes a naive path for the gradient of a convolution inside a loop, tens of times
slower than outside. Written as a convolution with the flipped kernel (by the input) and as one
matrix product for each cell of the kernel (by the weights) it costs no more there than outside.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp


def _forward(x: jax.Array, kernel: jax.Array, padding: int) -> jax.Array:
    return jax.lax.conv_general_dilated(
        x, kernel, (1, 1), [(padding, padding)] * 2, dimension_numbers=("NHWC", "HWIO", "NHWC")
    )


@partial(jax.custom_vjp, nondiff_argnums=(2,))
def convolve(x: jax.Array, kernel: jax.Array, padding: int) -> jax.Array:
    """A two-dimensional convolution of stride 1 (a cross-correlation, as everywhere in learning).

    Args:
        x: ``[N, H, W, C]``.
        kernel: ``[k, k, C, F]``.
        padding: zeros around every side, 0 to ``k - 1``. ``k - 1`` makes it the transpose of the
            convolution without padding: it grows the picture by ``k - 1``.

    Returns:
        ``[N, H', W', F]`` with ``H' = H + 2 * padding - k + 1``.
    """
    return _forward(x, kernel, padding)


def _with_residuals(x, kernel, padding):
    return _forward(x, kernel, padding), (x, kernel)


def _gradients(padding, residuals, gradient):
    x, kernel = residuals
    size = kernel.shape[0]
    flipped = jnp.flip(kernel, (0, 1)).swapaxes(2, 3)
    by_input = _forward(gradient, flipped, size - 1 - padding)
    padded = jnp.pad(x, ((0, 0), (padding, padding), (padding, padding), (0, 0)))
    height, width = gradient.shape[1:3]
    flat = gradient.reshape(-1, gradient.shape[-1])

    def cell(row, column):
        seen = padded[:, row : row + height, column : column + width]
        return seen.reshape(-1, seen.shape[-1]).T @ flat

    by_kernel = jnp.stack([cell(row, column) for row in range(size) for column in range(size)])
    return by_input, by_kernel.reshape(kernel.shape)


convolve.defvjp(_with_residuals, _gradients)
