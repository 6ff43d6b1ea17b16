"""How fast this package is, beside what people would use instead of it."""

from collections.abc import Callable, Iterable
from functools import partial
from shutil import which
from typing import Any

from jaxdyna.experiments.benchmark import report
from jaxdyna.experiments.benchmark.options import FEW, MEASURES, BenchmarkOptions
from jaxdyna.experiments.benchmark.timing import yardstick
from jaxdyna.experiments.engine import Experiment, InputError, Results
from jaxdyna.experiments.report import sections


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
        return found

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
