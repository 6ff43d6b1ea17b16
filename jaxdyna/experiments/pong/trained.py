"""Models that were trained beforehand: the part `frames` keeps them, and dreams are in them as they
are.
"""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxdyna.experiments.engine import InputError, Runs, Work, storage
from jaxdyna.models import AdversarialHParams
from jaxdyna.types import DynamicsModel

KEPT = "weights_"
POLICY = "mixed"
"""Whose episodes they have learned from."""


@cache
def kept(work: Work) -> Work:
    """The same training, whose judging returns the weights too."""
    judge: Any = work.judge

    def judged(state: Any, *rest: Any) -> dict[str, jax.Array]:
        leaves = jax.tree.leaves(state.model.params)
        return judge(state, *rest) | {f"{KEPT}{n}": leaf for n, leaf in enumerate(leaves)}

    return work._replace(judge=judged)


@cache
def given(folder: Path, name: str, model: DynamicsModel) -> Callable[[Runs], Any]:
    """The weights of a model of that record, for any runs: where it has fewer of them, a run gets
    that of its seed modulo how many there are. One object, and so one program, for the same ones.

    Args:
        folder: the record's.
        name: of the model there, such as ``l2``.
        model: as it dreams.

    Returns:
        ``(runs) -> params [runs, ...]``. Its ``check()`` raises `InputError` where there is none
        whose weights have the model's shapes.
    """

    def weights() -> Any:
        shapes: Any = jax.eval_shape(model.init, jax.random.key(0), AdversarialHParams()).params
        leaves, tree = jax.tree.flatten(shapes)
        held = _read(folder).get(f"{name}@{POLICY}", {})
        arrays = [held.get(f"{KEPT}{number}", np.zeros(0)) for number in range(len(leaves))]
        if any(one.shape[1:] != leaf.shape for one, leaf in zip(arrays, leaves, strict=True)):
            raise InputError(
                f"--models {folder}: no model {name} of these sizes is kept there: train it by "
                f"--part frames --keep --policies {POLICY} --arms {name} with the same --game, "
                "--frames, --scale, --widths, --dense and --hidden"
            )
        return jax.tree.unflatten(tree, arrays)

    def collect(runs: Runs) -> Any:
        return jax.tree.map(lambda array: array[runs.seed % len(array)], weights())

    collect.check = weights  # type: ignore[attr-defined]
    return collect


@cache
def _read(folder: Path) -> dict[str, dict[str, np.ndarray]]:
    return storage.read_curves(folder / "curves.npz")
