"""The setting of an optimiser, what it trains, and AdamW."""

from collections.abc import Callable
from functools import cache, partial
from typing import Any

import optax
from flax import struct

from jaxdyna.fields import setting


@struct.dataclass
class Trained:
    """The state of a learner: its parameters, and its optimiser's state."""

    params: Any
    opt_state: Any


Optimizer = Callable[[Any], optax.GradientTransformation]


def optimizer_setting(default: Optimizer, **more: Optimizer) -> Any:
    """The setting of an optimiser; ``more`` of them can be chosen by name than optax's."""
    named = {made.__name__: made for made in (optax.sgd, optax.adam, optax.adamw, optax.rmsprop)}
    help = "Optimiser: from a learning rate to an optax transformation."
    return setting(default, help, choices=named | more)


@cache
def decayed_adam(weight_decay: float, b1: float = 0.9) -> Optimizer:
    """AdamW (Loshchilov and Hutter 2019): one object, and so one program, for the same settings."""
    return partial(optax.adamw, b1=b1, weight_decay=weight_decay)
