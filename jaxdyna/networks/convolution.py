"""Convolutions that are fast on a CPU, inside `jax.lax.scan` too.

XLA's CPU backend takes a naive path for the gradient of a convolution inside a loop, tens of times
slower than outside. Here the gradient by the input is a convolution with the flipped kernel, and
that by the weights is made of matrix products. A convolution that grows the picture (a transposed
one) is a matrix product too, whose results are spread over the larger picture: there is no
multiplying by the zeros around it, and few output channels cost little. One that shrinks it and
has far more channels coming in than going out is the same the other way round: the few are moved
about, not the many. On a GPU XLA's own convolutions and gradients are used.
"""

from functools import partial

import jax
import jax.numpy as jnp


def _forward(x: jax.Array, kernel: jax.Array, padding: int) -> jax.Array:
    if padding == kernel.shape[0] - 1 > 0:
        return _spread(x, kernel)
    if padding == 0 and _narrows(x, kernel):
        return _gather(x, kernel)
    return _plain(x, kernel, padding)


def _plain(x: jax.Array, kernel: jax.Array, padding: int) -> jax.Array:
    return jax.lax.conv_general_dilated(
        x, kernel, (1, 1), [(padding, padding)] * 2, dimension_numbers=("NHWC", "HWIO", "NHWC")
    )


def on_cpu() -> bool:
    """Whether the default backend is one: what is put on another device is right, but slow."""
    return jax.default_backend() == "cpu"


