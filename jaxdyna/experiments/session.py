"""One run of an experiment from start to report, the same for every experiment."""

from __future__ import annotations

import json
import shlex
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import jax
import numpy as np
from rich.console import Console

from jaxdyna.experiments import cli
from jaxdyna.experiments.progress import Bars
from jaxdyna.experiments.ratios import compare
from jaxdyna.experiments.report import (
    Results,
    describe_arm,
    environment,
)
from jaxdyna.experiments.run import Arm, ArmRun, Runner
from jaxdyna.experiments.storage import (
    MANY_SEEDS,
    plain,
    read_curves,
    set_aside,
    slim,
    write_curves,
    write_json,
    write_text,
)
from jaxdyna.statistics import SolveRule

Curves = dict[str, np.ndarray]
JUDGING = 2**32 - 1
"""Folded into the base seed's key: the runs' own keys are its first splits."""
NOT_SETTINGS = ("arms", "out", "resume")


class Report(Protocol):
    """What differs from experiment to experiment in what is left behind."""

    def analyse(self, arm: Arm, run: ArmRun, key: jax.Array) -> Curves:
        """Further arrays to keep from a finished arm, such as judgements of its model."""

    def describe(self, curves: Curves) -> Results:
        """Further entries of an arm in ``results.json``."""

    def figures(self, out: Path, curves: Mapping[str, Curves], results: Results) -> None:
        """Draws the figures."""

    def markdown(self, results: Results) -> str:
        """The text of ``report.md``."""

    def summary(self, console: Console, results: Results) -> None:
        """The closing table in the terminal."""


