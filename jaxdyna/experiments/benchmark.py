"""Seconds of CartPole's ``dyna`` arm against the number of runs, compiling apart from running."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from jaxdyna.experiments.cartpole import CARTPOLE
from jaxdyna.experiments.engine import Engine, Experiment, Options, Record, Results, main, runs_of
from jaxdyna.experiments.report import plots, sections
from jaxdyna.experiments.report.tables import markdown_table
from jaxdyna.fields import changed, setting


@dataclass(frozen=True, kw_only=True)
class SweepOptions(Options):
    """Times whole sweeps of CartPole's dyna arm, each compiled anew."""

    decided: ClassVar = dict.fromkeys(
        ("arms", "seeds", "stop_after_solved", "block"), "what is measured"
    )

    sizes: tuple[int, ...] = setting(
        (10, 100, 1000), "numbers of runs", at_least=1, at_most=10**6, everyday=True
    )
    episodes: int = setting(150, "real episodes of each run", at_least=1, everyday=True)


def measure(options: SweepOptions, say: Any) -> list[Results]:
    """A row a number of runs; every run plays all its episodes."""
    setup = changed(CARTPOLE.presets[options.preset], {"episodes": options.episodes}).resolved()
    arm = CARTPOLE.arms(setup)["dyna"]()
    rows = []
    for count in options.sizes:
        seconds = Engine().play(arm.work, runs_of([arm], range(count), options.seed)).seconds
        rows.append({"runs": count, **seconds._asdict()})
        say(f"{count} runs: {sum(seconds):.1f} s")
    return rows


def section(record: Record) -> str:
    """The table, and seconds of a whole sweep and seconds a run in ``seconds.png``."""
    columns, sweeps = ("runs", "compile_s", "run_s"), record.results["sweeps"]
    numbers = np.array([[row[column] for row in sweeps] for column in columns])
    runs, compiling, running = numbers[:, None]
    whole = compiling + running
    panels = {
        "seconds a sweep": {"in all": whole, "compiling": compiling},
        "seconds a run": {"in all": whole / runs, "without compiling": running / runs},
    }
    plots.bands(record.out / "seconds.png", panels, "runs", at=runs[0], xscale="log", yscale="log")
    lines = [
        [f"{count:,.0f}", f"{before:.1f}", f"{after:.1f}", f"{(before + after) / count:.2f}"]
        for count, before, after in numbers.T
    ]
    header = ["runs", "compiling (s)", "running (s)", "seconds a run, compiling included"]
    device, options = record.results["device"], record.options
    return sections.paragraphs(
        f"CartPole, `{options.preset}` preset, `dyna` arm, {options.episodes} real episodes a run, "
        f"compiled anew for each row, on {device['cpu_cores']} cores ({device['platform']}).",
        markdown_table(header, lines), "![seconds against runs](seconds.png)",
    )  # fmt: skip


SWEEP = Experiment(
    name="sweep",
    title="What a sweep costs",
    presets={name: SweepOptions(preset=name) for name in ("lean", "tuned")},
    arms=lambda options: {},
    measures={"sweeps": measure},
    sections=(section,),
)
PARTS = (SWEEP,)

if __name__ == "__main__":
    raise SystemExit(main(*PARTS))
