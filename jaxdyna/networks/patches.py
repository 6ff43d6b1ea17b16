"""Large frames, cut into patches: any network of small pictures serves there too."""

import jax
import jax.numpy as jnp
from flax import linen as nn

from jaxdyna.networks.layers import Convolution, Sized


def to_patches(picture: jax.Array, size: int) -> jax.Array:
    """``[..., H, W, C]`` as ``[..., H / size, W / size, size * size * C]``."""
    *lead, height, width, channels = picture.shape
    if height % size or width % size:
        raise ValueError(f"a picture of {height}x{width} has no patches of {size}: give a divisor")
    x = picture.reshape(*lead, height // size, size, width // size, size, channels)
    x = jnp.swapaxes(x, -4, -3)
    return x.reshape(*lead, height // size, width // size, size * size * channels)


def from_patches(patches: jax.Array, size: int) -> jax.Array:
    """The way back, from ``[..., h, w, size * size * C]`` to ``[..., h * size, w * size, C]``."""
    *lead, rows, columns, depth = patches.shape
    if depth % size**2:
        raise ValueError(f"{depth} channels are no patches of {size}: give a multiple of {size**2}")
    channels = depth // size**2
    x = jnp.swapaxes(patches.reshape(*lead, rows, columns, size, size, channels), -4, -3)
    return x.reshape(*lead, rows * size, columns * size, channels)


class Patched(Sized):
    """A frame network on patches instead of pixels. Its first layer is then a convolution at a
    stride of ``size`` pixels, with a kernel so many times as large as on pixels; its last one is
    the same, transposed.

    Attributes:
        network: such as `jaxdyna.networks.EncoderDecoder`; it predicts ``size * size`` times as
            many channels as the picture has.
        size: pixels a side of a patch; it divides the picture's height and width.
    """

    network: nn.Module
    size: int

    def __call__(
        self, stack: jax.Array, action: jax.Array, train: bool, valid: jax.Array | None = None
    ) -> tuple[jax.Array, ...]:
        """As the network: raw next picture ``[N, H, W, channels]`` and features."""
        raw, features = self.network(to_patches(stack, self.size), action, train, valid)
        return from_patches(raw, self.size), features


class Discriminator(Sized):
    """Tells true pictures from made ones (Goodfellow et al. 2014): convolutions on ever larger
    patches, leaky ReLU between them, one number for the whole picture.

    Attributes:
        strides: pixels, then patches, a side that become one patch in each layer.
        widths: of the layers.
    """

    strides: tuple[int, ...] = (4, 2)
    widths: tuple[int, ...] = (32, 64)

    @nn.compact
    def __call__(self, picture: jax.Array) -> jax.Array:
        """From pictures ``[N, H, W, C]`` to the log odds ``[N]`` that each is a true one."""
        x = picture
        for stride, width in zip(self.strides, self.widths, strict=True):
            x = nn.leaky_relu(Convolution(width, 3, 1)(to_patches(x, stride)), 0.2)
        return nn.Dense(1)(x.reshape(x.shape[0], -1))[:, 0]
