"""The bars in the terminal: an arm each, what runs and how long is left."""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)


class Bars:
    """A bar for each arm.

    Args:
        console: where they are drawn.
        totals: real episodes of each arm at the most.
        finished: arms that an earlier run has played.
        runs: seeds of an arm.
    """

    def __init__(
        self, console: Console, totals: Mapping[str, int], finished: Container[str], runs: int
    ):
        columns = (
            TextColumn("{task.description}"), BarColumn(bar_width=20), MofNCompleteColumn(),
            TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn(),
            TextColumn("{task.fields[note]}"),
        )  # fmt: skip
        self._progress = Progress(*columns, console=console, speed_estimate_period=120)
        self._runs = runs
        self._bars = {}
        self._notes = dict.fromkeys(totals, "waiting")
        for name, total in totals.items():
            bar = self._progress.add_task(name, total=total, note="waiting", start=False)
            if name in finished:
                self._progress.update(bar, completed=total, note="finished before")
            self._bars[name] = bar

    def __enter__(self) -> Bars:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def reporter(self, name: str) -> Callable[[str, int, int, int], None]:
        """What `jaxdyna.experiments.run.Runner` reports the arm's progress to."""
        bar = self._bars[name]

        def report(stage: str, done: int, total: int, solved: int) -> None:
            if stage == "running" and not self._progress.tasks[bar].started:
                self._progress.start_task(bar)
            compiling = stage == "compiling"
            self._notes[name] = "compiling" if compiling else f"{solved}/{self._runs} solved"
            self._progress.update(bar, completed=done, note=self._notes[name])
            if stage == "done":
                self._progress.update(bar, total=done)
                self._progress.stop_task(bar)

        return report

    def advance(self, name: str, done: int, note: str) -> None:
        """Sets how much of the arm is done and what runs now; its clock starts with the first."""
        bar = self._bars[name]
        if not self._progress.tasks[bar].started:
            self._progress.start_task(bar)
        self._progress.update(bar, completed=done, note=note)
        if done == self._progress.tasks[bar].total:
            self._progress.stop_task(bar)

    def add_note(self, name: str, note: str = "") -> None:
        """Says what else is going on with the arm; nothing by default."""
        said = f"{self._notes[name]}, {note}" if note else self._notes[name]
        self._progress.update(self._bars[name], note=said)
