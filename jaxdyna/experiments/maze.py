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
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from jaxdyna.experiments import cli, maze_report, report
from jaxdyna.experiments.checkpoint import Checkpoints
from jaxdyna.experiments.maze_model import make_study
from jaxdyna.experiments.maze_options import PRESETS, QUICK, Options
from jaxdyna.experiments.progress import Bars
from jaxdyna.experiments.report import Results
from jaxdyna.experiments.run import deferred_interrupt
from jaxdyna.experiments.storage import (
    plain,
    read_curves,
    write_curves,
    write_json,
    write_text,
)
from jaxdyna.sweep import make_pieces

PROG = "python -m jaxdyna.experiments.maze"
NOT_SETTINGS = ("arms", "out", "resume")
OF_THE_FIRST_SEED = ("seen", "truth", "belief", "film_truth", "film_dream")
Curves = dict[str, dict[str, np.ndarray]]
Timing = dict[str, dict[str, float]]


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the experiment from the command line; returns the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    presets = PRESETS
    if "--quick" in arguments:
        presets = {name: replace(preset, **QUICK) for name, preset in PRESETS.items()}
    options = cli.parse(presets, arguments, PROG)
    out = options.out or Path("runs") / "maze-model"
    try:
        cli.check_writable(out)
        curves, timing, earlier_s = _resume(options, out) if options.resume else ({}, {}, 0.0)
    except ValueError as error:
        cli.fail(str(error), PROG)
    if not options.resume:
        shutil.rmtree(out / "checkpoints", ignore_errors=True)
    typed = [argument for argument in arguments if argument != "--resume"]
    begun = time.perf_counter() - earlier_s

    def results() -> Results:
        return _results(options, f"{PROG} {shlex.join(typed)}".strip(), curves, timing, begun)

    console = Console(highlight=False)
    code = 0
    try:
        for name, judged in _play(options, out, console, curves, timing):
            curves[name] = judged
            write_curves(out / "curves.npz", curves)
            write_json(out / "results.json", results())
        shutil.rmtree(out / "checkpoints", ignore_errors=True)
    except KeyboardInterrupt:
        code = 130
        console.print(
            f"Interrupted. What is finished is in {out}; the same command with --resume goes on."
        )
    if curves:
        maze_report.figures(out, curves, options)
        final = results()
        write_json(out / "results.json", final)
        write_text(out / "report.md", maze_report.markdown(final, options))
        maze_report.summary(console, final)
        console.print(f"Report: {out / 'report.md'}")
    return code


def _play(options: Options, out: Path, console: Console, curves: Curves, timing: Timing) -> Any:
    """Yields ``ARM@STAGE`` and its judgements ``[seeds, ...]`` for all that is not there yet."""
    stages = {arm: options.stages_of(arm) for arm in dict.fromkeys(options.arms)}
    missing = {
        arm: [stage for stage in played if f"{arm}@{stage}" not in curves]
        for arm, played in stages.items()
    }
    totals: dict[str, int] = {arm: len(played) for arm, played in stages.items()}
    done = [arm for arm in stages if not missing[arm]]
    with (
        Bars(console, totals, finished=done, runs=options.seeds) as bars,
        deferred_interrupt() as interrupted,
    ):
        for arm in (arm for arm in stages if missing[arm]):
            spent = timing.setdefault(arm, {"compile_s": 0.0, "run_s": 0.0})
            bars.advance(arm, totals[arm] - len(missing[arm]), "compiling")
            checkpoints = Checkpoints(out / "checkpoints" / arm)
            began = time.perf_counter()
            state, proceed = _compile(options, arm)
            finished = totals[arm] - len(missing[arm])
            if finished and checkpoints.exists():
                state, [saved], _ = checkpoints.load(state)
                finished = 1 + stages[arm].index(saved["stage"])
            else:
                finished = 0
            missing[arm] = list(stages[arm][finished:])
            spent["compile_s"] += time.perf_counter() - began
            for stage in missing[arm]:
                bars.advance(arm, stages[arm].index(stage), f"{stage} episodes")
                began = time.perf_counter()
                state, judged = proceed(state, stage, jnp.float32(0))
                judged = jax.tree.map(lambda leaf: np.asarray(leaf[0]), judged)
                spent["run_s"] += time.perf_counter() - began
                for name in OF_THE_FIRST_SEED:
                    judged[name] = judged[name][0]
                yield f"{arm}@{stage}", judged
                if stage != stages[arm][-1]:
                    checkpoints.save(stage, state, {"stage": np.array(stage)}, spent["run_s"])
                if interrupted:
                    raise KeyboardInterrupt
            shutil.rmtree(checkpoints.directory, ignore_errors=True)
            bars.advance(arm, totals[arm], "")


def _compile(options: Options, arm: str) -> tuple[Any, Any]:
    """The runs before their first stage, and what plays a stage of them."""
    study = make_study(options, arm)
    block = 1 if jax.default_backend() == "cpu" else None
    start, proceed = make_pieces(study.init, study.advance, block)
    keys = jax.random.split(jax.random.key(options.seed), options.seeds)
    nothing_swept = jnp.float32(0)
    state = start(keys, nothing_swept)
    program: Any = proceed
    return state, program.lower(state, options.stages_of(arm)[0], nothing_swept).compile()


def _resume(options: Options, out: Path) -> tuple[Curves, Timing, float]:
    """What an earlier run with the same settings finished, and the seconds it took.

    Raises:
        ValueError: where there is no such run.
    """
    path = out / "results.json"
    if not path.exists():
        raise ValueError(f"nothing to resume in {out}: run once without --resume")
    before = json.loads(path.read_text())
    now = json.loads(json.dumps(plain(options)))
    changed = [
        name
        for name, value in now.items()
        if name not in NOT_SETTINGS and before["config"].get(name) != value
    ]
    if changed:
        flags = ", ".join(f"--{name.replace('_', '-')}" for name in changed)
        raise ValueError(
            f"the run in {out} had other settings for {flags}: "
            "resume with the same, or choose another --out"
        )
    timing = before["timing"]
    return read_curves(out / "curves.npz"), timing["arms"], timing["total_s"]


def _results(
    options: Options, command: str, curves: Curves, timing: Timing, begun: float
) -> Results:
    total = {part: sum(arm[part] for arm in timing.values()) for part in ("compile_s", "run_s")}
    return {
        "experiment": "maze_model",
        "command": command,
        "preset": options.preset,
        "config": plain(options),
        **report.environment(),
        "timing": total | {"total_s": time.perf_counter() - begun, "arms": timing},
        "arms": maze_report.describe(curves, options),
    }


if __name__ == "__main__":
    sys.exit(main())
