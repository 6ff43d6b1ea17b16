"""The Maze: learning its dynamics from pixels (§3.2, §4.2, Figs. 4 and 7).

``python -m jaxdyna.experiments.maze --part model`` trains frame models on episodes of a random
policy and writes the paper's F1 table beside ours.
"""

from __future__ import annotations

import json
import shlex
import shutil
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console

from jaxdyna.experiments import cli, maze_report, report
from jaxdyna.experiments.checkpoint import Checkpoints
from jaxdyna.experiments.maze_model import make_study
from jaxdyna.experiments.maze_options import PRESETS, QUICK, Options, training_of
from jaxdyna.experiments.progress import Bars
from jaxdyna.experiments.report import Results
from jaxdyna.experiments.run import deferred_interrupt
from jaxdyna.experiments.storage import (
    plain,
    read_curves,
    set_aside,
    write_curves,
    write_json,
    write_text,
)
from jaxdyna.sweep import make_pieces

PROG = "python -m jaxdyna.experiments.maze"
NOT_SETTINGS = ("arms", "out", "resume")
OF_THE_FIRST_SEED = ("seen", "truth", "belief", "film_truth", "film_dream")
Curves = dict[str, dict[str, np.ndarray]]
Timing = dict[str, Any]

PIECE_UPDATES = 250
CHECKPOINT_SECONDS = 60.0
NOTHING_SWEPT = np.float32(0)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the experiment from the command line; returns the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    options = cli.parse(QUICK if "--quick" in arguments else PRESETS, arguments, PROG)
    out = options.out or Path("runs") / "maze-model"
    typed = [argument for argument in arguments if argument != "--resume"]
    record = Record(options, out, f"{PROG} {shlex.join(typed)}".strip())
    try:
        if options.resume:
            record.resume()
        cli.check_writable(out)
    except ValueError as error:
        cli.fail(str(error), PROG)
    if not options.resume:
        set_aside(out)
    console = Console(highlight=False)
    code = 0
    try:
        record.write()
        _play(record, console)
        shutil.rmtree(out / "checkpoints", ignore_errors=True)
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        cli.fail("out of memory: lower --seeds or --episodes", PROG)
    except KeyboardInterrupt:
        code = 130
        console.print(
            f"Interrupted. What is finished is in {out}; the same command with --resume goes on."
        )
    if record.curves:
        maze_report.figures(out, record.curves, options)
        results = record.write()
        write_text(out / "report.md", maze_report.markdown(results, options, record.curves, out))
        maze_report.summary(console, results)
        console.print(f"Report: {out / 'report.md'}")
    return code


