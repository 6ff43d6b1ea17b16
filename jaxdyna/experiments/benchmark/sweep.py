"""Seconds of CartPole's ``dyna`` arm against the number of runs, compiling apart from running."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from jaxdyna.experiments.cartpole import CARTPOLE
from jaxdyna.experiments.engine import Engine, Experiment, Options, Record, Results, Table, runs_of
from jaxdyna.experiments.report import sections, studies
from jaxdyna.experiments.report.tables import markdown_table
from jaxdyna.fields import changed, setting

NOT_HERE: dict[str, str] = dict.fromkeys(
    ("arms", "seeds", "stop_after_solved", "block"), "what is measured"
)
HEADER = ["runs", "compiling (s)", "running (s)", "seconds a run, compiling included"]


@dataclass(frozen=True, kw_only=True)
class SweepOptions(Options):
    """Times whole sweeps of CartPole's dyna arm, each compiled anew."""

    decided: ClassVar = NOT_HERE

    preset: str = setting("lean", "whose settings are used")
    setup: Literal["tuned", "lean"] = setting("lean", "CartPole's preset", everyday=True)
    sizes: tuple[int, ...] = setting((10, 100, 1000), "numbers of runs", at_least=1, everyday=True)
    episodes: int = setting(150, "real episodes of each run", at_least=1, everyday=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.sizes:
            raise ValueError("--sizes is empty: give numbers of runs")


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
    return HEADER, [
        [
            f"{row['runs']:,}", f"{row['compile_s']:.1f}", f"{row['run_s']:.1f}",
            f"{(row['compile_s'] + row['run_s']) / row['runs']:.2f}",
        ]
        for row in results["sweeps"]
    ]  # fmt: skip


def section(record: Record) -> str:
    """The table and the figure."""
    studies.sweep_cost(record.out / "seconds.png", record.results["sweeps"])
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
    summary=lambda record: [("What a sweep costs", table(record.results))],
)
