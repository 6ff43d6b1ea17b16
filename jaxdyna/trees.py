"""Pytrees of arrays and keys: by the names of their leaves, in one another's types, and computed
only where they are needed.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def is_key(leaf: Any) -> bool:
    """Whether it is a typed random key, or several."""
    return jax.dtypes.issubdtype(getattr(leaf, "dtype", None), jax.dtypes.prng_key)


def raw(leaf: Any) -> Any:
    """The leaf, or of a key its data."""
    return jax.random.key_data(leaf) if is_key(leaf) else leaf


def named(tree: Any) -> dict[str, Any]:
    """Every leaf under its path, such as ``.params['w']``; of a key its data."""
    leaves = jax.tree.leaves_with_path(tree)
    return {jax.tree_util.keystr(path): raw(leaf) for path, leaf in leaves}


def named_leaves(tree: Any) -> dict[str, np.ndarray]:
    """`named`, on the host."""
    return {name: np.asarray(leaf) for name, leaf in named(tree).items()}


def unnamed(leaves: Mapping[str, Any], like: Any) -> Any:
    """The tree of `named` leaves, of the structure of ``like``. A leaf that is not among them is
    all zeros, which take no memory.
    """

    def leaf(path: Any, example: Any) -> Any:
        found, key = leaves.get(jax.tree_util.keystr(path)), is_key(example)
        if found is not None:
            return jax.random.wrap_key_data(found) if key else found
        zero = jax.random.key(0) if key else np.zeros((), example.dtype)
        return (jnp if key else np).broadcast_to(zero, example.shape)

    return jax.tree.map_with_path(leaf, like)


def unlike(then: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """In which of `named` leaves two trees differ first by shape or type, in words; nothing where
    in none.
    """
    for name in (*now, *then):
        was, is_ = (_sort(tree[name]) if name in tree else "not there" for tree in (then, now))
        if was != is_:
            return f"{name} was {was} and is {is_}"
    return ""


def _sort(array: Any) -> str:
    return f"{array.dtype}{list(array.shape)}"


def finite(tree: Any) -> jax.Array:
    """Whether all floats in it are neither NaN nor infinite, a bool scalar."""
    floats = [leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    return jnp.array([jnp.isfinite(leaf).all() for leaf in floats], bool).all()


def stack(trees: Sequence[Any]) -> Any:
    """Trees of one structure as one, with a leading axis."""
    with jax.debug_key_reuse(False):
        return jax.tree.map(lambda *x: (jnp if is_key(x[0]) else np).stack(x), *trees)


def as_held(new: Any, old: Any) -> Any:
    """``new`` at the precision of ``old``: what a loop carries keeps its types under x64 too, where
    numbers of 64 bits come from all sides. What is of another kind (no whole number) is left alone.
    """

    def cast(new: jax.Array, old: jax.Array) -> jax.Array:
        same = is_key(new) or new.dtype == old.dtype
        if same or not jnp.can_cast(new.dtype, old.dtype, "same_kind"):
            return new
        return new.astype(old.dtype)

    return jax.tree.map(cast, new, old)


def where(flag: jax.Array | bool, new: Any, old: Any) -> Any:
    """``new`` where ``flag``, a bool scalar, is true, else ``old``; at the precision of ``old``."""
    return as_held(jax.tree.map(lambda new, old: jnp.where(flag, new, old), new, old), old)


def where_needed(needed: jax.Array | bool, work: Callable[[], Any], idle: Any) -> Any:
    """What ``work`` returns where ``needed``, a bool scalar, is true, else ``idle``. Where none of
    what is vmapped together needs it, it costs nothing.
    """
    needed = jnp.asarray(needed, bool)
    done = jax.lax.cond(anywhere(needed), lambda: as_held(work(), idle), lambda: idle)
    return where(_own(needed), done, idle)


@jax.custom_batching.custom_vmap
def anywhere(needed: jax.Array) -> jax.Array:
    """Whether any of what is vmapped together needs it; the same for all of them."""
    return needed


@anywhere.def_vmap
def _anywhere_of(size: int, batched: list[bool], needed: jax.Array) -> tuple[jax.Array, bool]:
    return anywhere(needed.any() if batched[0] else needed), False


@jax.custom_batching.custom_vmap
def _own(needed: jax.Array) -> jax.Array:
    """Whether this one needs it, where others may not; true where it is the same for all, since
    `anywhere` has chosen then, and nothing is copied.
    """
    return jnp.bool_(True)


@_own.def_vmap
def _own_of(size: int, batched: list[bool], needed: jax.Array) -> tuple[jax.Array, bool]:
    return (needed, True) if batched[0] else (_own(needed), False)


def difference(one: Any, other: Any, tolerance: float = 0) -> str:
    """Says where two trees differ first by more than a relative and absolute tolerance; nothing
    where they do not. NaN is equal to NaN.
    """
    left, right = named_leaves(one), named_leaves(other)
    if left.keys() != right.keys():
        return "in structure"
    for path, leaf in left.items():
        shapes = leaf.shape == right[path].shape
        if not shapes or not np.allclose(leaf, right[path], tolerance, tolerance, equal_nan=True):
            return f"at {path or 'the result'}"
    return ""
