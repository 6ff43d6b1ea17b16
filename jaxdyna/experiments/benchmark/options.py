"""What is measured, and how much of it."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from jaxdyna.experiments.benchmark import commands, dreams, frames, steps, whole
from jaxdyna.experiments.engine import Options, Overrides, Results
from jaxdyna.fields import setting

MEASURES: Mapping[str, Callable[[Any], Iterable[Results]]] = {
    "whole": whole.measure, "steps": steps.measure, "dreams": dreams.measure,
    "frames": frames.measure, "sweeps": commands.sweeps, "start": commands.start,
    "memory": commands.memory}  # fmt: skip
WHAT = tuple(MEASURES)


@dataclass(frozen=True, kw_only=True)
class BenchmarkOptions(Options):
    """Times this package beside what would be used instead of it, on this machine, in turns."""

    decided: ClassVar = dict.fromkeys(
        ("arms", "seeds", "stop_after_solved", "block"), "what is measured"
    )

    what: tuple[str, ...] = setting(WHAT, "which measurements", choices=WHAT, everyday=True)
    rounds: int = setting(5, "turns of each side; medians of them count", at_least=1, everyday=True)
    runs: tuple[int, ...] = setting(
        (10, 100), "of whole: numbers of runs, the smallest first", at_least=1, at_most=10**6,
        everyday=True)  # fmt: skip
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


FEW: Overrides = {
    "rounds": 2, "runs": (2,), "episodes": 120, "batches": (1, 1024),
    "worlds": ("Maze",), "sizes": (2,), "sweep_episodes": 4}  # fmt: skip
