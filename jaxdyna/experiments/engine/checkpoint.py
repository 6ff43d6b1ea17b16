"""Checkpoints of blocks between two pieces: resumed from them, runs are bit for bit the same.

A file a block, written whole or not at all: arrays by the names of the state's leaves, with the
axis of runs in front, and nothing of devices in them. NumPy's format carries checksums.
"""

import json
import time
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxdyna.trees import is_key, named_leaves, raw

Curves = dict[str, np.ndarray]
CHECKPOINT_SECONDS = 20.0
CHECKPOINT_SHARE = 0.05
ABOUT = "about"


class InputError(ValueError):
    """What a user can mend, found in mid-run; what was played is saved."""


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
    """The newest checkpoint of a block, replaced only once the next is whole."""

    def __init__(self, path: Path):
        self.path, self.pause, self.saved = path, CHECKPOINT_SECONDS, time.perf_counter()

    def due(self) -> bool:
        """Whether one should be written now: writing takes a small share of the time."""
        return time.perf_counter() - self.saved > self.pause

    def save(self, kept: Kept, seconds: float) -> None:
        """Writes it."""
        began = time.perf_counter()
        arrays: Curves = {f"metrics/{name}": values for name, values in kept.metrics.items()}
        for row, curves in kept.over.items():
            arrays |= {f"over/{row}/{name}": values for name, values in curves.items()}
        arrays |= {f"state/{path}": leaf for path, leaf in named_leaves(kept.state).items()}
        about = {"done": kept.done, "over": list(kept.over), "seconds": seconds}
        self.path.parent.mkdir(parents=True, exist_ok=True)
        part = self.path.with_suffix(".part")
        with part.open("wb") as file:
            np.savez(file, **{ABOUT: np.array(json.dumps(about))}, **arrays)  # type: ignore[arg-type]
        part.replace(self.path)
        self.saved = time.perf_counter()
        self.pause = max(CHECKPOINT_SECONDS, (self.saved - began) / CHECKPOINT_SHARE)

    def load(self) -> Kept | None:
        """Reads it back; None where there is none.

        Raises:
            InputError: where it is not whole.
        """
        if not self.path.exists():
            return None
        about = _about(self.path)
        state, metrics = Curves(), Curves()
        over: dict[int, Curves] = {row: {} for row in about["over"]}
        with _opened(self.path) as file:
            for name in file.files:
                kind, _, rest = name.partition("/")
                if kind == "state":
                    state[rest] = file[name]
                elif kind == "metrics":
                    metrics[rest] = file[name]
                elif kind == "over":
                    row, _, rest = rest.partition("/")
                    over[int(row)][rest] = file[name]
        return Kept(about["done"], state, metrics, over)


class Store:
    """The checkpoints of one arm, in a folder of its own, made when needed."""

    def __init__(self, folder: Path):
        self.folder = folder

    def block(self, number: int) -> BlockStore:
        """Those of one block."""
        return BlockStore(self.folder / f"block{number}.npz")

    def seconds(self) -> float:
        """Seconds played up to the last checkpoint of any."""
        return max(
            (_about(path)["seconds"] for path in self.folder.glob("block*.npz")), default=0.0
        )


def _about(path: Path) -> dict[str, Any]:
    with _opened(path) as file:
        return json.loads(str(file[ABOUT]))


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    try:
        with path.open("rb") as content, np.load(content) as file:
            yield file
    except (OSError, EOFError, ValueError, zipfile.BadZipFile) as error:
        raise InputError(f"{path} is not whole ({error}): run without --resume") from None


def _sort(array: Any) -> str:
    return f"{array.dtype}{list(array.shape)}"
