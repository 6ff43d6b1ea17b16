"""Checkpoints of blocks between two pieces: resumed from them, runs are bit for bit the same.

A file a block, and the one before it: arrays by the names of the state's leaves, with the axis of
runs in front, and nothing of devices in them.
"""

import json
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxdyna.experiments.engine.storage import InputError, read_arrays, write_arrays
from jaxdyna.trees import is_key, named_leaves, raw

Curves = dict[str, np.ndarray]
CHECKPOINT_SECONDS = 20.0
CHECKPOINT_SHARE = 0.05
ABOUT = "about"


@dataclass
class Kept:
    """A block between two pieces.

    Attributes:
        done: units played.
        state: its runs', leaves ``[block, ...]``, or as read from a file, by name; None once all
            its runs are over.
        metrics: ``[block, done, ...]``.
        over: what runs came to that are over, by their row.
    """

    done: int
    state: Any
    metrics: Curves
    over: dict[int, Curves]

    def into(self, like: Any, place: Any) -> Any:
        """The state that was read, on a device.

        Raises:
            InputError: where it is not of the structure of ``like``, naming the first leaf that
                differs.
        """
        named, structure = jax.tree_util.tree_flatten_with_path(like)
        wanted = {jax.tree_util.keystr(path): example for path, example in named}
        for name in (*wanted, *self.state):
            now, then = (_sort(raw(tree[name])) if name in tree else "not there"
                         for tree in (wanted, self.state))  # fmt: skip
            if now != then:
                raise InputError(
                    f"the checkpoint is another version's: state{name} was {then} and is {now}; "
                    "run without --resume"
                )
        leaves = [
            jax.random.wrap_key_data(self.state[name], impl=jax.random.key_impl(example))
            if is_key(example)
            else self.state[name]
            for name, example in wanted.items()
        ]
        return jax.device_put(jax.tree.unflatten(structure, leaves), place)


class BlockStore:
    """The two newest checkpoints of a block: where the newest is damaged, the other serves.

    Args:
        path: of the newest.
        warn: is told of damage.
    """

    def __init__(self, path: Path, warn: Callable[[str], None] = print):
        self.path, self.before, self.warn = path, path.with_suffix(".before.npz"), warn
        self.whose = f"{path.parent.name}/{path.stem}"
        self.pause, self.saved = CHECKPOINT_SECONDS, time.perf_counter()

    def due(self) -> bool:
        """Whether one should be written now: writing takes a small share of the time."""
        return time.perf_counter() - self.saved > self.pause

    def save(self, kept: Kept, seconds: float) -> None:
        """Writes it.

        Raises:
            InputError: where it cannot be written; those before it stay.
        """
        began = time.perf_counter()
        arrays: Curves = {f"metrics/{name}": values for name, values in kept.metrics.items()}
        for row, curves in kept.over.items():
            arrays |= {f"over/{row}/{name}": values for name, values in curves.items()}
        arrays |= {f"state/{path}": leaf for path, leaf in named_leaves(kept.state).items()}
        about = {"done": kept.done, "over": [*kept.over], "seconds": seconds, "whose": self.whose}
        arrays[ABOUT] = np.array(json.dumps(about))
        with suppress(OSError):  # where it cannot be made, nor can the file
            self.path.parent.mkdir(exist_ok=True)
        write_arrays(self.path, arrays, before=self.before)
        self.saved = time.perf_counter()
        self.pause = max(CHECKPOINT_SECONDS, (self.saved - began) / CHECKPOINT_SHARE)

    def load(self) -> Kept | None:
        """The newest that is whole, read; None where there is none: the block begins anew."""
        for path in filter(Path.exists, (self.path, self.before)):
            try:
                return self._read(path)
            except ValueError as error:
                self.warn(f"{error}: going on from an earlier state")
        return None

    def seconds(self) -> float:
        """Seconds played up to the newest."""
        for path in filter(Path.exists, (self.path, self.before)):
            with suppress(ValueError):
                return json.loads(str(read_arrays(path, [ABOUT])[ABOUT]))["seconds"]
        return 0.0

    def _read(self, path: Path) -> Kept:
        arrays = read_arrays(path)
        about = json.loads(str(arrays.pop(ABOUT)))
        if about["whose"] != self.whose:
            raise ValueError(f"{path} is the checkpoint of {about['whose']}")
        kept = Kept(about["done"], {}, {}, {row: {} for row in about["over"]})
        for name, values in arrays.items():
            kind, _, rest = name.partition("/")
            if kind == "state":
                kept.state[rest] = values
            elif kind == "metrics":
                kept.metrics[rest] = values
            else:
                row, _, rest = rest.partition("/")
                kept.over[int(row)][rest] = values
        return kept


class Store:
    """The checkpoints of one arm, in a folder of its own.

    Args:
        folder: made if need be, but not the one above it: a run's folder that is gone stays gone.
        warn: is told of damage.
    """

    def __init__(self, folder: Path, warn: Callable[[str], None] = print):
        self.folder, self.warn = folder, warn

    def block(self, number: int) -> BlockStore:
        """Those of one block."""
        return BlockStore(self.folder / f"block{number}.npz", self.warn)

    def seconds(self) -> float:
        """Seconds played up to the last checkpoint of any."""
        names = {path.name.partition(".")[0] for path in self.folder.glob("block[0-9]*.npz")}
        blocks = (self.block(int(name.removeprefix("block"))) for name in names)
        return max((block.seconds() for block in blocks), default=0.0)


def _sort(array: Any) -> str:
    return f"{array.dtype}{list(array.shape)}"
