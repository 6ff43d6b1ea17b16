"""Milliseconds of the training steps of the Maze's networks, beside PyTorch's.

``pip install 'jaxdyna[bench]'``, then ``python -m jaxdyna.experiments.maze_bench``
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich.console import Console

from jaxdyna.experiments import cli, report
from jaxdyna.experiments.maze_bench_steps import (
    SCANNED,
    jax_q_steps,
    jax_steps,
    random_batch,
    torch_q_steps,
    torch_steps,
)
from jaxdyna.experiments.storage import plain, write_json, write_text

PROG = "python -m jaxdyna.experiments.maze_bench"
Q_BATCH = 32
FRAMES_TORCH, Q_TORCH = "PyTorch", "PyTorch, convolutions"
Table = tuple[list[str], list[list[str]]]


@dataclass(frozen=True)
class Options:
    """Times training steps of the lean frame model and of DQN in JAX and in PyTorch, in turns."""

    preset: Literal["lean"] = "lean"
    """Only lean."""
    batch: int = 64
    """Transitions a step of the frame model."""
    widths: tuple[int, ...] = (32, 32, 32)
    """Channels of the 3x3 convolutions."""
    rounds: int = 15
    """Rounds of 20 steps each, after two to warm up; the median counts."""
    out: Path = Path("runs/maze-bench")
    """Folder for the results."""

    def __post_init__(self) -> None:
        if self.batch < 1 or self.rounds < 1 or min(self.widths, default=0) < 1:
            raise ValueError("--batch, --rounds and --widths: give numbers of at least 1")


def take_turns(contenders: Mapping[str, Callable[[], Any]], rounds: int) -> dict[str, list[float]]:
    """Milliseconds of a step, in every round but the first two, which warm up."""
    taken: dict[str, list[float]] = {name: [] for name in contenders}
    names = list(contenders)
    for number in range(rounds + 2):
        names = [*names[1:], names[0]]  # whoever goes before may leave threads behind
        for name in names:
            began = time.perf_counter()
            contenders[name]()
            if number >= 2:
                taken[name].append(1000 * (time.perf_counter() - began) / SCANNED)
    return taken


def compared(taken: Mapping[str, Sequence[float]], base: str) -> Table:
    """Medians, where half of the rounds lie, and how that is to PyTorch's."""
    rows = []
    for name, values in taken.items():
        low, middle, high = np.percentile(values, [25, 50, 75])
        ratio = middle / np.median(taken[base])
        rows.append([name, f"{middle:.2f}", f"{low:.2f} to {high:.2f}", f"{ratio:.2f}"])
    return ["training step", "ms", "half of the rounds", "of PyTorch's"], rows


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the benchmark from the command line; returns the exit code."""
    options = cli.parse({"lean": Options()}, argv, PROG, spread=False)
    batch = random_batch(options.batch)
    small = random_batch(Q_BATCH)
    try:
        cli.check_writable(options.out)
        in_torch, q_in_torch = torch_steps(batch, options.widths), torch_q_steps(small)
        frames = jax_steps(batch, options.widths) | {FRAMES_TORCH: in_torch}
        q = jax_q_steps(small) | {Q_TORCH: q_in_torch}
    except ImportError:
        cli.fail("PyTorch is not installed: pip install 'jaxdyna[bench]'", PROG)
    except ValueError as error:
        cli.fail(str(error), PROG)
    frames_ms, q_ms = take_turns(frames, options.rounds), take_turns(q, options.rounds)
    tables = {
        f"Lean frame model, batch of {options.batch}": compared(frames_ms, FRAMES_TORCH),
        f"Double DQN, batch of {Q_BATCH}": compared(q_ms, Q_TORCH),
    }
    taken = frames_ms | q_ms
    results = {
        "experiment": "maze_bench",
        "command": f"{PROG} {' '.join(sys.argv[1:] if argv is None else argv)}".strip(),
        "config": plain(options),
        **report.environment(),
        "milliseconds": taken,
        "median_ms": {name: float(np.median(values)) for name, values in taken.items()},
    }
    write_json(options.out / "results.json", results)
    text = f"# Training steps of the Maze's networks\n\n`{results['command']}`\n\n"
    text += (
        f"{results['device']['cpu_cores']} cores; {options.rounds} rounds of {SCANNED} steps in "
    )
    text += "turns. In JAX Q-learning also draws its batches by priority; PyTorch is handed them.\n"
    for title, table in tables.items():
        text += f"\n## {title}\n\n{report.markdown_table(*table)}"
        report.print_table(Console(highlight=False), title, *table)
    write_text(options.out / "report.md", text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
