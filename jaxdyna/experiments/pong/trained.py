"""Models trained beforehand: the part `frames` keeps them, and dreams are in them as they are."""

from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxdyna import fields
from jaxdyna.experiments.engine import Curves, InputError, Runs, Work, storage
from jaxdyna.models import AdversarialHParams
from jaxdyna.types import DynamicsModel

KEPT = "weights_"
POLICY = "mixed"  #: whose episodes they have learned from
#: settings that a model has in common with whoever dreams in it
SAME = ("game", "frames", "scale", "widths", "dense", "hidden")


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
    """

    folder: Path  #: the record's
    made: str | None  #: its `checksum`
    name: str  #: of the model there, such as ``l2``
    model: DynamicsModel  #: as it dreams
    same: tuple[Any, ...]  #: what `SAME` are in whoever dreams in it

    def __call__(self, runs: Runs) -> Any:
        """``params [runs, ...]``."""
        return jax.tree.map(lambda array: array[runs.seed % len(array)], self.check())

    def check(self) -> Any:
        """``params [models, ...]``, finite; `InputError` without any of the same game and sizes."""
        again = (
            f"train it by --part frames --keep --policies {POLICY} --arms {self.name} with the "
            f"same {', '.join(f'--{each}' for each in SAME)}"
        )

        def refused(why: str) -> InputError:
            return InputError(f"--models {self.folder}: {why}: {again}")

        config, curves = _read(self.folder, self.made)
        ours = dict(zip(SAME, fields.plain(self.same), strict=True))
        if differ := [each for each in SAME if config.get(each, ours[each]) != ours[each]]:
            raise refused(f"its models differ in --{' --'.join(differ)}")
        shapes: Any = jax.eval_shape(self.model.init, jax.random.key(0), AdversarialHParams())
        leaves, tree = jax.tree.flatten(shapes.params)
        held = curves.get(f"{self.name}@{POLICY}", {})
        arrays = [held.get(f"{KEPT}{number}", np.zeros(0)) for number in range(len(leaves))]
        if any(one.shape[1:] != leaf.shape for one, leaf in zip(arrays, leaves, strict=True)):
            raise refused(f"no model {self.name} is kept there")
        if not all(np.isfinite(one).all() for one in arrays):
            raise refused(f"a model {self.name} diverged")
        return jax.tree.unflatten(tree, arrays)


def given(options: Any, name: str, model: DynamicsModel | None) -> Given | None:
    """The model of that name where ``options.models`` names a record; None without."""
    if options.models is None or model is None:
        return None
    same = tuple(getattr(options, each) for each in SAME)
    return Given(options.models, options.models_made, name, model, same)


def checksum(folder: Path | None) -> str | None:
    """Of a record's curves, the weights among them; None where there are none."""
    path = folder and folder / "curves.npz"
    return sha256(path.read_bytes()).hexdigest()[:16] if path and path.is_file() else None


@cache
def _read(folder: Path, made: str | None) -> tuple[dict[str, Any], dict[str, Curves]]:
    """Settings and curves."""
    del made  # another one is another record
    try:
        results = storage.read_json(folder / "results.json") or {}
        return results.get("config", {}), storage.read_curves(folder / "curves.npz")
    except ValueError as error:
        raise InputError(f"--models {folder}: {error}") from None
