"""Values of actions from pictures and vectors."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn

from jaxdyna.networks.convolution import channel_axis
from jaxdyna.networks.layers import Convolution, NormalisedConvolution, Sized
from jaxdyna.networks.patches import to_patches


class ConvolutionalQ(Sized):
    """Values of actions from a picture by three convolutions and a dense layer (Mnih et al. 2015):
    the first of 2x2 cells at a stride of 2, the others of 3x3 at a stride of 1. The dense layer is
    normalised (Ball et al. 2023): without that many updates a real step drive values to infinity.

    Attributes:
        num_actions: how many values.
        widths: channels of the convolutions.
        dense: width of the dense layer.
    """

    num_actions: int
    widths: tuple[int, int, int] = (16, 16, 32)
    dense: int = 128

    @nn.compact
    def __call__(self, stack: jax.Array) -> jax.Array:
        """From ``[N, H, W, C]`` in [0, 1] to ``[N, actions]``, dueling (Wang et al. 2016)."""
        count, height, width, channels = stack.shape
        even = jnp.pad(stack, ((0, 0), (0, height % 2), (0, width % 2), (0, 0)))
        height, width = even.shape[1] // 2, even.shape[2] // 2
        x = even.reshape(count, height, 2, width, 2, channels).transpose(0, 1, 3, 2, 4, 5)
        x = nn.relu(nn.Dense(self.widths[0])(x.reshape(count, height, width, 4 * channels)))
        for features in self.widths[1:]:
            x = nn.relu(Convolution(features, 3, 1)(x))
        x = nn.relu(nn.LayerNorm()(nn.Dense(self.dense)(x.reshape(count, -1))))
        return dueling(nn.Dense(self.num_actions + 1)(x))


class PlainQ(Sized):
    """Values of actions from a picture by 3x3 convolutions without padding and a dense layer, as in
    the code of the paper's authors: a convolution's features are normalised over the pictures at
    hand (Ioffe and Szegedy 2015), a lone picture's over itself, for that code never stops training.

    Attributes:
        num_actions: how many values.
        widths: channels of the convolutions; each takes two cells off a picture's sides.
        dense: width of the dense layer.
        patch: pixels a side of a cell; it divides the picture's sides. Of more than one the first
            convolution has a kernel so many times as large, at a stride of one patch.
    """

    num_actions: int
    widths: tuple[int, ...] = (32, 64, 64)
    dense: int = 512
    patch: int = 1

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """From ``[N, H, W, C]`` in [0, 1] to ``[N, actions]``."""
        axis, x = channel_axis(), to_patches(x, self.patch)
        x = x if axis else x.transpose(3, 1, 2, 0)
        for number, features in enumerate(self.widths):
            x = NormalisedConvolution(features, 3, name=f"Convolution_{number}")(x)
        # A dense layer's inputs are in the order of [H, W, C] either way.
        x = x.reshape(len(x), -1) if axis else x.transpose(1, 2, 0, 3).reshape(-1, x.shape[-1])
        x = nn.relu(nn.DenseGeneral(self.dense, -1 if axis else 0, name="Dense_0")(x))
        return nn.Dense(self.num_actions, name="Dense_1")(x)


class GlimpseQ(Sized):
    """Values of actions from a picture: heads that each look for one thing, and a perceptron on
    where that is and on a glimpse of what is around it. A head's map is a mixture of the stack's
    channels; the mean place on it is a feature point (Finn et al. 2016), and a glimpse is read
    there by rows, then by columns (Gregor et al. 2015): small matrix products, far
    fewer operations than convolutions over the whole picture. The perceptron is normalised as
    `ConvolutionalQ` is.

    Attributes:
        num_actions: how many values.
        heads: things that are looked for; at first each one of the newest frame's colours.
        size: cells a side of a glimpse, odd.
        hidden: widths of the perceptron's hidden layers.
    """

    num_actions: int
    heads: int = 3
    size: int = 5
    hidden: tuple[int, ...] = (128, 128)

    @nn.compact
    def __call__(self, stack: jax.Array) -> jax.Array:
        """From ``[N, H, W, C]`` in [0, 1] to ``[N, actions]``, dueling (Wang et al. 2016)."""
        count, height, width, _ = stack.shape
        maps = nn.relu(nn.Dense(self.heads, use_bias=False, kernel_init=_newest_colours)(stack))
        looks = maps / (maps.sum((1, 2), keepdims=True) + 1e-6)
        by_row, by_column = looks.sum(2), looks.sum(1)
        rows, columns = jnp.linspace(-1, 1, height), jnp.linspace(-1, 1, width)
        place = jnp.concatenate([rows @ by_row, columns @ by_column], axis=-1)
        x = jnp.concatenate([stack, jnp.ones_like(stack[..., :1])], axis=-1)
        seen = glimpses(x, by_row, by_column, self.size).reshape(count, -1)
        seen = jnp.concatenate([seen, place], axis=-1)
        seen = normalised(seen, self.hidden)
        return dueling(nn.Dense(self.num_actions + 1)(seen))


class PerceptronQ(Sized):
    """Values of actions from a vector: a perceptron, normalised as `ConvolutionalQ` is.

    Attributes:
        num_actions: how many values.
        hidden: widths of its hidden layers.
    """

    num_actions: int
    hidden: tuple[int, ...] = (128, 128)

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """From ``[N, n]`` to ``[N, actions]``, dueling (Wang et al. 2016)."""
        x = normalised(x, self.hidden)
        return dueling(nn.Dense(self.num_actions + 1)(x))


def normalised(x: jax.Array, hidden: tuple[int, ...]) -> jax.Array:
    """Dense layers of these widths, each normalised, from ``[N, n]`` to ``[N, hidden[-1]]``; within
    a module's call.
    """
    for features in hidden:
        x = nn.relu(nn.LayerNorm()(nn.Dense(features)(x)))
    return x


def glimpses(x: jax.Array, by_row: jax.Array, by_column: jax.Array, size: int) -> jax.Array:
    """What is around places in pictures ``[N, H, W, C]``, zero beyond the edge: ``[N, heads, size,
    size, C]``, the place in the middle. ``by_row`` ``[N, H, heads]`` and ``by_column`` say how
    likely each row and column is the place's; where it is uncertain, the mean over places.
    """
    if size % 2 == 0:
        raise ValueError(f"size is {size}: give an odd one, for a cell in the middle")
    reach = size // 2
    padded = jnp.pad(x, ((0, 0), (reach, reach), (reach, reach), (0, 0)))

    def shifted(share: jax.Array) -> jax.Array:
        places = [jnp.pad(share, ((0, 0), (i, size - 1 - i), (0, 0))) for i in range(size)]
        return jnp.stack(places)

    strips = jnp.einsum("inrh,nrcf->nhicf", shifted(by_row), padded)
    return jnp.einsum("jnch,nhicf->nhijf", shifted(by_column), strips)


def dueling(values: jax.Array) -> jax.Array:
    """Values of actions from their mean and what each is above it, ``[N, 1 + actions]``."""
    mean, above = values[:, :1], values[:, 1:]
    return mean + above - above.mean(-1, keepdims=True)


def _newest_colours(key: jax.Array, shape: tuple[int, int], dtype: Any = jnp.float32) -> jax.Array:
    """Head ``i`` begins at channel ``i`` from behind, a little of everything else besides."""
    channels, heads = shape
    own = jax.nn.one_hot(channels - 1 - jnp.arange(heads) % channels, channels, dtype=dtype).T
    return own + 0.01 * jax.random.normal(key, shape, dtype)


class FeaturePointQ(Sized):
    """Values of actions from a perceptron on where each colour is: for games in which every colour
    is one thing. Of each channel of a stack it takes the mean row and column, as feature points do
    (Finn et al. 2016), how that moved from frame to frame, how far the newest frame's colours are
    from one another, and the newest frame's rows and columns, one by one. A blurred thing is at
    its mean place, and pale. The perceptron is normalised as `ConvolutionalQ` is.

    Attributes:
        num_actions: how many values.
        channels: of one frame.
        hidden: widths of the perceptron's hidden layers.
        scale: times a distance in a step, and between two colours, of which half the picture is 1.
    """

    num_actions: int
    channels: int = 3
    hidden: tuple[int, ...] = (256, 256)
    scale: float = 8.0

    @nn.compact
    def __call__(self, stack: jax.Array) -> jax.Array:
        """From ``[N, H, W, C * frames]`` in [0, 1] to ``[N, actions]``, dueling (Wang et al.
        2016).
        """
        count = stack.shape[0]
        place, mass = mean_places(stack)
        place = place.reshape(count, -1, self.channels, 2)
        mass = mass.reshape(count, -1, self.channels, 1)
        there = jnp.minimum(mass, 1)
        moved = (place[:, 1:] - place[:, :-1]) * there[:, 1:] * there[:, :-1]
        first, second = jnp.triu_indices(self.channels, 1)
        together = there[:, -1, first] * there[:, -1, second]
        apart = (place[:, -1, second] - place[:, -1, first]) * together
        newest = stack[..., -self.channels :]
        near = jnp.tanh(self.scale * apart)
        parts = [place, there, self.scale * moved, apart, near, newest.max(1), newest.max(2)]
        x = jnp.concatenate([part.reshape(count, -1) for part in parts], axis=-1)
        x = normalised(x, self.hidden)
        return dueling(nn.Dense(self.num_actions + 1)(x))


def mean_places(x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Of pictures ``[N, H, W, C]``: mean row and column of each channel in [-1, 1], ``[N, C, 2]``,
    0 where it is dark, and how much is lit, ``[N, C]``.
    """
    by_row, by_column = x.sum(2), x.sum(1)
    mass = by_row.sum(1)
    rows, columns = (jnp.linspace(-1, 1, length) for length in x.shape[1:3])
    place = jnp.stack([rows @ by_row, columns @ by_column], axis=-1)
    return place / jnp.maximum(mass, 0.5)[..., None], mass