@dataclass
class Record:
    """What a run has come to so far, and its files.

    Attributes:
        options: its settings.
        out: the folder.
        command: as typed.
        curves: judgements by ``ARM@STAGE``.
        timing: seconds by arm.
    """

    options: Options
    out: Path
    command: str
    curves: Curves = field(default_factory=dict)
    timing: Timing = field(default_factory=dict)
    begun: float = field(default_factory=time.perf_counter)

    def write(self) -> Results:
        """Writes ``curves.npz`` and ``results.json``; returns what is in the latter."""
        write_curves(self.out / "curves.npz", self.curves)
        spent = self.timing.values()
        total = {part: sum(arm[part] for arm in spent) for part in ("compile_s", "run_s")}
        total["total_s"] = time.perf_counter() - self.begun
        results = {
            "experiment": "maze_model",
            "command": self.command,
            "preset": self.options.preset,
            "config": plain(self.options),
            **report.environment(),
            "timing": total | {"arms": self.timing},
            "arms": maze_report.describe(self.curves, self.options),
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
        newer = json.loads(json.dumps(plain(Options())))  # settings that did not exist then
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
        self.timing = before["timing"]["arms"]
        self.command = before["command"]
        self.begun -= before["timing"]["total_s"]


def _play(record: Record, console: Console) -> None:
    """Trains and judges whatever is not in the record yet."""
    options, curves = record.options, record.curves
    stages = {arm: options.stages_of(arm) for arm in dict.fromkeys(options.arms)}
    left = [arm for arm in stages if not all(f"{arm}@{stage}" in curves for stage in stages[arm])]
    totals: dict[str, int] = {
        arm: len(played) * training_of(options, arm).updates for arm, played in stages.items()
    }
    done = [arm for arm in stages if arm not in left]
    with (
        Bars(console, totals, finished=done, runs=options.seeds) as bars,
        deferred_interrupt() as interrupted,
    ):
        for arm in left:
            trainee = Trainee(record, arm, bars, interrupted)
            for stage in stages[arm]:
                trainee.play(stage)
            shutil.rmtree(trainee.checkpoints.directory, ignore_errors=True)


class Trainee:
    """All runs of an arm, from stage to stage.

    Args:
        record: where judgements go.
        arm: its name.
        bars: shows how far it is.
        interrupted: not empty after Ctrl-C.
    """

    def __init__(self, record: Record, arm: str, bars: Bars, interrupted: list[int]):
        self.record, self.arm, self.bars, self.interrupted = record, arm, bars, interrupted
        self.updates = training_of(record.options, arm).updates
        self.checkpoints = Checkpoints(record.out / "checkpoints" / arm)
        nothing: Timing = {"compile_s": 0.0, "run_s": 0.0, "stages": {}}
        self.spent = record.timing.setdefault(arm, nothing)
        bars.advance(arm, 0, "compiling")
        began = time.perf_counter()
        options = record.options
        study, block = make_study(options, arm), 1 if jax.default_backend() == "cpu" else None
        start, self._train = make_pieces(study.init, study.train, block)
        self._judge = make_pieces(study.init, study.judge, block)[1]
        keys = jax.random.split(jax.random.key(options.seed), options.seeds)
        self.run, self.done, self.saved = start(keys, NOTHING_SWEPT), 0, began
        if options.resume and self.checkpoints.exists():
            kept, [counts], _ = self.checkpoints.load(self.run._replace(data=None))
            self.run, self.done = kept._replace(data=self.run.data), int(counts["done"])
        self._count("compile_s", began)

    def play(self, stage: int) -> None:
        """Trains up to the end of this stage and judges, unless that is done.

        Raises:
            KeyboardInterrupt: after Ctrl-C, once the piece in progress is done and saved.
        """
        name, stages = f"{self.arm}@{stage}", self.record.options.stages_of(self.arm)
        end = (1 + stages.index(stage)) * self.updates
        seconds = self.spent["stages"]
        while self.done < end:
            began = time.perf_counter()
            self.bars.advance(self.arm, self.done, f"{stage} episodes")
            updates = min(PIECE_UPDATES, end - self.done)
            self.run, losses = self._train(self.run, (stage, updates), NOTHING_SWEPT)
            jax.block_until_ready(losses)
            self.done += updates
            seconds[str(stage)] = seconds.get(str(stage), 0.0) + self._count("run_s", began)
            self._save(due=self.done == end)
        if name not in self.record.curves:
            began = time.perf_counter()
            self.bars.advance(self.arm, self.done, f"{stage} episodes, judging")
            self.run, judged = self._judge(self.run, stage, NOTHING_SWEPT)
            kept = jax.tree.map(lambda leaf: np.asarray(leaf[0]), judged)
            kept |= {part: kept[part][0] for part in OF_THE_FIRST_SEED}
            self._count("run_s", began)
            self.record.curves[name] = kept
            self.record.write()
        self.bars.advance(self.arm, self.done, "")

    def _save(self, due: bool) -> None:
        """Writes a checkpoint where one is due; data is not in it."""
        if not (due or self.interrupted or time.perf_counter() - self.saved > CHECKPOINT_SECONDS):
            return
        counts = {"done": np.array(self.done)}
        self.checkpoints.save(self.done, self.run._replace(data=None), counts, self.spent["run_s"])
        self.saved = time.perf_counter()
        if self.interrupted:
            self.record.write()
            raise KeyboardInterrupt

    def _count(self, part: str, began: float) -> float:
        """Adds the seconds since ``began`` to a part of the arm's time; returns them."""
        seconds = time.perf_counter() - began
        self.spent[part] += seconds
        return seconds


if __name__ == "__main__":
    sys.exit(main())
