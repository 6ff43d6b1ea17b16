"""Checkpoints of runs between two pieces: resumed from them, they are bit for bit the same.

A file a run, and the one before it: arrays by the names of the state's leaves, and nothing in them
of devices or of who was computed beside it. So it does not matter when others' were written.
"""

import json
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxdyna.experiments.engine.storage import InputError, read_arrays, write_arrays
from jaxdyna.trees import named, stack, unlike, unnamed

Curves = dict[str, np.ndarray]
CHECKPOINT_SECONDS = 20.0
CHECKPOINT_SHARE = 0.05
ABOUT = "about"


@dataclass
class Kept:
    """A run between two pieces."""

    done: int = 0  #: units played
    #: its leaves by name; none before its first unit, and once it is over
    state: Curves = field(default_factory=dict)
    #: ``[done, ...]``; once it is over, what it came to
    metrics: Curves = field(default_factory=dict)
    over: bool = False  #: whether it is


def stacked(states: Sequence[Curves], like: Any, place: Any) -> Any:
    """Runs' states, as they are kept, as one state on a device. `InputError` where it is not of the
    structure of ``like``, naming the first leaf that differs.
    """
    kept = stack(states)
    if said := unlike(kept, named(like)):
        raise InputError(f"the checkpoint is another version's: state{said}; run without --resume")
    return jax.device_put(unnamed(kept, like), place)


class Store:
    """The two newest checkpoints of each run of an arm: if the newest is damaged, the other serves.

    Args:
        folder: of their own, made if need be, but not the one above it: a run's folder that is gone
            stays gone.
        warn: is told of damage.
    """

    def __init__(self, folder: Path, warn: Callable[[str], None] = print):
        self.folder, self.warn = folder, warn
        self.began, self.writing = time.perf_counter(), 0.0
        self.newest: dict[int, tuple[int, bool]] = {}

    def due(self, saved: float) -> bool:
        """Whether to save again what was saved then: writing takes a small share of the time."""
        now = time.perf_counter()
        affords = self.writing <= CHECKPOINT_SHARE * (now - self.began)
        return affords and now - saved > CHECKPOINT_SECONDS

    def save(self, number: int, run: Kept, seconds: float) -> None:
        """Writes a run's, unless it is there; ``seconds`` were played by all. `InputError` where it
        cannot be written; those before it stay.
        """
        if self.newest.get(number) == (run.done, run.over):
            return
        began, (path, before) = time.perf_counter(), self._paths(number)
        arrays = {f"metrics/{name}": values for name, values in run.metrics.items()}
        arrays |= {f"state/{name}": values for name, values in run.state.items()}
        about = {"done": run.done, "over": run.over, "seconds": seconds, "whose": self._whose(path)}
        arrays[ABOUT] = np.array(json.dumps(about))
        with suppress(OSError):  # where it cannot be made, nor can the file
            self.folder.mkdir(exist_ok=True)
        write_arrays(path, arrays, before=before)
        self.newest[number] = run.done, run.over
        self.writing += time.perf_counter() - began

    def load(self, number: int) -> Kept | None:
        """A run's newest that is whole; None where there is none: it begins anew."""
        for path in filter(Path.exists, self._paths(number)):
            try:
                run = self._read(path)
                self.newest[number] = run.done, run.over
                return run
            except ValueError as error:
                self.warn(f"{error}: going on from an earlier state")
        return None

    def seconds(self, numbers: Sequence[int] | None = None) -> float:
        """Seconds played up to the last checkpoint of any of them, or of those of these numbers."""
        found, paths = [0.0], self.folder.glob("run[0-9]*.npz")
        if numbers is not None:
            paths = (self._paths(number)[0] for number in numbers)
        for path in paths:
            with suppress(ValueError):
                found.append(json.loads(str(read_arrays(path, [ABOUT])[ABOUT]))["seconds"])
        return max(found)

    def gathered(self, count: int) -> list[Curves]:
        """What so many runs came to, whoever played them; `InputError` where one's is missing."""
        kept = map(self.load, range(count))
        curves = [run.metrics for run in kept if run and run.over]
        if len(curves) < count:
            raise InputError(
                f"{count - len(curves)} runs are damaged or not in {self.folder}: see that all "
                "hosts share it; the same command with --resume plays them"
            )
        return curves

    def _paths(self, number: int) -> tuple[Path, Path]:
        return self.folder / f"run{number}.npz", self.folder / f"run{number}.before.npz"

    def _whose(self, path: Path) -> str:
        return f"{self.folder.name}/{path.name.partition('.')[0]}"

    def _read(self, path: Path) -> Kept:
        arrays = read_arrays(path)
        about = json.loads(str(arrays.pop(ABOUT)))
        if about["whose"] != self._whose(path):
            raise ValueError(f"{path} is the checkpoint of {about['whose']}")
        kept = Kept(about["done"], over=about["over"])
        for name, values in arrays.items():
            kind, _, rest = name.partition("/")
            getattr(kept, kind)[rest] = values
        return kept


def checkpoints_below(folder: Path) -> list[Path]:
    """Those of all arms, also of earlier versions, which wrote them by block."""
    return [path for of in ("run", "block") for path in folder.glob(f"*/{of}[0-9]*.npz")]
