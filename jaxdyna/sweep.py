"""Seeds x hyper-parameters in one jitted call, on every device."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from jaxdyna.fields import check_counts
from jaxdyna.types import Key, PyTree, check_key

DEVICES = "devices"


def sweep(
    train: Callable[[Key, Any], PyTree], keys: Key, hparams: Any, block: int | None = None
) -> PyTree:
    """Runs ``train(key, hparams)`` for every setting and seed in one jitted call. The seeds are
    dealt out to all of `jax.devices`. Nothing is said until the end;
    `jaxdyna.experiments.engine.Engine.play` plays runs in pieces, with progress. `ValueError` where
    the swept leaves differ in length, or another argument cannot be.

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
    """
    check_key(keys, 1)
    check_counts(keys=len(keys), block=1 if block is None else block)
    getattr(train, "check", lambda hparams: None)(hparams)
    return _sweep(train, keys, hparams, num_settings(hparams), block)


@partial(jax.jit, static_argnums=(0, 3, 4))
def _sweep(train, keys, hparams, settings, block):
    def share(keys, hparams):
        def setting(hparams):
            return _over_seeds(lambda key: train(key, hparams), keys, block)

        return _vmap(setting, (_axes(hparams),), settings)(hparams)

    devices = jax.devices()[: len(keys)]
    if len(devices) == 1:
        return share(keys, hparams)
    mesh = Mesh(np.array(devices), (DEVICES,))
    by_seed, shared = PartitionSpec(DEVICES), PartitionSpec()
    spread = jax.shard_map(
        share, mesh=mesh, in_specs=(by_seed, shared), out_specs=PartitionSpec(None, DEVICES),
        check_vma=False,
    )  # fmt: skip
    made = spread(keys[_filled(len(keys), len(devices))], hparams)
    return jax.tree.map(lambda leaf: leaf[:, : len(keys)], made)


def over_runs(function: Callable[..., PyTree], size: int) -> Callable[..., PyTree]:
    """``function`` of one run, over the leading axis of all its arguments: ``size`` runs computed
    together.
    """
    check_counts(size=size)

    def together(*arguments: Any) -> PyTree:
        return _vmap(function, (0,) * len(arguments), size)(*arguments)

    return together


def _over_seeds(function: Callable[[Key], PyTree], keys: Key, block: int | None) -> PyTree:
    """``function`` over the keys, at most ``block`` of them at once."""

    def at_once(keys):
        return _vmap(function, (0,), len(keys))(keys)

    seeds = len(keys)
    if block is None or block >= seeds:
        return at_once(keys)
    results = jax.lax.map(at_once, keys[_filled(seeds, block).reshape(-1, block)])
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:seeds], results)


def _filled(count: int, size: int) -> np.ndarray:
    """The numbers of ``count`` seeds in whole blocks: the last is filled up with copies of the
    first seeds, whose results are cut off again.
    """
    return np.arange(-(-count // size) * size) % count


def _vmap(function: Callable, axes: tuple, size: int) -> Callable[..., PyTree]:
    """``vmap``; an axis of length 1 is taken off first, because a convolution with weights of its
    own for each of one run is slower on a CPU than one that knows of no runs.
    """
    if size != 1:
        return jax.vmap(function, axes, axis_size=size)

    def single(*arguments: Any) -> PyTree:
        bare = [
            jax.tree.map(lambda leaf: leaf[0] if jnp.ndim(leaf) else leaf, part)
            for part in arguments
        ]
        return jax.vmap(lambda: function(*bare), axis_size=1)()

    return single


def num_settings(hparams: Any) -> int:
    """The length of the swept axis; 1 where every leaf is a scalar. `ValueError` where the swept
    leaves differ in length, or have none or further axes.
    """
    shapes = {jnp.shape(leaf) for leaf in jax.tree.leaves(hparams) if jnp.ndim(leaf) > 0}
    for shape in shapes:
        if len(shape) > 1 or 0 in shape:
            raise ValueError(f"a swept hyper-parameter is {list(shape)}: give one value a setting")
    lengths = {shape[0] for shape in shapes}
    if len(lengths) > 1:
        raise ValueError(
            f"swept hyper-parameters have lengths {sorted(lengths)}: "
            "give all of them one value a setting"
        )
    return lengths.pop() if lengths else 1


def _axes(hparams: Any) -> Any:
    return jax.tree.map(lambda leaf: 0 if jnp.ndim(leaf) > 0 else None, hparams)
