"""Checkpoints of a run between two pieces: resumed from one, a run is bit for bit the same."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp

logging.getLogger("absl").setLevel(logging.ERROR)  # orbax reports every file it touches

Metrics = dict[str, np.ndarray]


class Checkpoints:
    """The newest checkpoint of one arm, replaced only once the next is whole.

    Args:
        directory: a folder of its own, made when needed.
    """

    def __init__(self, directory: Path):
        self.directory = directory.absolute()

    def exists(self) -> bool:
        """Whether there is one."""
        return self.directory.is_dir() and self._manager().latest_step() is not None

    def save(self, step: int, state: Any, metrics: Metrics, run_s: float) -> None:
        """Writes the whole state: parameters, optimisers, replay and random keys; no trace is kept
        of the devices it lay on.
        """
        with self._manager() as manager:
            leaves = [
                np.asarray(jax.random.key_data(leaf) if _is_key(leaf) else leaf)
                for leaf in jax.tree.leaves(state)
            ]
            numbered = {f"{number:04}": leaf for number, leaf in enumerate(leaves)}
            items = {"state": numbered, "metrics": metrics, "run_s": np.float64(run_s)}
            manager.save(step, args=ocp.args.StandardSave(items), force=True)
            manager.wait_until_finished()

    def load(self, like: Any) -> tuple[Any, list[Metrics], float]:
        """Reads it back.

        Args:
            like: a state of the same structure and shapes, on the devices it is wanted on.

        Returns:
            The state, the metrics so far as a list of one piece, and the seconds run so far.
        """
        with self._manager() as manager:
            items = manager.restore(manager.latest_step(), args=ocp.args.StandardRestore())
        saved = [leaf for _, leaf in sorted(items["state"].items())]
        examples, structure = jax.tree.flatten(like)
        leaves = [
            jax.device_put(
                jax.random.wrap_key_data(leaf) if _is_key(example) else leaf, example.sharding
            )
            for leaf, example in zip(saved, examples, strict=True)
        ]
        metrics = {name: np.asarray(values) for name, values in items["metrics"].items()}
        return jax.tree.unflatten(structure, leaves), [metrics], float(items["run_s"])

    def _manager(self) -> ocp.CheckpointManager:
        options = ocp.CheckpointManagerOptions(max_to_keep=1, create=True)
        return ocp.CheckpointManager(self.directory, options=options)


def _is_key(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array) and jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)
