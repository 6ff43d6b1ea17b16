"""The adversarial loss of §4.3: a discriminator that tells predicted frames from real ones."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct

from jaxdyna.fields import Checked, check_shape, setting
from jaxdyna.losses import deceive, discern
from jaxdyna.networks import Discriminator
from jaxdyna.optimizers import Optimizer, Trained, optimizer_setting
from jaxdyna.types import Key


@struct.dataclass
class AdversarialHParams:
    """What can be swept: a model's settings, and the adversary's."""

    learning_rate: float = setting(
        2e-4, "Learning rate of the model's optimiser.", at_least=0, everyday=True
    )
    adversarial_weight: float = setting(
        1.0,
        "The paper's lambda: weight of the adversarial loss beside the summed loss of a frame's "
        "pixels. At 0 the model learns as it would alone.",
        at_least=0,
    )
    discriminator_learning_rate: float = setting(
        2e-4, "Learning rate of the discriminator's optimiser.", at_least=0
    )


gan_adam = partial(optax.adam, b1=0.5)
"""Adam with the decay rates (0.5, 0.999) (Radford et al. 2016), for the model and its adversary."""


@dataclass(frozen=True)
class AdversaryConfig(Checked):
    """What decides the program."""

    network: Any = setting(Discriminator(), "A module from pictures [N, H, W, C] to log odds [N].")
    optimizer: Optimizer = optimizer_setting(gan_adam, gan_adam=gan_adam)


class Adversary(NamedTuple):
    """A judge of predicted frames that learns beside the model."""

    init: Callable[[Key, Any], Any]  #: ``(key, hparams) -> state``
    #: ``(state, made [N, H, W, C]) -> loss [N]``: how surely each predicted frame is seen through
    unmasked: Callable[[Any, jax.Array], jax.Array]
    #: ``(state, made, truth, weight [N], hparams) -> (state, metrics)``: one step
    update: Callable[..., tuple[Any, dict[str, jax.Array]]]


def discriminator(
    frame_shape: tuple[int, int, int], config: AdversaryConfig | None = None
) -> Adversary:
    """The paper's adversary.

    The model minimises ``-log D(G(z))`` (the non-saturating form of Goodfellow et al. 2014) rather
    than the printed ``+ log D(G(z))``, which would reward it for being seen through. The
    discriminator minimises the negative of the printed objective. `jaxdyna.experiments.pong.world`
    puts the paper's model together, Fig. 4 scaled to the frame; ``frame_shape`` is ``(height,
    width, channels)``, hparams are `AdversarialHParams`.
    """
    config = config or AdversaryConfig()
    check_shape(3, frame_shape=frame_shape)
    network = config.network

    def init(key: Key, hparams: AdversarialHParams) -> Trained:
        params = network.init(key, jnp.zeros((1, *frame_shape)))
        return Trained(params, optimizer(hparams).init(params))

    def optimizer(hparams: AdversarialHParams) -> optax.GradientTransformation:
        return config.optimizer(hparams.discriminator_learning_rate)

    def unmasked(state: Trained, made: jax.Array) -> jax.Array:
        return deceive(network.apply(state.params, made))

    def update(
        state: Trained, made: jax.Array, truth: jax.Array, weight: jax.Array,
        hparams: AdversarialHParams,
    ) -> tuple[Trained, dict[str, jax.Array]]:  # fmt: skip
        def loss_fn(params):
            real = network.apply(params, truth)
            fake = network.apply(params, made)
            scale = jnp.maximum(weight.sum(), 1e-6)
            right = 0.5 * ((real > 0).astype(jnp.float32) + (fake < 0))
            losses = jax.vmap(discern)(real, fake)
            return (weight * losses).sum() / scale, (weight * right).sum() / scale

        (loss, right), grads = jax.value_and_grad(loss_fn, has_aux=True)(state.params)
        updates, opt_state = optimizer(hparams).update(grads, state.opt_state, state.params)
        params = optax.apply_updates(state.params, updates)
        metrics = {"discriminator_loss": loss, "discriminator_accuracy": right}
        return Trained(params, opt_state), metrics

    return Adversary(init, unmasked, update)
