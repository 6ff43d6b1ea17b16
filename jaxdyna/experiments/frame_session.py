"""The host loop of an experiment on frame prediction: models trained in jitted pieces, each judged
at its stages, with progress, checkpoints and resume.
"""

from __future__ import annotations

import shlex
import shutil
import time
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from rich.console import Console

from jaxdyna.experiments import cli
from jaxdyna.experiments.checkpoint import Checkpoints
from jaxdyna.experiments.frame_record import PARTS, Record, Timing
from jaxdyna.experiments.frame_study import FrameExperiment, Run, Study
from jaxdyna.experiments.progress import Bars
from jaxdyna.experiments.run import deferred_interrupt
from jaxdyna.experiments.storage import set_aside, write_text
from jaxdyna.sweep import make_pieces

OF_THE_FIRST_SEED = ("seen", "truth", "belief", "film_truth", "film_dream")

PIECE_UPDATES = 250
CHECKPOINT_SECONDS = 60.0
NOTHING_SWEPT = np.float32(0)


def run(experiment: FrameExperiment, options: Any, arguments: Sequence[str]) -> int:
    """Runs what is not finished and reports; returns the exit code: 0, 2 on bad input, 130 after
    Ctrl-C.
    """
    prog, out = experiment.prog, options.out or experiment.out
    typed = [argument for argument in arguments if argument != "--resume"]
    command = f"{prog} {shlex.join(typed)}".strip()
    record = Record(experiment.name, options, out, command, experiment.describe)
    try:
        if options.resume:
            record.resume()
        cli.check_writable(out)
    except ValueError as error:
        cli.fail(str(error), prog)
    if not options.resume:
        set_aside(out)
    console = Console(highlight=False)
    code = 0
    try:
        record.write()
        _play(experiment, record, console)
        shutil.rmtree(out / "checkpoints", ignore_errors=True)
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        cli.fail("out of memory: lower --seeds or --episodes", prog)
    except KeyboardInterrupt:
        code = 130
        console.print(
            f"Interrupted. What is finished is in {out}; the same command with --resume goes on."
        )
    if record.curves:
        experiment.figures(out, record.curves, options)
        results = record.write()
        write_text(out / "report.md", experiment.markdown(results, options, record.curves, out))
        experiment.summary(console, results)
        console.print(f"Report: {out / 'report.md'}")
    return code


def _play(experiment: FrameExperiment, record: Record, console: Console) -> None:
    """Trains and judges whatever is not in the record yet."""
    options, curves = record.options, record.curves
    stages = {arm: options.stages_of(arm) for arm in dict.fromkeys(options.arms)}
    left = [arm for arm in stages if not all(f"{arm}@{stage}" in curves for stage in stages[arm])]
    totals: dict[str, int] = {
        arm: sum(experiment.updates_at(options, arm, stage) for stage in played)
        for arm, played in stages.items()
    }
    done = [arm for arm in stages if arm not in left]
    with (
        Bars(console, totals, finished=done, runs=options.seeds) as bars,
        deferred_interrupt() as interrupted,
    ):
        for arm in left:
            trainee = Trainee(experiment, record, arm, bars, interrupted)
            for stage in stages[arm]:
                trainee.play(stage)
            shutil.rmtree(trainee.checkpoints.directory, ignore_errors=True)


