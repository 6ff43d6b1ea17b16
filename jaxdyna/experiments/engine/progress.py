"""The bars in the terminal: an arm each, what runs and how long is left; lines elsewhere."""

import time
from collections.abc import Mapping

from rich.console import Console
from rich.progress import Progress, TextColumn

MINUTE = 60.0


class Bars(Progress):
    """A bar for each arm, in units of a run; where there is no terminal, a line at each new stage
    and each minute.

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
