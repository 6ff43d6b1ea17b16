"""What a sweep costs: seconds against the number of runs, compiling apart from running.

``python -m jaxdyna.experiments.cartpole_scaling``
"""

from __future__ import annotations

import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import jax
from rich.console import Console

from jaxdyna.dyna import make_train
from jaxdyna.experiments import cli, plots_studies, report
from jaxdyna.experiments.cartpole import make_arms
from jaxdyna.experiments.cartpole_options import PRESETS, dyna_config
from jaxdyna.experiments.cartpole_options import Options as CartPoleOptions
from jaxdyna.experiments.storage import plain, write_json, write_text
from jaxdyna.sweep import AXES, sweep

PROG = "python -m jaxdyna.experiments.cartpole_scaling"


@dataclass(frozen=True)
class Options:
    """Times whole sweeps of CartPole's dyna arm, each one jitted call compiled anew."""

    preset: Literal["paper", "lean"] = "lean"
    """Whose settings are used."""
    sizes: tuple[int, ...] = (10, 100, 1000)
    """Numbers of runs to time."""
    seed: int = 0
    """Base seed."""
    episodes: int = 150
    """Real episodes of each run."""
    out: Path = Path("runs/cartpole-scaling")
    """Folder for the results."""

    def __post_init__(self) -> None:
        cli.check_common(self)
        if not self.sizes or min(self.sizes) < 1:
            raise ValueError(f"--sizes are {self.sizes}: give numbers of runs, each at least 1")
        dyna_config(self.setup)

    @property
    def setup(self) -> CartPoleOptions:
        """The settings of each run."""
        return replace(PRESETS[self.preset], episodes=self.episodes)


def measure(options: Options, runs: int) -> dict[str, float]:
    """Seconds of one sweep of ``runs`` runs, tracing and compiling apart from running."""
    arm = make_arms(options.setup)["dyna"]
    train = make_train(arm.dyna._replace(diagnose=None), arm.config, AXES)
    block = options.setup.block if jax.default_backend() == "cpu" else None

    def returns(key: jax.Array, hparams: Any) -> jax.Array:
        return train(key, hparams)[1]["real_return"]

    keys = jax.random.split(jax.random.key(options.seed), runs)
    whole = jax.jit(lambda keys: sweep(returns, keys, arm.hparams, block))
    began = time.perf_counter()
    compiled = whole.lower(keys).compile()
    compile_s = time.perf_counter() - began
    began = time.perf_counter()
    jax.block_until_ready(compiled(keys))
    run_s = time.perf_counter() - began
    return {"runs": runs, "compile_s": compile_s, "run_s": run_s}


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the study from the command line; returns the exit code."""
    options = cli.parse({"lean": Options()}, argv, PROG)
    try:
        cli.check_writable(options.out)
    except ValueError as error:
        cli.fail(str(error), PROG)
    console = Console(highlight=False)
    rows = []
    for runs in options.sizes:
        with console.status(f"{runs} runs ..."):
            rows.append(measure(options, runs))
        console.print(f"{runs} runs: {rows[-1]['compile_s'] + rows[-1]['run_s']:.1f} s")
    arguments = sys.argv[1:] if argv is None else argv
    results = {
        "experiment": "cartpole_scaling",
        "command": f"{PROG} {shlex.join(arguments)}".strip(),
        "preset": options.preset,
        "config": plain(options),
        **report.environment(),
        "sweeps": rows,
    }
    write_json(options.out / "results.json", results)
    plots_studies.sweep_cost(options.out / "seconds.png", rows)
    write_text(options.out / "report.md", _markdown(results, options))
    report.print_table(console, "What a sweep costs", *_table(rows))
    console.print(f"Report: {options.out / 'report.md'}")
    return 0


def _table(rows: list[dict[str, float]]) -> tuple[list[str], list[list[str]]]:
    header = ["runs", "compiling (s)", "running (s)", "seconds a run, compiling included"]
    cells = [
        [
            f"{row['runs']:,}",
            f"{row['compile_s']:.1f}",
            f"{row['run_s']:.1f}",
            f"{(row['compile_s'] + row['run_s']) / row['runs']:.2f}",
        ]
        for row in rows
    ]
    return header, cells


def _markdown(results: dict[str, Any], options: Options) -> str:
    device = results["device"]
    parts = [
        "# What a sweep costs",
        f"`{results['command']}`",
        f"CartPole, `{options.preset}` preset, `dyna` arm, {options.episodes} real episodes a run. "
        f"Each row is one jitted call, compiled anew, on {device['cpu_cores']} cores "
        f"({device['platform']}).",
        report.markdown_table(*_table(results["sweeps"])).rstrip(),
        "![seconds against runs](seconds.png)",
    ]
    return "\n\n".join(parts) + "\n"


if __name__ == "__main__":
    sys.exit(main())