class Trainee:
    """All runs of an arm, at one stage after the other.

    Args:
        experiment: the experiment.
        record: where judgements go.
        arm: its name.
        bars: shows how far it is.
        interrupted: not empty after Ctrl-C.
    """

    def __init__(
        self,
        experiment: FrameExperiment,
        record: Record,
        arm: str,
        bars: Bars,
        interrupted: list[int],
    ):
        self.experiment, self.record, self.arm = experiment, record, arm
        self.bars, self.interrupted = bars, interrupted
        self.checkpoints = Checkpoints(record.out / "checkpoints" / arm)
        nothing: Timing = dict.fromkeys(PARTS, 0.0) | {"stages": {}}
        self.spent = record.timing.setdefault(arm, nothing)
        options = record.options
        study = experiment.make_study(options, arm)
        block = 1 if jax.default_backend() == "cpu" else None
        self._start, self._train = make_pieces(study.init, study.train, block)
        self._judge = make_pieces(study.init, study.judge, block)[1]
        self.keys = jax.random.split(jax.random.key(options.seed), options.seeds)
        self.data = self._collect(study)
        self.saved = time.perf_counter()

    def play(self, stage: Any) -> None:
        """Trains from scratch at a stage and judges, unless that is done.

        Raises:
            KeyboardInterrupt: after Ctrl-C, once the piece in progress is done and saved.
        """
        name = f"{self.arm}@{stage}"
        if name in self.record.curves:
            return
        before, whole = self._before(stage), self._updates_at(stage)
        number, note = self.experiment.number(stage), self.experiment.note(stage)
        self.bars.advance(self.arm, before, f"{note}, compiling")
        run, done = self._begin(stage)
        while done < whole:
            self.bars.advance(self.arm, before + done, note)
            began, updates = time.perf_counter(), min(PIECE_UPDATES, whole - done)
            run, losses = self._train(run, (number, updates, whole), NOTHING_SWEPT)
            jax.block_until_ready(losses)
            done += updates
            seconds, taken = self.spent["stages"], self._count("run_s", began)
            seconds[str(stage)] = seconds.get(str(stage), 0.0) + taken
            self._save(run, stage, done)
        began = time.perf_counter()
        self.bars.advance(self.arm, before + done, f"{note}, judging")
        _, judged = self._judge(run, number, NOTHING_SWEPT)
        kept = jax.tree.map(lambda leaf: np.asarray(leaf[0]), judged)
        kept |= {part: kept[part][0] for part in OF_THE_FIRST_SEED}
        self._count("judge_s", began)
        self.record.curves[name] = kept
        self.record.write()
        self.bars.advance(self.arm, before + done, "")

    def _collect(self, study: Study) -> Any:
        """What a host collects for all runs; None where they collect for themselves."""
        if study.data is None:
            return None
        began = time.perf_counter()
        data = study.data()
        self._count("collect_s", began)
        return data

    def _updates_at(self, stage: Any) -> int:
        return self.experiment.updates_at(self.record.options, self.arm, stage)

    def _before(self, stage: Any) -> int:
        """Updates in the stages before this one."""
        played = self.record.options.stages_of(self.arm)
        return sum(map(self._updates_at, played[: played.index(stage)]))

    def _begin(self, stage: Any) -> tuple[Run, int]:
        """The runs before this stage or at its checkpoint, and updates done; all is compiled."""
        began, number = time.perf_counter(), self.experiment.number(stage)
        run, done = self._start(jax.random.clone(self.keys), NOTHING_SWEPT), 0
        if self.data is not None:
            run = run._replace(data=jax.tree.map(jax.numpy.array, self.data))
        if self.record.options.resume and self.checkpoints.exists():
            kept, [counts], run_s = self.checkpoints.load(run._replace(data=None))
            if counts["stage"] == number:
                run, done = kept._replace(data=run.data), int(counts["done"])
                self.spent["run_s"] = run_s
                self.spent["stages"][str(stage)] = float(counts["seconds"])
        run, _ = self._train(run, (number, 0, 1), NOTHING_SWEPT)
        jax.block_until_ready(run.done)
        self._count("compile_s", began)
        return run, done

    def _save(self, run: Run, stage: Any, done: int) -> None:
        """Writes a checkpoint where one is due; data is not in it."""
        if not (self.interrupted or time.perf_counter() - self.saved > CHECKPOINT_SECONDS):
            return
        seconds = self.spent["stages"][str(stage)]
        counts = {"stage": self.experiment.number(stage), "done": done, "seconds": seconds}
        self.checkpoints.save(
            self._before(stage) + done,
            run._replace(data=None),
            {name: np.array(count) for name, count in counts.items()},
            self.spent["run_s"],
        )
        self.saved = time.perf_counter()
        if self.interrupted:
            self.record.write()
            raise KeyboardInterrupt

    def _count(self, part: str, began: float) -> float:
        """Adds the seconds since ``began`` to a part of the arm's time; returns them."""
        seconds = time.perf_counter() - began
        self.spent[part] = self.spent.get(part, 0.0) + seconds
        return seconds
