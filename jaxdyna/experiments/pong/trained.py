"""Models that were trained beforehand: the part `frames` keeps them, and dreams are in them as they
are.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxdyna import fields
from jaxdyna.experiments.engine import InputError, Runs, Work, storage
from jaxdyna.models import AdversarialHParams
from jaxdyna.types import DynamicsModel

KEPT = "weights_"
POLICY = "mixed"
"""Whose episodes they have learned from."""
SAME = ("game", "frames", "scale", "widths", "dense", "hidden")
"""Settings that a model has in common with whoever dreams in it."""


@cache
def kept(work: Work) -> Work:
    """The same training, whose judging returns the weights too."""
    judge: Any = work.judge

    def judged(state: Any, *rest: Any) -> dict[str, jax.Array]:
        leaves = jax.tree.leaves(state.model.params)
        return judge(state, *rest) | {f"{KEPT}{n}": leaf for n, leaf in enumerate(leaves)}

    return work._replace(judge=judged)


@dataclass(frozen=True)
class Given:
    """The weights of a model of a record, for any runs: where it has fewer of them, a run gets that
    of its seed modulo how many there are. Equal ones are one program.

    Attributes:
        options: of who dreams in it; ``options.models`` is the record's folder.
        name: of the model there, such as ``l2``.
        model: as it dreams.
    """

    options: Any
    name: str
    model: DynamicsModel

    def __call__(self, runs: Runs) -> Any:
        """``params [runs, ...]``."""
        return jax.tree.map(lambda array: array[runs.seed % len(array)], self.check())

    def check(self) -> Any:
        """``params [models, ...]``.

        Raises:
            InputError: where there is none, of the same game and sizes, with finite weights.
        """
        folder, name = self.options.models, self.name
        again = (
            f"train it by --part frames --keep --policies {POLICY} --arms {name} with the same "
            f"{', '.join(f'--{each}' for each in SAME)}"
        )
        results, curves = _read(folder)
        config, ours = results.get("config", {}), fields.plain(self.options)
        differ = [each for each in SAME if config.get(each, ours[each]) != ours[each]]
        if differ:
            raise InputError(
                f"--models {folder}: its models differ in --{' --'.join(differ)}: {again}"
            )
        shapes: Any = jax.eval_shape(self.model.init, jax.random.key(0), AdversarialHParams())
        leaves, tree = jax.tree.flatten(shapes.params)
        held = curves.get(f"{name}@{POLICY}", {})
        arrays = [held.get(f"{KEPT}{number}", np.zeros(0)) for number in range(len(leaves))]
        if any(one.shape[1:] != leaf.shape for one, leaf in zip(arrays, leaves, strict=True)):
            raise InputError(f"--models {folder}: no model {name} is kept there: {again}")
        if not all(np.isfinite(one).all() for one in arrays):
            raise InputError(f"--models {folder}: a model {name} diverged: {again}")
        return jax.tree.unflatten(tree, arrays)


@cache
def _read(folder: Path) -> tuple[dict[str, Any], dict[str, dict[str, np.ndarray]]]:
    try:
        results = storage.read_json(folder / "results.json") or {}
        return results, storage.read_curves(folder / "curves.npz")
    except ValueError as error:
        raise InputError(f"--models {folder}: {error}") from None
