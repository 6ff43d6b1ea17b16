"""Seconds of CartPole's ``dyna`` arm against the number of runs, compiling apart from running."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from jaxdyna.experiments.cartpole import CARTPOLE
from jaxdyna.experiments.engine import Engine, Experiment, Options, Record, Results, Table, runs_of
from jaxdyna.experiments.report import plots, sections
from jaxdyna.experiments.report.tables import markdown_table
from jaxdyna.fields import changed, setting


@dataclass(frozen=True, kw_only=True)
class SweepOptions(Options):
    """Times whole sweeps of CartPole's dyna arm, each compiled anew."""

    decided: ClassVar = dict.fromkeys(
        ("arms", "seeds", "stop_after_solved", "block"), "what is measured"
    )

    preset: str = setting("lean", "whose settings are used")
    setup: Literal["tuned", "lean"] = setting("lean", "CartPole's preset", everyday=True)
    sizes: tuple[int, ...] = setting((10, 100, 1000), "numbers of runs", at_least=1, everyday=True)
    episodes: int = setting(150, "real episodes of each run", at_least=1, everyday=True)


def measure(options: SweepOptions, say: Any) -> list[Results]:
    """A row a number of runs; every run plays all its episodes."""
    setup = changed(CARTPOLE.presets[options.setup], {"episodes": options.episodes}).resolved()
    arm = CARTPOLE.arms(setup)["dyna"]()
    rows = []
    for count in options.sizes:
        seconds = Engine().play(arm.work, runs_of([arm], range(count), options.seed)).seconds
        rows.append({"runs": count, **seconds._asdict()})
        say(f"{count} runs: {sum(seconds):.1f} s")
    return rows


def table(results: Results) -> Table:
    """A row a sweep."""
    return ["runs", "compiling (s)", "running (s)", "seconds a run, compiling included"], [
        [f"{runs:,.0f}", f"{compiling:.1f}", f"{running:.1f}",
         f"{(compiling + running) / runs:.2f}"]
        for runs, compiling, running in _columns(results).T
    ]  # fmt: skip


def _columns(results: Results) -> np.ndarray:
    columns = "runs", "compile_s", "run_s"
    return np.array([[row[column] for row in results["sweeps"]] for column in columns])


def figure(path: Path, results: Results) -> None:
    """Seconds of a whole sweep, and seconds a run, against the number of runs; drawn as a PNG."""
    runs, compiling, running = _columns(results)
    whole = compiling + running
    panels = {
        "seconds a sweep": {"in all": whole, "compiling": compiling},
        "seconds a run": {"in all": whole / runs, "without compiling": running / runs},
    }
    drawn, axes = plots.subplots(1, 2, figsize=(8.5, 3.6), sharex=True)
    for panel, (axis, lines) in zip(axes, panels.items(), strict=True):
        for (name, seconds), style in zip(lines.items(), ("o-", "o:"), strict=True):
            panel.loglog(runs, seconds, style, color=plots.COLOURS["dyna"], label=name)
        panel.grid(alpha=0.3)
        plots.finish(panel, x="runs", y=axis)
    plots.save(drawn, path)


def section(record: Record) -> str:
    """The table and the figure."""
    figure(record.out / "seconds.png", record.results)
    device, options = record.results["device"], record.options
    return sections.paragraphs(
        f"CartPole, `{options.setup}` preset, `dyna` arm, {options.episodes} real episodes a run, "
        f"compiled anew for each row, on {device['cpu_cores']} cores ({device['platform']}).",
        markdown_table(*table(record.results)), "![seconds against runs](seconds.png)",
    )  # fmt: skip


SWEEP = Experiment(
    name="sweep",
    title="What a sweep costs",
    presets={"lean": SweepOptions()},
    arms=lambda options: {},
    measures={"sweeps": measure},
    sections=(section,),
)
