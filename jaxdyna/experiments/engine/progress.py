"""How runs get on: bars in the terminal, a log in their folder, and whoever else is told.

A line of the log is JSON: ``arm``, ``seed``, ``step`` (units played), ``time`` (seconds since 1970)
and the mean of each metric over a piece. It is written before any checkpoint behind it, so that
none is lost, and pieces end at the same units whatever happens: what is played again finds its
lines there.
"""

from __future__ import annotations

import fcntl
import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import quote

from rich.console import Console
from rich.progress import Progress, TextColumn

from jaxdyna import fields
from jaxdyna.experiments.engine.storage import unwritten, written
from jaxdyna.experiments.engine.work import Logger, Progress as Say, Runs

MINUTE = 60.0
LOG, BOARD = "log.jsonl", "tensorboard"
LEFT = LOG, BOARD, "wandb"  #: in the folder of a run
TRACKED = 10  #: runs of each arm, the first ones, of which others are told


class Bars(Progress):
    """A bar for each arm, in units of a run; without a terminal a line each new stage and minute.

    Args:
        console: where they are drawn.
        totals: units of each at the most, and its runs.
    """

    def __init__(self, console: Console, totals: Mapping[str, tuple[int, int]]):
        columns = *self.get_default_columns(), TextColumn("{task.fields[note]}")
        super().__init__(*columns, console=console, speed_estimate_period=120)
        self._runs = {name: runs for name, (_, runs) in totals.items()}
        self._said: dict[str, tuple[str, float]] = {}
        self._bars = {
            name: self.add_task(name, total=units, note="waiting", start=False)
            for name, (units, _) in totals.items()
        }

    def tell(self, name: str, stage: str, done: int, over: int) -> None:
        """How far an arm is; its clock starts with the first unit."""
        bar = self._bars[name]
        if stage == "running" and not self.tasks[bar].started:
            self.start_task(bar)
        total = self.tasks[bar].total or 0
        note = f"{done} of {total:.0f}, {over}/{self._runs[name]} runs over"
        note = note if stage == "running" else stage
        self.update(bar, completed=done, note=note)
        before, at = self._said.get(name, ("", 0.0))
        if not self.console.is_terminal and (stage != before or time.monotonic() > at + MINUTE):
            self._said[name] = stage, time.monotonic()
            self.console.print(f"{name}: {note}")
        if stage == "done":
            self.update(bar, total=max(done, 1))
            self.stop_task(bar)


@contextmanager
def shown(runs: Runs, name: str = "runs") -> Iterator[Say]:
    """What to ``say`` while runs are played from Python, see `Engine.play`: draws one bar."""
    units, count = int(runs.units.max()), len(runs.seed)
    with Bars(Console(highlight=False), {name: (units, count)}) as bars:
        yield partial(bars.tell, name)
        bars.tell(name, "done", units, count)


@dataclass
class Log:
    """A run's lines in the log of its folder."""

    path: Path  #: of the log
    arm: str  #: the run's name in ``results["arms"]``
    seed: int  #: its number
    options: Any = None  #: its settings, resolved
    trackers: Sequence[Tracker] = ()  #: who else is told
    since: int = 0  #: the unit up to which there are lines
    told: Sequence[Any] = ()  #: what the trackers have made

    def log(self, step: int, scalars: Mapping[str, float]) -> None:
        """Adds a line, unless it is there; `InputError` where it cannot be written."""
        if step <= self.since:
            return
        if self.seed < TRACKED and not self.told:
            self.told = [tracker(self) for tracker in self.trackers]
        for other in self.told:
            other.log(step, scalars)
        who = {"arm": self.arm, "seed": self.seed, "step": step, "time": round(time.time(), 1)}
        short = {name: float(f"{value:.6g}") for name, value in scalars.items()}
        try:
            with self.path.open("a", encoding="utf-8") as file:
                fcntl.flock(file, fcntl.LOCK_EX)  # other processes of the run add to it, too
                file.write(json.dumps(who | short) + "\n")
        except OSError as error:
            raise unwritten(self.path, error) from None

    def close(self) -> None:
        """Tells those who were told that it was all."""
        for other in self.told:
            getattr(other, "close", lambda: None)()


#: makes, at a run's first line, who is told of it; its ``close``, if it has one, is called at last
Tracker = Callable[[Log], Logger]


def tensorboard() -> Tracker:
    """A folder of events a run; what an earlier process told beyond the log is purged."""
    from tensorboardX import SummaryWriter  # noqa: PLC0415

    def of(run: Log) -> Any:
        folder = run.path.parent / BOARD / quote(run.arm, safe=" ,=@+()") / str(run.seed)
        writer = SummaryWriter(str(folder), purge_step=run.since + 1 if folder.exists() else None)

        def log(step: int, scalars: Mapping[str, float]) -> None:
            for name, value in scalars.items():
                writer.add_scalar(name, value, step)
            writer.flush()

        return SimpleNamespace(log=log, close=writer.close)

    return of


def wandb() -> Tracker:
    """A run of Weights & Biases a run, another one after a resume, in its arm's group; `ValueError`
    where it knows no account and is not offline.
    """
    from wandb import Error, Settings, init, login  # noqa: PLC0415

    try:
        login()  # which asks, or refuses, before anything is played
    except Error as error:
        raise ValueError(f"--log wandb: {error} WANDB_MODE=offline needs no account") from None

    def of(run: Log) -> Any:
        its = init(
            project="jaxdyna", dir=run.path.parent, group=run.arm, name=f"{run.arm} {run.seed}",
            config=fields.plain(run.options), reinit="create_new",
            settings=Settings(silent=True, console="off"))  # fmt: skip
        log = lambda step, scalars: its.log(dict(scalars), step=step)  # noqa: E731
        return SimpleNamespace(log=log, close=its.finish)

    return of


TRACKERS = {"tensorboard": tensorboard, "wandb": wandb}  #: what ``--log`` names
EXTRAS = {"tensorboard": "logging", "wandb": "wandb"}  #: which install their packages


def trackers(names: Sequence[str]) -> list[Tracker]:
    """Those of these names; `ValueError` where there is none, `ImportError` without its package."""
    made = {}
    for name in names:
        if name not in TRACKERS:
            raise ValueError(f"--log {name}: there are {', '.join(TRACKERS)}")
        try:
            made[name] = TRACKERS[name]()
        except ImportError as error:
            how = f"pip install 'jaxdyna[{EXTRAS[name]}]'"
            raise ImportError(f"--log {name} needs {error.name}: {how}") from error
    return [*made.values()]


def gather(folders: Sequence[Path], out: Path) -> None:
    """Makes one log of these folders'; a line that was torn is dropped: it is played again."""
    with written(out / LOG) as part, part.open("w", encoding="utf-8") as file:
        file.writelines(line for _, _, line in _lines(folders))


def logged(folder: Path) -> dict[tuple[str, int], int]:
    """The last step of each run, by arm and seed."""
    return {run: step for run, step, _ in _lines([folder])}


def _lines(folders: Sequence[Path]) -> Iterator[tuple[tuple[str, int], int, str]]:
    """Every whole line once, with its run and its step."""
    last: dict[tuple[str, int], int] = {}
    for path in (folder / LOG for folder in folders if (folder / LOG).exists()):
        with path.open(encoding="utf-8", errors="replace") as file:
            for line in file:
                with suppress(ValueError, KeyError, TypeError):
                    said = json.loads(line)
                    run, step = (said["arm"], said["seed"]), said["step"]
                    if line.endswith("\n") and step > last.get(run, 0):
                        last[run] = step
                        yield run, step, line
