"""How fast this package is, beside what people would use instead of it."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from shutil import which
from typing import Any, ClassVar, Self

from jaxdyna.experiments.benchmark import commands, dreams, frames, report, steps, whole
from jaxdyna.experiments.benchmark.others import versions
from jaxdyna.experiments.benchmark.timing import yardstick
from jaxdyna.experiments.engine import Experiment, InputError, Options, Overrides, Results
from jaxdyna.experiments.report import sections
from jaxdyna.fields import changed, setting

MEASURES: Mapping[str, Callable[[Any], Iterable[Results]]] = {
    "whole": whole.measure, "steps": steps.measure, "dreams": dreams.measure,
    "frames": frames.measure, "sweeps": commands.sweeps, "start": commands.start,
    "memory": commands.memory}  # fmt: skip
WHAT = tuple(MEASURES)
SORTED = ("runs", "sizes")


@dataclass(frozen=True, kw_only=True)
class BenchmarkOptions(Options):
    """Times this package beside what would be used instead of it, on this machine, in turns."""

    decided: ClassVar = dict.fromkeys(
        ("arms", "seeds", "stop_after_solved", "block"), "what is measured"
    )

    what: tuple[str, ...] = setting(WHAT, "which measurements", choices=WHAT, everyday=True)
    rounds: int = setting(5, "turns of each side; medians of them count", at_least=1, everyday=True)
    runs: tuple[int, ...] = setting(
        (10, 100), "of whole: numbers of runs", at_least=1, at_most=10**6, everyday=True
    )
    envs: int = setting(1024, "of steps: environments at once", at_least=1, everyday=True)
    gymnax: Path | None = setting(
        None, "of steps: the interpreter of an environment with gymnax 1.0; None: without it",
        everyday=True)  # fmt: skip
    batches: tuple[int, ...] = setting(
        (1, 32, 1024, 8192), "of dreams: episodes at once", at_least=1, everyday=True
    )
    worlds: tuple[str, ...] = setting(
        tuple(frames.WORLDS), "of frames and memory: where", choices=tuple(frames.WORLDS),
        everyday=True)  # fmt: skip
    sizes: tuple[int, ...] = setting(
        (10, 100, 1000), "of sweeps: numbers of runs", at_least=1, at_most=10**6, everyday=True
    )
    sweep_episodes: int = setting(10, "of sweeps: real episodes of each run", at_least=2)

    def resolved(self) -> Self:
        """The smallest number of runs first: others stand beside it."""
        return changed(self, {name: tuple(sorted(getattr(self, name))) for name in SORTED})


FEW: Overrides = {
    "rounds": 1, "runs": (2,), "episodes": 120, "batches": (1, 1024),
    "worlds": ("Maze",), "sizes": (2, 20), "sweep_episodes": 4}  # fmt: skip


def _measured(name: str, rows: Callable[[Any], Iterable[Results]]) -> Callable[..., Any]:
    """A measurement that tells each row as it comes; None where it is not asked for."""

    def measure(options: BenchmarkOptions, say: Callable[[str], None]) -> Results | None:
        if name not in options.what:
            return None
        if options.gymnax and not which(options.gymnax):
            raise InputError(f"--gymnax is {options.gymnax}: that is no program, name a Python")
        found: Results = {"yardstick": yardstick(options.rounds), "rows": []}
        for row in rows(options):
            found["rows"].append(row)
            say(f"{name}: {report.line(row)}")
        return found | {"rivals": versions()}

    return measure


BENCHMARK = Experiment(
    name="benchmark",
    title="How fast it is",
    presets={"tuned": BenchmarkOptions()},
    quick={"tuned": FEW},
    arms=lambda options: {},
    measures={name: _measured(name, rows) for name, rows in MEASURES.items()},
    sections=(
        report.machine, report.figure, *(partial(report.section, name=name) for name in MEASURES),
        sections.settings, sections.spent,
    ),
)  # fmt: skip
PARTS = (BENCHMARK,)