@dataclass
class Session:
    """Plays the arms, keeps what is finished on disk, and reports.

    Attributes:
        experiment: its name.
        prog: the command as the user types it.
        argv: its arguments.
        options: a dataclass: the run's settings.
        out: the folder for the results.
        rule: when a run counts as solved.
        keys: random keys ``[seeds]``.
        report: the experiment's own part of the report.
        block: see `jaxdyna.experiments.run.Runner`.
        piece: see `jaxdyna.experiments.run.Runner`.
        prelude: a further entry of ``results.json`` by name, and what measures it before the arms
            are played.
        slim_above: runs of an arm above which less is kept of each, see `storage.slim`.
    """

    experiment: str
    prog: str
    argv: Sequence[str]
    options: Any
    out: Path
    rule: SolveRule
    keys: jax.Array
    report: Report
    block: int | None = None
    piece: int | None = None
    slim_above: int = MANY_SEEDS
    prelude: tuple[str, Callable[[], Any]] | None = None
    console: Console = field(default_factory=lambda: Console(highlight=False))

    def run(self, arms: Mapping[str, Arm]) -> int:
        """Runs the arms; returns the exit code: 0, 2 on bad input, 130 after Ctrl-C."""
        self._began, self._earlier_s, self._command = time.perf_counter(), 0.0, self._as_typed()
        self._timing: dict[str, dict[str, float]] = {}
        self._earlier: Results | None = None
        self._further: Results = {}
        self._prelude_s: dict[str, float] = {}
        curves: dict[str, Curves] = {}
        try:
            cli.check_writable(self.out)
            if self.options.resume:
                curves = self._resume()
        except ValueError as error:
            cli.fail(str(error), self.prog)
        if not self.options.resume:
            set_aside(self.out)
        (self.out / "checkpoints").mkdir(exist_ok=True)
        write_json(self.out / "checkpoints" / "settings.json", self._settings())
        code = 0
        try:
            self._measure_first()
            self._play(arms, curves)
            shutil.rmtree(self.out / "checkpoints", ignore_errors=True)
        except jax.errors.JaxRuntimeError as error:
            if "RESOURCE_EXHAUSTED" not in str(error):
                raise
            cli.fail("out of memory: lower --seeds or --episodes", self.prog)
        except KeyboardInterrupt:
            code = 130
            self.console.print(
                f"Interrupted. What is finished is in {self.out}; "
                "the same command with --resume goes on."
            )
        if curves:
            in_order = {name: curves[name] for name in (*arms, *curves) if name in curves}
            self._write(in_order, figures=True)
        return code

    def _measure_first(self) -> None:
        """The prelude, unless an earlier run has it."""
        if self.prelude is None:
            return
        (name, measure), path = self.prelude, self.out / "checkpoints" / "prelude.json"
        before = _read_json(path) if self.options.resume else None
        if before is None and self._earlier is not None and name in self._earlier:
            before = {name: self._earlier[name], "s": self._earlier["timing"]["prelude_s"]}
        if before is None:
            before = {name: measure(), "s": time.perf_counter() - self._began}
            write_json(path, before)
        elif self._earlier is None:
            self._earlier_s = before["s"]
        self._further, self._prelude_s = {name: before[name]}, {"prelude_s": before["s"]}

    def _play(self, arms: Mapping[str, Arm], curves: dict[str, Curves]) -> None:
        """Plays the arms that are not yet in ``curves`` and puts them there."""
        runner = Runner(
            self.keys,
            self.rule,
            self.options.stop_after_solved,
            self.out / "checkpoints",
            self.block,
            self.piece,
        )
        totals = {name: arm.config.num_episodes for name, arm in arms.items()}
        with Bars(self.console, totals, finished=curves, runs=len(self.keys)) as bars:
            for name, arm in arms.items():
                if name in curves:
                    continue
                runner.report = bars.reporter(name)
                done = runner.run(name, arm, resume=self.options.resume)
                bars.add_note(name, "judging")
                key = jax.random.fold_in(jax.random.key(self.options.seed), JUDGING)
                curves[name] = slim(
                    done.metrics | self.report.analyse(arm, done, key), self.slim_above
                )
                self._timing[name] = {"compile_s": done.compile_s, "run_s": done.run_s}
                del done  # its replays, before the next arm's are made
                self._write(curves, figures=False)
                bars.add_note(name)

    def _resume(self) -> dict[str, Curves]:
        """Arms that an earlier run with the same settings finished.

        Raises:
            ValueError: where there is no such run.
        """
        begun = _read_json(self.out / "checkpoints" / "settings.json")
        results = _read_json(self.out / "results.json")
        finished = results and _settings(results["config"])
        before, now = begun or finished, self._settings()
        if before is None:
            raise ValueError(f"nothing to resume in {self.out}: run once without --resume")
        newer = _settings(plain(type(self.options)()))  # a setting that did not exist then
        changed = sorted(name for name in now if now[name] != (newer | before)[name])
        if changed:
            flags = ", ".join(f"--{name.replace('_', '-')}" for name in changed)
            raise ValueError(
                f"the run in {self.out} had other settings for {flags}: "
                "resume with the same, or choose another --out"
            )
        if finished is None or newer | finished != now:
            return {}
        timing = results["timing"]
        self._earlier = results
        self._earlier_s = max(timing["total_s"], timing["compile_s"] + timing["run_s"])
        self._timing = timing["arms"]
        if results["command"] != self._command:
            self._command = f"{results['command']} && {self._command} --resume"
        return {
            name: slim(arm, self.slim_above)
            for name, arm in read_curves(self.out / "curves.npz").items()
        }

    def _as_typed(self) -> str:
        from_start = [argument for argument in self.argv if argument != "--resume"]
        return f"{self.prog} {shlex.join(from_start)}".strip()

    def _settings(self) -> Results:
        return _settings(plain(self.options))

    def _write(self, curves: Mapping[str, Curves], figures: bool) -> None:
        write_curves(self.out / "curves.npz", curves)
        results = self._results(curves)
        if figures:
            self.report.figures(self.out, curves, results)
        write_json(self.out / "results.json", results)
        if figures:
            write_text(self.out / "report.md", self.report.markdown(results))
            self.report.summary(self.console, results)
            self.console.print(f"Report: {self.out / 'report.md'}")

    def _results(self, curves: Mapping[str, Curves]) -> Results:
        arms = {
            name: describe_arm(values, self.rule) | self.report.describe(values)
            for name, values in curves.items()
        }
        total = {
            part: sum(timing[part] for timing in self._timing.values())
            for part in ("compile_s", "run_s")
        }
        total_s = self._earlier_s + time.perf_counter() - self._began
        return {
            "experiment": self.experiment,
            "command": self._command,
            "preset": self.options.preset,
            "config": plain(self.options) | {"arms": list(curves)},
            **environment(self._earlier),
            "timing": total | self._prelude_s | {"total_s": total_s, "arms": self._timing},
            **self._further,
            "arms": arms,
            "ratio_to_model_free": compare(arms, "model_free"),
        }


def _settings(config: Results) -> Results:
    return {name: value for name, value in config.items() if name not in NOT_SETTINGS}


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_text()) if path.exists() else None
    except json.JSONDecodeError as error:
        raise ValueError(f"{path} is not whole ({error}): run without --resume") from None
