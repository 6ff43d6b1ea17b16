"""Seeds x hyper-parameters in one jitted call, whole or in resumable pieces, on every device."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from jaxdyna.types import Key, PyTree

AXES = ("settings", "seeds")
"""Names of the vmapped axes, for `jaxdyna.dyna.make_train` and `make_advance`."""

RUNS = "runs"
"""Name of the axis of `over_runs`."""

DEVICES = "devices"
_BY_SEED = PartitionSpec(None, DEVICES)
_SHARED = PartitionSpec()


def sweep(
    train: Callable[[Key, Any], PyTree], keys: Key, hparams: Any, block: int | None = None
) -> PyTree:
    """Runs ``train(key, hparams)`` for every setting and seed in one jitted call. The seeds are
    dealt out equally to as many of `jax.devices` as their number can be divided by.

    Args:
        train: a pure function; the same function object compiles once per shape.
        keys: random keys ``[seeds]``, shared by all settings.
        hparams: a pytree; leaves with an axis ``[settings]`` are swept together, scalars are
            shared.
        block: seeds vmapped together, blocks one after the other; None for all at once. Work that
            no seed of a block needs is skipped: on a CPU, runs that often rest are the faster the
            smaller their blocks.

    Returns:
        What ``train`` returns with leading axes ``[settings, seeds]`` (settings is 1 where
        nothing is swept).

    Raises:
        ValueError: where the swept leaves differ in length.
    """
    return _sweep(train, keys, hparams, num_settings(hparams), block)


@partial(jax.jit, static_argnums=(0, 3, 4))
def _sweep(train, keys, hparams, settings, block):
    def share(keys, hparams):
        def setting(hparams):
            return _over_seeds(lambda key: train(key, hparams), block)(keys)

        return _named_vmap(setting, (_axes(hparams),), settings, AXES[0])(hparams)

    return _over_devices(share, keys.shape[0], (PartitionSpec(DEVICES), _SHARED))(keys, hparams)


def make_pieces(
    init: Callable, advance: Callable, block: int | None = None
) -> tuple[Callable, Callable]:
    """The same sweep in pieces, for progress, checkpoints and early stops between them.

    Args:
        init: ``(key, hparams) -> state``.
        advance: ``(state, episodes, hparams) -> (state, metrics)``.
        block: see `sweep`.

    Returns:
        ``start(keys, hparams) -> state`` and ``proceed(state, episodes, hparams) -> (state,
        metrics)``, both jitted, with leading axes ``[settings, seeds]`` on state and metrics.
        ``proceed`` reuses the memory of the state it is given.
    """

    def start(keys, hparams):
        return sweep(init, keys, hparams, block)

    @partial(jax.jit, donate_argnums=0)
    def proceed(state, episodes, hparams):
        def share(state, episodes, hparams):
            def setting(state, hparams):
                return _over_seeds(lambda one: advance(one, episodes, hparams), block)(state)

            settings = jax.tree.leaves(state)[0].shape[0]
            return _named_vmap(setting, (0, _axes(hparams)), settings, AXES[0])(state, hparams)

        seeds = jax.tree.leaves(state)[0].shape[1]
        spread = _over_devices(share, seeds, (_BY_SEED, _SHARED, _SHARED))
        return spread(state, episodes, hparams)

    return start, proceed


def over_runs(function: Callable[..., PyTree], size: int) -> Callable[..., PyTree]:
    """``function`` of one run, over the leading axis of all its arguments: ``size`` runs computed
    together, along the axis `RUNS`.
    """

    def together(*arguments: Any) -> PyTree:
        return _named_vmap(function, (0,) * len(arguments), size, RUNS)(*arguments)

    return together


def _over_devices(share: Callable[..., PyTree], seeds: int, specs: tuple) -> Callable[..., PyTree]:
    """``share``, which works on any number of seeds, with its seeds dealt out to the devices."""
    devices = jax.devices()
    count = max(n for n in range(1, len(devices) + 1) if seeds % n == 0)
    if count == 1:
        return share
    mesh = Mesh(np.array(devices[:count]), (DEVICES,))
    return jax.shard_map(share, mesh=mesh, in_specs=specs, out_specs=_BY_SEED, check_vma=False)


def _over_seeds(function: Callable[[Any], PyTree], block: int | None) -> Callable[[Any], PyTree]:
    """``function`` over the leading axis of its argument, at most ``block`` seeds at once."""

    def at_once(argument):
        return _named_vmap(function, (0,), jax.tree.leaves(argument)[0].shape[0], AXES[1])(argument)

    def in_blocks(argument):
        seeds = jax.tree.leaves(argument)[0].shape[0]
        if block is None or block >= seeds:
            return at_once(argument)
        if seeds % block == 0:  # no copy of what may be large
            apart = jax.tree.map(lambda leaf: leaf.reshape(-1, block, *leaf.shape[1:]), argument)
            results = jax.lax.map(at_once, apart)
            return jax.tree.map(lambda x: x.reshape(seeds, *x.shape[2:]), results)
        blocks = -(-seeds // block)
        # The last block is filled up with copies of the first seeds, which are cut off again.
        rows = (jnp.arange(blocks * block) % seeds).reshape(blocks, block)
        results = jax.lax.map(at_once, jax.tree.map(lambda leaf: leaf[rows], argument))
        return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:seeds], results)

    return in_blocks


def _named_vmap(function: Callable, axes: tuple, size: int, name: str) -> Callable[..., PyTree]:
    """``vmap`` along a named axis; one of length 1 is taken off first, because a convolution with
    weights of its own for each of one run is slower on a CPU than one that knows of no runs.
    """
    if size != 1:
        return jax.vmap(function, axes, axis_size=size, axis_name=name)

    def single(*arguments: Any) -> PyTree:
        bare = [
            jax.tree.map(lambda leaf: leaf[0] if jnp.ndim(leaf) else leaf, part)
            for part in arguments
        ]
        return jax.vmap(lambda: function(*bare), axis_size=1, axis_name=name)()

    return single


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
