"""Flax Linen modules. The rest of the package sees only parameters and functions."""

from __future__ import annotations

from collections.abc import Callable

import jax
from flax import linen as nn


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
