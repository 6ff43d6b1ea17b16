"""The record of a frame prediction experiment while it grows: arrays, JSON, resume."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from jaxdyna.experiments import report
from jaxdyna.experiments.report import Results
from jaxdyna.experiments.storage import plain, read_curves, write_curves, write_json

PARTS = ("collect_s", "compile_s", "run_s", "judge_s")
NOT_SETTINGS = ("arms", "out", "resume")
Curves = dict[str, dict[str, np.ndarray]]
Timing = dict[str, Any]


@dataclass
class Record:
    """What a run has come to so far, and its files.

    Attributes:
        experiment: its name.
        options: a dataclass: its settings.
        out: the folder.
        command: as typed.
        describe: ``(curves, options) -> arms``, the entries of ``results.json``.
        curves: judgements by ``ARM@STAGE``.
        timing: seconds by arm.
        earlier: what an earlier run left in ``results.json``.
    """

    experiment: str
    options: Any
    out: Path
    command: str
    describe: Callable[[Any, Any], Results]
    curves: Curves = field(default_factory=dict)
    timing: Timing = field(default_factory=dict)
    earlier: Results | None = None
    begun: float = field(default_factory=time.perf_counter)

    def write(self) -> Results:
        """Writes ``curves.npz`` and ``results.json``; returns what is in the latter."""
        write_curves(self.out / "curves.npz", self.curves)
        spent = self.timing.values()
        total = {part: sum(arm.get(part, 0.0) for arm in spent) for part in PARTS}
        total["total_s"] = time.perf_counter() - self.begun
        results = {
            "experiment": self.experiment,
            "command": self.command,
            "preset": self.options.preset,
            "config": plain(self.options),
            **report.environment(self.earlier),
            "timing": total | {"arms": self.timing},
            "arms": self.describe(self.curves, self.options),
        }
        write_json(self.out / "results.json", results)
        return results

    def resume(self) -> None:
        """Reads what an earlier run with the same settings finished.

        Raises:
            ValueError: where there is no such run.
        """
        path = self.out / "results.json"
        if not path.exists():
            raise ValueError(f"nothing to resume in {self.out}: run once without --resume")
        before = json.loads(path.read_text())
        now = json.loads(json.dumps(plain(self.options)))
        newer = json.loads(
            json.dumps(plain(type(self.options)()))
        )  # settings that did not exist then
        earlier = newer | before["config"]
        changed = [
            name
            for name, value in now.items()
            if name not in NOT_SETTINGS and earlier[name] != value
        ]
        if changed:
            flags = ", ".join(f"--{name.replace('_', '-')}" for name in changed)
            raise ValueError(
                f"the run in {self.out} had other settings for {flags}: "
                "resume with the same, or choose another --out"
            )
        self.curves = read_curves(self.out / "curves.npz")
        self.timing, self.earlier = before["timing"]["arms"], before
        again = f"{self.command} --resume"
        more = before["command"] != self.command
        self.command = f"{before['command']} && {again}" if more else self.command
        self.begun -= before["timing"]["total_s"]
