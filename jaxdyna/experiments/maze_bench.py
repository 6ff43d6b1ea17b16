"""Seconds of a training step of the lean frame model: alone, inside a scan, and in PyTorch.

``pip install 'jaxdyna[bench]'``, then ``python -m jaxdyna.experiments.maze_bench``
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from jaxdyna.experiments import cli, report
from jaxdyna.experiments.storage import plain, write_json, write_text
from jaxdyna.models import PixelConfig, PixelHParams, pixels
from jaxdyna.networks import LocalDynamics
from jaxdyna.types import Transition

PROG = "python -m jaxdyna.experiments.maze_bench"
SCANNED = 20


@dataclass(frozen=True)
class Options:
    """Times one training step of the lean frame model in JAX and in PyTorch, in turns."""

    preset: Literal["lean"] = "lean"
    """Only lean."""
    batch: int = 64
    """Transitions a step."""
    widths: tuple[int, ...] = (32, 32, 32)
    """Channels of the 3x3 convolutions."""
    rounds: int = 15
    """Rounds of 20 steps each; the median round counts."""
    out: Path = Path("runs/maze-bench")
    """Folder for the results."""

    def __post_init__(self) -> None:
        if self.batch < 1 or self.rounds < 1 or min(self.widths, default=0) < 1:
            raise ValueError("--batch, --rounds and --widths: give numbers of at least 1")


def random_batch(size: int) -> Transition:
    """A batch as the Maze's frames are: few pixels lit."""
    generator = np.random.default_rng(0)
    frames = (generator.random((size, 16, 16, 15)) < 0.02).astype(np.uint8) * 255
    flags = np.zeros(size, bool)
    fields: Any = {
        "obs": frames[..., :12],
        "action": generator.integers(0, 5, size),
        "reward": generator.integers(-1, 2, size).astype(np.float32),
        "next_obs": frames[..., 3:],
        "terminated": flags,
        "truncated": flags,
        "mask": ~flags,
    }
    return Transition(**fields)


def jax_steps(batch: Any, widths: tuple[int, ...]) -> dict[str, Callable[[], Any]]:
    """`SCANNED` steps, called one by one and as one scan."""
    model = pixels((16, 16, 3), 5, PixelConfig(LocalDynamics(3, widths)))
    hparams = PixelHParams()
    batch = jax.tree.map(jnp.asarray, batch)
    start = jax.jit(model.init)(jax.random.key(0), hparams)

    @jax.jit
    def step(state: Any, batch: Any, key: jax.Array) -> Any:
        return model.update(state, batch, key, hparams)[0]

    @jax.jit
    def scan(state: Any, batch: Any, keys: jax.Array) -> Any:
        return jax.lax.scan(lambda state, key: (step(state, batch, key), None), state, keys)[0]

    keys = jax.random.split(jax.random.key(1), SCANNED)

    def alone() -> None:
        state = start
        for key in keys:
            state = step(state, batch, key)
        jax.block_until_ready(state)

    return {
        "JAX, step by step": alone,
        "JAX, in a scan": lambda: jax.block_until_ready(scan(start, batch, keys)),
    }


def torch_steps(batch: Any, widths: tuple[int, ...]) -> Callable[[], None]:
    """The same steps in PyTorch: same layers, losses and optimiser."""
    import torch  # noqa: PLC0415  (the bench extra's)
    from torch import nn  # noqa: PLC0415

    sizes = [13, *widths]
    layers = nn.ModuleList(
        [nn.Conv2d(a, b, 3, padding=1) for a, b in zip(sizes, widths, strict=False)]
    )
    by_action, last = nn.Linear(5, widths[0]), nn.Conv2d(widths[-1], 3, 1)
    head = nn.Sequential(nn.Conv2d(3, 16, 1), nn.ReLU(), nn.Conv2d(16, 1, 1, bias=False))
    parts = nn.ModuleList([layers, by_action, last, head])
    optimizer = torch.optim.Adam(parts.parameters(), lr=5e-3)

    def picture(frames: np.ndarray) -> Any:
        return torch.from_numpy(np.ascontiguousarray(frames.transpose(0, 3, 1, 2)))

    obs, truth = picture(batch.obs), picture(batch.next_obs[..., -3:])
    action = torch.from_numpy(np.eye(5, dtype=np.float32)[batch.action])
    reward = torch.from_numpy(batch.reward)

    def steps() -> None:
        for _ in range(SCANNED):
            seen, target = obs.float() / 255, truth.float() / 255
            x = torch.cat([seen, torch.ones_like(seen[:, :1])], 1)
            for number, layer in enumerate(layers):
                x = layer(x)
                x = x * by_action(action)[:, :, None, None] if number == 0 else x
                x = torch.relu(x)
            raw = last(x)
            cells = head(target)[:, 0]
            loss = nn.functional.binary_cross_entropy_with_logits(raw, target, reduction="none")
            charge = 0.1 * cells.abs().sum((1, 2))
            error = (cells.sum((1, 2)) - reward) ** 2
            (loss.sum((1, 2, 3)) + error + charge).mean().backward()
            optimizer.step()
            optimizer.zero_grad()

    return steps


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the benchmark from the command line; returns the exit code."""
    options = cli.parse({"lean": Options()}, argv, PROG, spread=False)
    batch = random_batch(options.batch)
    try:
        cli.check_writable(options.out)
        in_torch = torch_steps(batch, options.widths)
        contenders = jax_steps(batch, options.widths) | {"PyTorch": in_torch}
    except ImportError:
        cli.fail("PyTorch is not installed: pip install 'jaxdyna[bench]'", PROG)
    except ValueError as error:
        cli.fail(str(error), PROG)
    taken: dict[str, list[float]] = {name: [] for name in contenders}
    names = list(contenders)
    for number in range(options.rounds + 2):
        names = [*names[1:], names[0]]  # whoever goes before may leave threads behind
        for name in names:
            began = time.perf_counter()
            contenders[name]()
            if number >= 2:  # the first rounds warm up
                taken[name].append(1000 * (time.perf_counter() - began) / SCANNED)
    median = {name: float(np.median(values)) for name, values in taken.items()}
    rows = []
    for name, ms in median.items():
        low, high = np.percentile(taken[name], [25, 75])
        rows.append(
            [name, f"{ms:.1f}", f"{low:.1f} to {high:.1f}", f"{ms / median['PyTorch']:.2f}"]
        )
    table = ["training step", "ms", "half of the rounds", "of PyTorch's"], rows
    results = {
        "experiment": "maze_bench",
        "command": f"{PROG} {' '.join(sys.argv[1:] if argv is None else argv)}".strip(),
        "config": plain(options),
        **report.environment(),
        "milliseconds": taken,
        "median_ms": median,
    }
    write_json(options.out / "results.json", results)
    text = f"# A training step of the lean frame model\n\n`{results['command']}`\n\nBatch of "
    text += f"{options.batch}, {results['device']['cpu_cores']} cores, median of {options.rounds} "
    text += f"rounds of {SCANNED} steps in turns.\n\n{report.markdown_table(*table)}"
    write_text(options.out / "report.md", text)
    report.print_table(Console(highlight=False), "Training step, lean frame model", *table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
