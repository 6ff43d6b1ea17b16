"""What networks are made of."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn

from jaxdyna.fields import check_counts, check_shape
from jaxdyna.networks.convolution import channel_axis, convolve, correlate, on_cpu


class Sized(nn.Module):
    """A module whose whole numbers, in tuples too, are sizes, at least 1; only ``hidden`` may be
    empty, ``padding`` and ``free`` 0. `SettingError` where one is none.
    """

    def __post_init__(self) -> None:
        for name, field in self.__dataclass_fields__.items():
            value = getattr(self, name)
            if field.type in (int, "int"):
                check_counts(int(name not in ("padding", "free")), **{name: value})
            elif str(field.type).startswith("tuple[int"):
                check_shape(**{name: value if name == "hidden" else value or 0})
        super().__post_init__()


@jax.custom_vjp
def product(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """``x @ kernel`` of a batch ``[..., in]`` and weights ``[in, out]``, with a gradient by the
    input that reads the weights as they lie in memory: JAX's own reads them across, which on a CPU
    takes more than twice as long. It has no forward-mode derivative (`jax.jvp`).
    """
    return x @ kernel


def _gradients(held: tuple[jax.Array, jax.Array], y: jax.Array) -> tuple[jax.Array, jax.Array]:
    x, kernel = held
    rows, given = (one.reshape(-1, one.shape[-1]) for one in (x, y))
    by_input = jax.lax.optimization_barrier(kernel @ given.T)  # else XLA turns it around again
    return by_input.T.reshape(x.shape), rows.T @ given


product.defvjp(lambda x, kernel: (product(x, kernel), (x, kernel)), _gradients)


def _dense(x: jax.Array, kernel: jax.Array, *_: Any, **__: Any) -> jax.Array:
    batch = x.ndim > 1 and on_cpu()  # rows of a vmapped batch: JAX's own
    return product(x, kernel) if batch else x @ kernel


class MLP(Sized):
    """A multilayer perceptron; the last layer is linear.

    Attributes:
        features: width of each layer, the output's last.
        weight_variance: times the number of inputs, the variance of a weight at the start: 1 is
            LeCun's, 1/3 the uniform one that PyTorch's layers (the authors' code) start from.
            Smaller features keep plain SGD stable at larger learning rates.
        output_variance: the same of the last layer's; None: as ``weight_variance``.
        free: outputs after these that are parameters themselves, whatever the input; 0 at first.
    """

    features: tuple[int, ...]
    weight_variance: float = 1.0
    output_variance: float | None = None
    free: int = 0

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps ``[..., in]`` to ``[..., features[-1] + free]``."""

        def initial(variance: float) -> Any:
            return nn.initializers.variance_scaling(variance, "fan_in", "uniform")

        dense = partial(nn.Dense, dot_general=_dense)
        for width in self.features[:-1]:
            x = nn.relu(dense(width, kernel_init=initial(self.weight_variance))(x))
        last = self.weight_variance if self.output_variance is None else self.output_variance
        x = dense(self.features[-1], kernel_init=initial(last))(x)
        if self.free:
            free = self.param("free", nn.initializers.zeros, (self.free,), jnp.float32)
            x = jnp.concatenate([x, jnp.broadcast_to(free, (*x.shape[:-1], self.free))], axis=-1)
        return x


class Convolution(Sized):
    """A convolution of stride 1 with a bias, by `jaxdyna.networks.convolution.convolve`."""

    features: int  #: channels of the output
    size: int  #: cells a side of the kernel
    padding: int  #: zeros around the picture; ``size - 1`` makes it a transposed convolution

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps ``[N, H, W, C]`` to ``[N, H', W', features]``."""
        shape = (self.size, self.size, x.shape[-1], self.features)
        kernel = self.param("kernel", nn.initializers.he_normal(), shape, jnp.float32)
        bias = self.param("bias", nn.initializers.zeros, (self.features,), jnp.float32)
        return convolve(x.astype(kernel.dtype), kernel, self.padding) + bias


class NormalisedConvolution(Sized):
    """A convolution without padding, whose features are normalised over the pictures at hand (Ioffe
    and Szegedy 2015), scaled and shifted, and ReLU. A bias would be taken off by the mean.
    """

    features: int  #: channels of the output
    size: int  #: cells a side of the kernel

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps ``[N, H, W, C]`` to ``[N, H', W', features]``; where
        `jaxdyna.networks.convolution.channel_axis` is 0, ``[C, H, W, N]`` to ``[features, H', W',
        N]``.
        """
        axis = channel_axis()
        shape = (self.size, self.size, x.shape[axis], self.features)
        kernel = self.param("kernel", nn.initializers.he_normal(), shape, jnp.float32)
        scale = self.param("scale", nn.initializers.ones, (self.features,), jnp.float32)
        shift = self.param("shift", nn.initializers.zeros, (self.features,), jnp.float32)
        x = x.astype(kernel.dtype)
        x = convolve(x, kernel, 0) if axis else correlate(x, kernel)
        return settled(x, scale, shift, axis)


@partial(jax.custom_vjp, nondiff_argnums=(3,))
def settled(x: jax.Array, scale: jax.Array, shift: jax.Array, axis: int) -> jax.Array:
    """Each feature of ``x``, along ``axis``, less its mean over all else, over its standard
    deviation, scaled and shifted, and ReLU. Its gradient is written out: two passes, not eight.
    """
    return _settled(x, scale, shift, axis)[0]


def _settled(x, scale, shift, axis):
    over, mean = _over(x, axis)
    middle, square = mean(x), mean(jnp.square(x))
    rate = jax.lax.rsqrt(jnp.maximum(square - middle**2, 0) + 1e-5)
    slope = scale * rate
    y = nn.relu(over(slope) * x + over(shift - slope * middle))
    return y, (x, y, middle, rate, slope)


def _settled_gradients(axis, residuals, gradient):
    x, y, middle, rate, slope = residuals
    over, mean = _over(x, axis)
    gradient = jnp.where(y > 0, gradient, 0)
    count = x.size // x.shape[axis]
    by_shift = mean(gradient)
    by_scale = rate * (mean(gradient * x) - middle * by_shift)
    along = -slope * rate * by_scale
    by_x = over(slope) * gradient + over(along) * x - over(slope * by_shift + along * middle)
    return by_x, count * by_scale, count * by_shift


def _over(x: jax.Array, axis: int) -> tuple[Callable[..., jax.Array], Callable[..., jax.Array]]:
    """From numbers of the features to numbers over all of ``x``; and back, to their means."""
    rest = tuple(each for each in range(x.ndim) if each != axis)
    return partial(jnp.expand_dims, axis=rest), partial(jnp.mean, axis=rest)


settled.defvjp(_settled, _settled_gradients)
