"""Seeds x hyper-parameters in one jitted call, whole or in resumable pieces."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from jaxdyna.types import Key, PyTree


def sweep(train: Callable[[Key, Any], PyTree], keys: Key, hparams: Any) -> PyTree:
    """Runs ``train(key, hparams)`` for every setting and seed in one jitted call.

    Args:
        train: a pure function; the same function object compiles once per shape.
        keys: random keys ``[seeds]``, shared by all settings.
        hparams: a pytree; leaves with an axis ``[settings]`` are swept together, scalars are
            shared.

    Returns:
        What ``train`` returns with leading axes ``[settings, seeds]`` (settings is 1 where
        nothing is swept).

    Raises:
        ValueError: where the swept leaves differ in length.
    """
    settings = num_settings(hparams)
    return _sweep(train, keys, hparams, settings)


@partial(jax.jit, static_argnums=(0, 3))
def _sweep(train, keys, hparams, settings):
    seeds = jax.vmap(train, in_axes=(0, None))
    return jax.vmap(seeds, in_axes=(None, _axes(hparams)), axis_size=settings)(keys, hparams)


def make_pieces(init: Callable, advance: Callable) -> tuple[Callable, Callable]:
    """The same sweep in pieces, for progress, checkpoints and early stops between them.

    Args:
        init: ``(key, hparams) -> state``.
        advance: ``(state, episodes, hparams) -> (state, metrics)``.

    Returns:
        ``start(keys, hparams) -> state`` and ``proceed(state, episodes, hparams) -> (state,
        metrics)``, both jitted, with leading axes ``[settings, seeds]`` on state and metrics.
        ``proceed`` reuses the memory of the state it is given.
    """

    def start(keys, hparams):
        return sweep(init, keys, hparams)

    @partial(jax.jit, donate_argnums=0)
    def proceed(state, episodes, hparams):
        seeds = jax.vmap(advance, in_axes=(0, None, None))
        return jax.vmap(seeds, in_axes=(0, None, _axes(hparams)))(state, episodes, hparams)

    return start, proceed


def num_settings(hparams: Any) -> int:
    """The length of the swept axis; 1 where every leaf is a scalar.

    Raises:
        ValueError: where the swept leaves differ in length.
    """
    lengths = {jnp.shape(leaf)[0] for leaf in jax.tree.leaves(hparams) if jnp.ndim(leaf) > 0}
    if len(lengths) > 1:
        raise ValueError(
            f"swept hyper-parameters have lengths {sorted(lengths)}: "
            "give all of them one value a setting"
        )
    return lengths.pop() if lengths else 1


def _axes(hparams: Any) -> Any:
    return jax.tree.map(lambda leaf: 0 if jnp.ndim(leaf) > 0 else None, hparams)