def _spread(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """The convolution with ``k - 1`` zeros around: what each cell adds to the ``k x k`` cells that
    see it, summed by rows, then by columns.
    """
    size, _, channels, features = kernel.shape
    reach, (count, height, width) = size - 1, x.shape[:3]
    flat = kernel.transpose(2, 0, 1, 3).reshape(channels, -1)
    parts = (x.reshape(-1, channels) @ flat).reshape(count, height, width, size, size * features)

    def shifted(part: jax.Array, cells: int, axis: int) -> jax.Array:
        margins = [(0, 0)] * part.ndim
        margins[axis] = (reach - cells, cells)
        return jnp.pad(part, margins)

    rows = sum(shifted(parts[:, :, :, row], row, 1) for row in range(size))
    parts = jnp.asarray(rows).reshape(count, height + reach, width, size, features)
    return jnp.asarray(sum(shifted(parts[..., column, :], column, 2) for column in range(size)))


def _narrows(x: jax.Array, kernel: jax.Array) -> bool:
    """Whether what comes out takes less than half the room of what comes in."""
    size, _, channels, features = kernel.shape
    height, width = x.shape[1:3]
    shrunk = (height - size + 1) * (width - size + 1)
    return size > 1 and channels * shrunk > 2 * features * height * width


def _gather(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """The convolution without padding: what each cell gives to the ``k x k`` cells that see it,
    gathered by rows, then by columns.
    """
    size, _, channels, features = kernel.shape
    count, height, width = x.shape[:3]
    down, across = height - size + 1, width - size + 1
    flat = kernel.transpose(2, 0, 1, 3).reshape(channels, -1)
    parts = (x.reshape(-1, channels) @ flat).reshape(count, height, width, size, size * features)
    rows = sum(parts[:, row : row + down, :, row] for row in range(size))
    parts = jnp.asarray(rows).reshape(count, down, width, size, features)
    seen = sum(parts[:, :, column : column + across, column] for column in range(size))
    return jnp.asarray(seen)


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
    if not 0 <= padding < kernel.shape[0]:
        raise ValueError(f"padding is {padding}: give 0 to {kernel.shape[0] - 1}")
    return (_convolve if on_cpu() else _plain)(x, kernel, padding)


@partial(jax.custom_vjp, nondiff_argnums=(2,))
def _convolve(x: jax.Array, kernel: jax.Array, padding: int) -> jax.Array:
    return _forward(x, kernel, padding)


def _with_residuals(x, kernel, padding):
    return _forward(x, kernel, padding), (x, kernel)


def _gradients(padding, residuals, gradient):
    x, kernel = residuals
    size = kernel.shape[0]
    flipped = jnp.flip(kernel, (0, 1)).swapaxes(2, 3)
    by_input = _forward(gradient, flipped, size - 1 - padding)
    channels, features = kernel.shape[2:]
    if padding == 0 and _narrows(x, kernel):
        around = jnp.pad(gradient, ((0, 0), *[(size - 1, size - 1)] * 2, (0, 0)))
        seen = _windows(around, size, x.shape[1:3])
        by_kernel = _by_seen(x, seen, size, features)
    elif padding == 0:
        seen = _windows(x, size, gradient.shape[1:3])
        by_kernel = gradient.reshape(-1, features).T @ seen.reshape(-1, size**2 * channels)
        by_kernel = by_kernel.reshape(features, size, size, channels).transpose(1, 2, 3, 0)
    elif padding == size - 1:
        seen = _windows(gradient, size, x.shape[1:3])
        by_kernel = _by_seen(x, seen, size, features)
    else:
        padded = jnp.pad(x, ((0, 0), (padding, padding), (padding, padding), (0, 0)))
        flat = gradient.reshape(-1, features)
        cells = [
            cell.reshape(-1, channels).T @ flat
            for cell in _cells(padded, size, gradient.shape[1:3])
        ]
        by_kernel = jnp.stack(cells).reshape(kernel.shape)
    return by_input, by_kernel


def _by_seen(x: jax.Array, seen: jax.Array, size: int, features: int) -> jax.Array:
    """The gradient by the kernel, from what each cell of the input sees of that by the output."""
    channels = x.shape[-1]
    by_kernel = x.reshape(-1, channels).T @ seen.reshape(-1, size**2 * features)
    by_kernel = by_kernel.reshape(channels, size, size, features).transpose(1, 2, 0, 3)
    return jnp.flip(by_kernel, (0, 1))


def _cells(x: jax.Array, size: int, shape: tuple[int, ...]) -> list[jax.Array]:
    """What each cell of a kernel sees of pictures ``[N, H, W, C]``, where it sees ``shape``."""
    height, width = shape
    places = [(row, column) for row in range(size) for column in range(size)]
    return [x[:, row : row + height, column : column + width] for row, column in places]


def _windows(x: jax.Array, size: int, shape: tuple[int, ...]) -> jax.Array:
    """`_cells` beside each other on the channels."""
    return jnp.concatenate(_cells(x, size, shape), axis=-1)


_convolve.defvjp(_with_residuals, _gradients)


def channel_axis() -> int:
    """Where pictures have their channels between layers that need no other order: in front, the
    batch last, ``[C, H, W, N]``, on a CPU; at the end, ``[N, H, W, C]``, elsewhere.
    """
    return 0 if on_cpu() else 3


@jax.custom_vjp
def correlate(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """`convolve` without padding, from ``[C, H, W, N]`` to ``[F, H - k + 1, W - k + 1, N]``."""
    size, features = kernel.shape[0], kernel.shape[-1]
    seen = _beside(x, size)
    parts = _by_rows(kernel) @ seen.reshape(seen.shape[0], -1)
    parts, rows = parts.reshape(size, features, *seen.shape[1:]), x.shape[1] - size + 1
    return jnp.asarray(sum(parts[row, :, row : row + rows] for row in range(size)))


@jax.custom_vjp
def spread(y: jax.Array, kernel: jax.Array) -> jax.Array:
    """The transpose of `correlate`, from ``[F, H, W, N]`` to ``[C, H + k - 1, W + k - 1, N]``."""
    size, channels = kernel.shape[0], kernel.shape[2]
    given = _below(y, size)
    parts = _by_rows(kernel).T @ given.reshape(given.shape[0], -1)
    parts = parts.reshape(size, channels, *given.shape[1:])
    margins = [((0, 0), (0, 0), (column, size - 1 - column), (0, 0)) for column in range(size)]
    return jnp.asarray(sum(map(jnp.pad, parts, margins)))


def _pair(x: jax.Array, y: jax.Array, kernel: jax.Array) -> jax.Array:
    """The gradient by the kernel of the sum over ``correlate(x, kernel) * y``."""
    size, _, channels, features = kernel.shape
    seen, given = _beside(x, size), _below(y, size)
    pairs = given.reshape(size * features, -1) @ seen.reshape(size * channels, -1).T
    return pairs.reshape(size, features, size, channels).transpose(0, 2, 3, 1)


def _by_rows(kernel: jax.Array) -> jax.Array:
    """A kernel ``[k, k, C, F]`` as a matrix ``[k * F, k * C]``."""
    size, _, channels, features = kernel.shape
    return kernel.transpose(0, 3, 1, 2).reshape(size * features, size * channels)


def _beside(x: jax.Array, size: int) -> jax.Array:
    """What each column of a kernel sees of ``x``: ``[k * C, H, W - k + 1, N]``."""
    width = x.shape[2] - size + 1
    return jnp.concatenate([x[:, :, column : column + width] for column in range(size)])


def _below(y: jax.Array, size: int) -> jax.Array:
    """What each row of a kernel is given by ``y``: ``[k * F, H + k - 1, W, N]``."""
    margins = [((0, 0), (row, size - 1 - row), (0, 0), (0, 0)) for row in range(size)]
    return jnp.concatenate([jnp.pad(y, margin) for margin in margins])


correlate.defvjp(
    lambda x, kernel: (correlate(x, kernel), (x, kernel)),
    lambda held, y: (spread(y, held[1]), _pair(held[0], y, held[1])),
)
spread.defvjp(
    lambda y, kernel: (spread(y, kernel), (y, kernel)),
    lambda held, x: (correlate(x, held[1]), _pair(x, held[0], held[1])),
)
