"""The next picture, the reward and the end from a stack of pictures and an action."""

import jax
import jax.numpy as jnp
import optax
from flax import linen as nn

from jaxdyna.networks.layers import Convolution, Sized


class LocalDynamics(Sized):
    """What happens to a cell follows from the cells around it: convolutions throughout, the action
    by a Hadamard product with the first layer's features, and a channel of ones, which next to the
    padding's zeros tells where the world ends.

    Attributes:
        channels: of the picture that is predicted.
        widths: of the 3x3 layers; each lets a cell see one further.
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
        x = jnp.concatenate([stack, jnp.ones_like(stack[..., :1])], axis=-1)
        for number, width in enumerate(self.widths):
            x = Convolution(width, 3, 1)(x)
            if number == 0:
                x = x * nn.Dense(width, bias_init=nn.initializers.ones)(action)[:, None, None]
            x = nn.relu(x)
        return nn.Dense(self.channels)(x), x


class EncoderDecoder(Sized):
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


class LocalReward(Sized):
    """The reward as a sum over cells of what is seen in each after the step. Where there are always
    as many things of a kind many sums are the same, so cells are charged for what they earn, and
    of all explanations the one with the fewest cells wins.

    Attributes:
        width: of the hidden layer.
        price: charged for a cell's absolute reward.
        around: whether a cell is judged by its features under the picture, which know what is
            around it and what was done, instead of by its colours alone.
    """

    width: int = 16
    price: float = 0.1
    around: bool = False

    @nn.compact
    def __call__(self, features: jax.Array, next_frame: jax.Array) -> tuple[jax.Array, jax.Array]:
        """From features and the next picture ``[N, H, W, C]``, this in [0, 1], to rewards and
        charges, both ``[N]``.
        """
        x = nn.relu(nn.Dense(self.width)(features if self.around else next_frame))
        earned = nn.Dense(1, use_bias=False)(x)[..., 0]
        return earned.sum((1, 2)), self.price * jnp.abs(earned).sum((1, 2))


class JointReward(nn.Module):
    """The reward from the joint features of stack and action (Leibfried et al. 2016)."""

    @nn.compact
    def __call__(self, features: jax.Array, next_frame: jax.Array) -> tuple[jax.Array, jax.Array]:
        """From features ``[N, ...]`` to rewards ``[N]``, at no charge."""
        reward = nn.Dense(1)(features.reshape(features.shape[0], -1))[..., 0]
        return reward, jnp.zeros_like(reward)


class SignedReward(nn.Module):
    """A reward of -1, 0 or 1 from the joint features, as in the authors' code a class: the
    probability of 1 less that of -1. Where nothing happens that is close to 0, and a sum over many
    steps stays so, as that of a linear head's errors would not.
    """

    @nn.compact
    def __call__(self, features: jax.Array, next_frame: jax.Array) -> tuple[jax.Array, jax.Array]:
        """From features ``[N, ...]`` to rewards ``[N]``, at no charge."""
        odds = nn.Dense(2)(features.reshape(features.shape[0], -1))
        reward = jax.nn.sigmoid(odds[:, 0]) - jax.nn.sigmoid(odds[:, 1])
        return reward, jnp.zeros_like(reward)


class ClassReward(Sized):
    """The reward as a class, by a perceptron on the joint features: the paper's authors' head
    (Leibfried et al. 2016 predict rewards by classes too). It predicts the most likely class's.

    Attributes:
        rewards: of the classes; a reward belongs to the class of the nearest.
        weights: of the classes in the loss.
        hidden: widths of the hidden layers.
    """

    rewards: tuple[float, ...]
    weights: tuple[float, ...]
    hidden: tuple[int, ...] = (512, 256)

    @nn.compact
    def __call__(self, features: jax.Array, next_frame: jax.Array) -> tuple[jax.Array, jax.Array]:
        """From features ``[N, ...]`` to rewards ``[N]`` and the classes' log odds ``[N, classes]``,
        which `error` takes.
        """
        x = features.reshape(features.shape[0], -1)
        for width in self.hidden:
            x = nn.relu(nn.Dense(width)(x))
        odds = nn.Dense(len(self.rewards))(x)
        return jnp.asarray(self.rewards)[odds.argmax(-1)], odds

    def error(self, reward: jax.Array, odds: jax.Array, truth: jax.Array) -> jax.Array:
        """The weighted cross-entropy ``[N]`` of what the head says and the true rewards ``[N]``."""
        label = jnp.abs(truth[:, None] - jnp.asarray(self.rewards)).argmin(-1)
        entropy = optax.softmax_cross_entropy_with_integer_labels(odds, label)
        return jnp.asarray(self.weights)[label] * entropy


class FrameModel(nn.Module):
    """A network that predicts the next picture, with heads for the reward and the end."""

    #: ``(stack, action, train, valid) -> (raw, features)``: `LocalDynamics`, `EncoderDecoder`
    network: nn.Module
    #: ``(features, next_frame) -> (reward [N], charge [N])``, the charge to be added to the loss:
    #: `LocalReward`, `JointReward`; or one with a loss of its own, `ClassReward`; None for 0
    reward: nn.Module | None
    terminates: bool  #: whether there is a head for the end

    def setup(self) -> None:
        """The end's head."""
        self.end = nn.Dense(1) if self.terminates else None

    def __call__(
        self, stack: jax.Array, action: jax.Array, next_frame: jax.Array, train: bool,
        valid: jax.Array | None = None,
    ) -> tuple[jax.Array, ...]:  # fmt: skip
        """Raw picture ``[N, H, W, C]``, then as `outcome`."""
        raw, features = self.network(stack, action, train, valid)
        return raw, *self.outcome(features, next_frame)

    def frame(self, stack: jax.Array, action: jax.Array) -> tuple[jax.Array, ...]:
        """Raw picture and features, once trained."""
        return self.network(stack, action, False)

    def outcome(self, features: jax.Array, next_frame: jax.Array) -> tuple[jax.Array, ...]:
        """Reward, its charge and log odds of the end, ``[N]``; without a head 0, minus infinity."""
        count = next_frame.shape[0]
        reward = charge = jnp.zeros(count)
        if self.reward is not None:
            reward, charge = self.reward(features, next_frame)
        if self.end is None:
            return reward, charge, jnp.full(count, -jnp.inf)
        pooled = features.reshape(count, -1, features.shape[-1]).mean(1)
        return reward, charge, self.end(pooled)[..., 0]
