"""What networks are made of."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn

from jaxdyna.fields import SettingError, check_counts, check_shape, why
from jaxdyna.networks.convolution import convolve


class Sized(nn.Module):
    """A module whose whole numbers are sizes, at least 1, and tuples of them likewise.

    Raises:
        SettingError: when it is made, where one is none; ``_check`` says what else it demands.
    """

    def __post_init__(self) -> None:
        for name, field in self.__dataclass_fields__.items():
            if field.type == "int":
                check_counts(int(name != "padding"), **{name: getattr(self, name)})
            elif str(field.type).startswith("tuple[int"):
                check_shape(**{name: getattr(self, name)})
        self._check()
        super().__post_init__()

    def _check(self) -> None:
        """Nothing more."""


def output_shapes(network: Any, *inputs: Any) -> Any:
    """What a module makes of inputs of these shapes (or of what is no shape as it is): arrays
    without values.

    Raises:
        ValueError: where it does not take them.
    """

    def made(key: jax.Array) -> Any:
        given = [jnp.zeros(x) if isinstance(x, tuple) else x for x in inputs]
        return network.apply(network.init(key, *given), *given)

    try:
        return jax.eval_shape(made, jax.random.key(0))
    except Exception as error:
        name, shapes = type(network).__name__, ", ".join(map(str, inputs))
        raise ValueError(
            f"the network {name} does not take inputs {shapes}, "
            f"give one that does, with kernels that fit into them: {why(error)}"
        ) from error


class MLP(Sized):
    """A multilayer perceptron; the last layer is linear.

    Attributes:
        features: width of each layer, the output's last.
        weight_variance: times the number of inputs, the variance of a weight at the start: 1 is
            LeCun's, 1/3 the uniform one that PyTorch's layers (the authors' code) start from.
            Smaller features keep plain SGD stable at larger learning rates.
    """

    features: tuple[int, ...]
    weight_variance: float = 1.0

    def _check(self) -> None:
        if not self.features:
            raise SettingError("features", "is (): give the width of the output at least")

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps ``[..., in]`` to ``[..., features[-1]]``."""
        initial = nn.initializers.variance_scaling(self.weight_variance, "fan_in", "uniform")
        for width in self.features[:-1]:
            x = nn.relu(nn.Dense(width, kernel_init=initial)(x))
        return nn.Dense(self.features[-1], kernel_init=initial)(x)


class Convolution(Sized):
    """A convolution of stride 1 with a bias, by `jaxdyna.networks.convolution.convolve`.

    Attributes:
        features: channels of the output.
        size: cells a side of the kernel.
        padding: zeros around the picture; ``size - 1`` makes it a transposed convolution.
    """

    features: int
    size: int
    padding: int

    def _check(self) -> None:
        if self.padding >= self.size:
            said = f"is {self.padding}: give less than the kernel's size, {self.size}"
            raise SettingError("padding", said)

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps ``[N, H, W, C]`` to ``[N, H', W', features]``."""
        shape = (self.size, self.size, x.shape[-1], self.features)
        kernel = self.param("kernel", nn.initializers.he_normal(), shape)
        bias = self.param("bias", nn.initializers.zeros, (self.features,))
        return convolve(x, kernel, self.padding) + bias
