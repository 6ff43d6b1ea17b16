"""Work that some of the runs vmapped together need and others do not."""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxdyna.trees import as_held, where


def where_needed(
    phase: jax.Array | bool, needed: jax.Array | bool, axes: tuple[str, ...],
    work: Callable[[], tuple[Any, dict[str, jax.Array]]], idle: Any,
) -> tuple[Any, dict[str, jax.Array]]:  # fmt: skip
    """What ``work`` returns in this phase and where this run needs it, else ``idle`` and `nothing`.

    Args:
        phase: the same for all runs that are vmapped together; False skips the work.
        needed: whether this run needs it.
        axes: names of the axes that runs are vmapped along: where none of them needs it the work
            is skipped too. Without names it is done and discarded.
        work: returns ``(result, metrics)``; metrics are floats.
        idle: what stands in for the result.
    """
    anywhere = jnp.asarray(phase, bool)
    if axes:
        anywhere = anywhere & (jax.lax.pmax(jnp.asarray(needed, jnp.int32), axes) > 0)
    unknown = jax.tree.map(
        lambda metric: jnp.full(metric.shape, nothing(), metric.dtype), jax.eval_shape(work)[1]
    )
    undone = (idle, unknown)
    done = jax.lax.cond(anywhere, lambda: as_held(work(), undone), lambda: undone)
    return where(needed, done, undone)


def nothing() -> float:
    """The metrics of skipped work: NaN, or minus infinity while JAX looks for NaNs."""
    return -math.inf if jax.config.jax_debug_nans else math.nan  # type: ignore[attr-defined]


def mean_of_done(metric: jax.Array) -> jax.Array:
    """The mean of what was not skipped, a scalar; `nothing` where all was."""
    done = metric > -jnp.inf
    mean = jnp.where(done, metric, 0).sum() / jnp.maximum(done.sum(), 1)
    return jnp.where(done.any(), mean, nothing()).astype(metric.dtype)
