"""What metrics are of work that was skipped."""

import math
from typing import Any

import jax
import jax.numpy as jnp


def unknown(metrics: Any) -> Any:
    """What such metrics are, floats or their shapes, where they are not computed: `nothing`."""
    return jax.tree.map(lambda like: jnp.full(like.shape, nothing(), like.dtype), metrics)


def nothing() -> float:
    """The metrics of skipped work: NaN, or minus infinity while JAX looks for NaNs."""
    return -math.inf if jax.config.jax_debug_nans else math.nan  # type: ignore[attr-defined]


def mean_of_done(metric: jax.Array) -> jax.Array:
    """The mean of what was not skipped, a scalar; `nothing` where all was."""
    done = metric > -jnp.inf
    mean = jnp.where(done, metric, 0).sum() / jnp.maximum(done.sum(), 1)
    return jnp.where(done.any(), mean, nothing()).astype(metric.dtype)
