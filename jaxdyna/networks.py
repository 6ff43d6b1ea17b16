"""Flax Linen modules. The rest of the package sees only parameters and functions."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import linen as nn

from jaxdyna.convolution import convolve


class MLP(nn.Module):
    """A multilayer perceptron; the last layer is linear.

    Attributes:
        features: width of each layer, the output's last.
        activation: between the layers.
        weight_variance: times the number of inputs, the variance of a weight at the start: 1 is
            LeCun's, 1/3 the uniform one that PyTorch's layers (the authors' code) start from.
            Smaller features keep plain SGD stable at larger learning rates.
    """

    features: tuple[int, ...]
    activation: Callable[[jax.Array], jax.Array] = nn.relu
    weight_variance: float = 1.0

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps ``[..., in]`` to ``[..., features[-1]]``."""
        initial = nn.initializers.variance_scaling(self.weight_variance, "fan_in", "uniform")
        for width in self.features[:-1]:
            x = self.activation(nn.Dense(width, kernel_init=initial)(x))
        return nn.Dense(self.features[-1], kernel_init=initial)(x)


class Convolution(nn.Module):
    """A convolution of stride 1 with a bias, by `jaxdyna.convolution.convolve`.

    Attributes:
        features: channels of the output.
        size: cells a side of the kernel.
        padding: zeros around the picture; ``size - 1`` makes it a transposed convolution.
    """

    features: int
    size: int
    padding: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps ``[N, H, W, C]`` to ``[N, H', W', features]``."""
        shape = (self.size, self.size, x.shape[-1], self.features)
        kernel = self.param("kernel", nn.initializers.he_normal(), shape)
        bias = self.param("bias", nn.initializers.zeros, (self.features,))
        return convolve(x, kernel, self.padding) + bias


class LocalDynamics(nn.Module):
    """What happens to a cell follows from the cells around it: convolutions throughout, the action
    by a Hadamard product with the first layer's features, and a channel of ones, which next to the
    padding's zeros tells where the world ends.

    Attributes:
        channels: of the picture that is predicted.
        widths: of the 3x3 layers; as many of them as a cell's influence spreads in one step.
    """

    channels: int
    widths: tuple[int, ...] = (32, 32)

    @nn.compact
    def __call__(
        self, stack: jax.Array, action: jax.Array, train: bool, valid: jax.Array | None = None
    ) -> tuple[jax.Array, ...]:
        """From pictures ``[N, H, W, C]`` in [0, 1] and actions ``[N, actions]`` (one-hot) to the
        raw next picture ``[N, H, W, channels]`` and the features under it ``[N, H, W, width]``.
        """
        del train, valid
        x = jnp.concatenate([stack, jnp.ones_like(stack[..., :1])], axis=-1)
        for number, width in enumerate(self.widths):
            x = Convolution(width, 3, 1)(x)
            if number == 0:
                x = x * nn.Dense(width, bias_init=nn.initializers.ones)(action)[:, None, None]
            x = nn.relu(x)
        return nn.Dense(self.channels)(x), x


class AttentionQ(nn.Module):
    """Values of actions from a picture: convolutions, heads that each look at one place of it
    (softmax over cells, Mott et al. 2019), a perceptron on what they see and where.

    Attributes:
        num_actions: how many values.
        widths: of the 3x3 convolutions.
        heads: places that are looked at.
        hidden: widths of the perceptron's hidden layers.
        sharpness: times the softmax's logits.
    """

    num_actions: int
    widths: tuple[int, ...] = (16, 16, 32)
    heads: int = 4
    hidden: tuple[int, ...] = (128, 128)
    sharpness: float = 3.0

    @nn.compact
    def __call__(self, stack: jax.Array) -> jax.Array:
        """From ``[N, H, W, C]`` in [0, 1] to ``[N, actions]``, dueling (Wang et al. 2016)."""
        count, height, width, _ = stack.shape
        x = jnp.concatenate([stack, jnp.ones_like(stack[..., :1])], axis=-1)
        for features in self.widths:
            x = nn.relu(Convolution(features, 3, 1)(x))
        looks = self.sharpness * nn.Dense(self.heads)(jnp.concatenate([stack, x], axis=-1))
        looks = jax.nn.softmax(looks.reshape(count, -1, self.heads), axis=1)
        rows, columns = jnp.linspace(-1, 1, height), jnp.linspace(-1, 1, width)
        place = jnp.stack(jnp.meshgrid(rows, columns, indexing="ij"), axis=-1)
        place = jnp.broadcast_to(place, (count, height, width, 2))
        seen = jnp.concatenate([x, place], axis=-1).reshape(count, height * width, -1)
        seen = jnp.einsum("nch,ncf->nhf", looks, seen).reshape(count, -1)
        for features in self.hidden:
            seen = nn.relu(nn.Dense(features)(seen))
        values = nn.Dense(self.num_actions + 1)(seen)
        mean, above = values[:, :1], values[:, 1:]
        return mean + above - above.mean(-1, keepdims=True)


class EncoderDecoder(nn.Module):
    """The paper's Fig. 4 (Oh et al. 2015): convolutions and a dense layer, the Hadamard product
    with the action's features, a dense layer and transposed convolutions back, with ReLU and
    BatchNorm after every layer but the first, which has no BatchNorm, and the last, which has
    neither. As in the paper's equation ``W_dec (W_enc h * W_a a) + b`` the product's factors have
    no ReLU, the action's no BatchNorm; it starts around one (ours: from zero it learns later).

    Attributes:
        channels: of the picture that is predicted.
        widths: of the convolutions; the decoder has them in reverse.
        kernels: cells a side of their kernels.
        dense: width of the dense layer, at which the action comes in.
    """

    channels: int
    widths: tuple[int, ...] = (32, 32, 32)
    kernels: tuple[int, ...] = (5, 4, 4)
    dense: int = 256

    @nn.compact
    def __call__(
        self, stack: jax.Array, action: jax.Array, train: bool, valid: jax.Array | None = None
    ) -> tuple[jax.Array, ...]:
        """From pictures ``[N, H, W, C]`` in [0, 1] and actions ``[N, actions]`` (one-hot) to the
        raw next picture ``[N, H, W, channels]`` and the joint features ``[N, dense]``. BatchNorm
        learns from the rows that are ``valid``, bool ``[N]``; all by default.
        """

        def normalise(x):
            mask = None if valid is None else valid.reshape(-1, *[1] * (x.ndim - 1))
            return nn.BatchNorm(use_running_average=not train, momentum=0.95)(x, mask=mask)

        def settle(x):
            return nn.relu(normalise(x))

        def around_one(key, shape, dtype=jnp.float32):
            return 1 + jax.random.normal(key, shape, dtype)

        x = nn.relu(Convolution(self.widths[0], self.kernels[0], 0)(stack))
        for width, size in zip(self.widths[1:], self.kernels[1:], strict=True):
            x = settle(Convolution(width, size, 0)(x))
        encoded = x.shape[1:]
        seen = normalise(nn.Dense(self.dense, use_bias=False)(x.reshape(x.shape[0], -1)))
        done = nn.Dense(self.dense, use_bias=False, kernel_init=around_one)(action)
        joint = seen * done
        x = settle(nn.Dense(encoded[0] * encoded[1] * encoded[2])(joint))
        x = x.reshape(-1, *encoded)
        for width, size in zip(self.widths[-2::-1], self.kernels[:0:-1], strict=True):
            x = settle(Convolution(width, size, size - 1)(x))
        return Convolution(self.channels, self.kernels[0], self.kernels[0] - 1)(x), joint


class LocalReward(nn.Module):
    """The reward as a sum over cells of what is seen in each after the step. Where there are always
    as many things of a kind many sums are the same, so cells are charged for what they earn, and
    of all explanations the one with the fewest cells wins.

    Attributes:
        width: of the hidden layer.
        price: charged for a cell's absolute reward.
    """

    width: int = 16
    price: float = 0.1

    @nn.compact
    def __call__(self, features: jax.Array, next_frame: jax.Array) -> tuple[jax.Array, jax.Array]:
        """From the next picture ``[N, H, W, C]`` in [0, 1] to rewards and charges, both ``[N]``."""
        del features
        x = nn.relu(nn.Dense(self.width)(next_frame))
        earned = nn.Dense(1, use_bias=False)(x)[..., 0]
        return earned.sum((1, 2)), self.price * jnp.abs(earned).sum((1, 2))


class JointReward(nn.Module):
    """The reward from the joint features of stack and action (Leibfried et al. 2016)."""

    @nn.compact
    def __call__(self, features: jax.Array, next_frame: jax.Array) -> tuple[jax.Array, jax.Array]:
        """From features ``[N, ...]`` to rewards ``[N]``, at no charge."""
        del next_frame
        reward = nn.Dense(1)(features.reshape(features.shape[0], -1))[..., 0]
        return reward, jnp.zeros_like(reward)


class FrameModel(nn.Module):
    """A network that predicts the next picture, with heads for the reward and the end.

    Attributes:
        network: ``(stack, action, train, valid) -> (raw, features)``: `LocalDynamics`,
            `EncoderDecoder`.
        reward: ``(features, next_frame) -> (reward [N], charge [N])``, the charge to be added to
            the loss: `LocalReward`, `JointReward`; None for 0.
        terminates: whether there is a head for the end.
    """

    network: nn.Module
    reward: nn.Module | None
    terminates: bool

    def setup(self) -> None:
        """The end's head."""
        self.end = nn.Dense(1) if self.terminates else None

    def __call__(
        self,
        stack: jax.Array,
        action: jax.Array,
        next_frame: jax.Array,
        train: bool,
        valid: jax.Array | None = None,
    ) -> tuple[jax.Array, ...]:
        """Raw picture ``[N, H, W, C]``, then as `outcome`."""
        raw, features = self.network(stack, action, train, valid)
        return raw, *self.outcome(features, next_frame)

    def frame(self, stack: jax.Array, action: jax.Array) -> tuple[jax.Array, ...]:
        """Raw picture and features, once trained."""
        return self.network(stack, action, False)

    def outcome(self, features: jax.Array, next_frame: jax.Array) -> tuple[jax.Array, ...]:
        """Reward, its charge and the log odds of the end, each ``[N]``; without a head 0 and minus
        infinity.
        """
        count = next_frame.shape[0]
        reward = charge = jnp.zeros(count)
        if self.reward is not None:
            reward, charge = self.reward(features, next_frame)
        if self.end is None:
            return reward, charge, jnp.full(count, -jnp.inf)
        pooled = features.reshape(count, -1, features.shape[-1]).mean(1)
        return reward, charge, self.end(pooled)[..., 0]
