"""An experiment is data: what is filled in, and made of it. A study is a table of overrides."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Self

from jaxdyna import fields
from jaxdyna.experiments.engine.storage import Results
from jaxdyna.experiments.engine.work import Arm, Curves
from jaxdyna.fields import setting
from jaxdyna.statistics import SolveRule

Overrides = Mapping[str, Any]
Say = Callable[[str], None]


@dataclass(frozen=True, kw_only=True)
class Options(fields.Checked):
    """The settings that every experiment has; a world's own come with a subclass."""

    #: by dotted path, which flag decides a setting instead: it is no flag of its own
    decided: ClassVar[Mapping[str, str]] = {}
    #: how the paths of settings begin that say what is played: runs in which they differ cannot be
    #: compared
    world_settings: ClassVar[Sequence[str]] = ("hparams.env",)

    preset: str = setting("tuned", "whose settings are the defaults")
    quick: bool = setting(False, "whether it is a look at everything in minutes")
    arms: tuple[str, ...] = setting((), "what is played", everyday=True)
    seeds: int = setting(10, "runs of every arm", at_least=1, at_most=10**6, everyday=True)
    seed: int = setting(0, "base seed of all runs", at_least=0, at_most=2**32 - 1, everyday=True)
    episodes: int = setting(1000, "real episodes of a run at the most", at_least=1, everyday=True)
    stop_after_solved: int | None = setting(
        None, "real episodes that a run plays on, at least, once it has solved; None plays all",
        at_least=0, everyday=True)  # fmt: skip
    block: int = setting(
        1, "runs computed together; a run's bits depend on this number and on nothing beside it",
        at_least=1, everyday=True)  # fmt: skip

    def resolved(self) -> Self:
        """With what other settings decide filled in. A subclass says how."""
        return self

    @property
    def home(self) -> str:
        """The module by which it is told, with what lies beside it, whether code has changed."""
        return type(self).__module__


class Record(NamedTuple):
    """All that a report may read."""

    options: Any  #: the experiment's, resolved
    results: Results  #: what is in ``results.json``
    #: arrays ``[runs, ...]`` by the names of the entries of ``results["arms"]``
    curves: Mapping[str, Curves]
    out: Path  #: the folder for figures


@dataclass(frozen=True)
class Experiment:
    """One experiment."""

    name: str  #: of its part of the command line, and in ``results.json``
    title: str  #: of its report
    presets: Mapping[str, Any]  #: options by name, the default one first
    #: from options to what makes each arm, by its name, or ``NAME@SETTING`` where there are several
    #: of one; only those asked for are made
    arms: Callable[[Any], Mapping[str, Callable[[], Arm]]]
    #: by preset, what ``--quick`` changes
    quick: Mapping[str, Overrides] = field(default_factory=dict)
    #: from options to when a run counts as solved, or to None where none does
    rule: Callable[[Any], SolveRule | None] = lambda options: None
    #: ``(options, curves) -> entries`` of an arm in ``results.json``
    describe: Sequence[Callable[[Any, Curves], Results]] = ()
    #: by name ``(options, say) -> JSON``: host work without runs
    measures: Mapping[str, Callable[[Any, Say], Any]] = field(default_factory=dict)
    #: ``(record) -> Markdown``: the report's, in their order; each draws its figures. What comes
    #: before the first figure is printed as well.
    sections: Sequence[Callable[[Record], str]] = ()
    study: Study | None = None  #: what its rows are made of, where it is a table of overrides


class Study(NamedTuple):
    """A table of overrides: one arm of an experiment, changed in each row."""

    name: str  #: of its part of the command line
    title: str  #: of its report
    of: Experiment  #: the experiment
    preset: str  #: whose settings are changed
    #: by name, what is changed, by dotted path; ``"arm"`` names another arm than ``arm``. The first
    #: is what the others are compared with.
    rows: Callable[[Any], Mapping[str, Overrides]]
    sections: Sequence[Callable[[Record], str]] = ()  #: as an experiment's
    #: what is changed in all rows, and can be set otherwise on the command line
    common: Overrides = {}
    arm: str = "dyna"  #: that is played
    describe: Sequence[Callable[[Any, Curves], Results]] = ()  #: beside the experiment's
    quick: Overrides = {}  #: what ``--quick`` changes

    def experiment(self) -> Experiment:
        """The experiment whose arms are the rows."""
        base = fields.changed(self.of.presets[self.preset], self.common)
        if "arms" not in self.common:
            base = fields.changed(base, {"arms": tuple(self.rows(base.resolved()))})

        def arms(options: Any) -> Mapping[str, Callable[[], Arm]]:
            rows = self.rows(options)
            return {name: partial(self.made, options, row) for name, row in rows.items()}

        return replace(
            self.of, name=self.name, title=self.title, presets={self.preset: base}, arms=arms,
            quick={self.preset: self.quick}, describe=(*self.of.describe, *self.describe),
            measures={}, sections=self.sections, study=self)  # fmt: skip

    def made(self, options: Any, row: Overrides) -> Arm:
        """The arm of a row."""
        name = row.get("arm", self.arm)
        return self.of.arms(fields.changed(self.setup(options, row), {"arms": (name,)}))[name]()

    def setup(self, options: Any, row: Overrides) -> Any:
        """The settings of a row, resolved."""
        overrides = {path: value for path, value in row.items() if path != "arm"}
        return fields.changed(options, overrides).resolved()


class Entry(NamedTuple):
    """What is an entry of ``results["arms"]``: an arm in a setting."""

    name: str  #: of the entry
    arm: str  #: its name alone
    names: tuple[str, ...]  #: by any of which it is asked for
    options: Any  #: the experiment's in that setting, resolved
    make: Callable[[], Arm]  #: makes it


def entries(
    experiment: Experiment, options: Any, sweep: Mapping[str, Sequence[Any]]
) -> list[Entry]:
    """Every entry that there can be, from settings not resolved yet, swept over a grid of values by
    dotted path; not the rows of a study that decide a swept setting themselves. `ValueError` where
    what is swept would change when a run counts as solved, or is not what runs are played with.
    """
    made: list[Entry] = []
    grid = [dict(zip(sweep, values, strict=True)) for values in product(*sweep.values())]
    setups = [fields.changed(options, point).resolved() for point in grid]
    for point, setup in zip(grid, setups, strict=True):
        if other := [path for path in point if fields.value_at(setup, path) != point[path]]:
            raise ValueError(f"--sweep {other[0]}: other settings do not allow {point[other[0]]}")
    if len({experiment.rule(setup) for setup in setups}) > 1:
        raise ValueError(
            f"--sweep {', '.join(sweep)}: runs would count as solved by several rules, and could "
            "not be compared: play each value by a command of its own, or give the experiment one "
            "rule, such as a share of what could be had (SolveRule's share_of)"
        )
    tables = [experiment.arms(setup) for setup in setups]
    study = experiment.study
    for name in dict.fromkeys(name for table in tables for name in table):
        arm, _, stage = name.partition("@")
        for point, setup, table in zip(grid, setups, tables, strict=True):
            row = study.rows(setup).get(name, {}) if study else {}
            if row.keys() & sweep.keys():
                continue
            swept = ",".join(f"{path}={_said(value)}" for path, value in point.items())
            where = ",".join(part for part in (stage, swept) if part)
            full = f"{arm}@{where}" if where else arm
            if name in table:
                own = study.setup(setup, row) if study else setup
                made.append(Entry(full, arm, (arm, name, full), own, table[name]))
    return made


def chosen(every: Sequence[Entry], asked: Sequence[str]) -> list[Entry]:
    """The entries that are asked for, by name; all where none is named. `ValueError` where there is
    no such arm, or one is named twice.
    """
    if not asked:
        return list(every)
    if twice := [name for name in asked if asked.count(name) > 1]:
        raise ValueError(f"--arms names {twice[0]} twice: name each arm once")
    known = {name for entry in every for name in entry.names[:2]}
    of = {ask: [entry for entry in every if ask in entry.names] for ask in asked}
    if unknown := [ask for ask, found in of.items() if not found]:
        raise ValueError(f"--arms {unknown[0]}: there are {'; '.join(sorted(known))}")
    return list({entry.name: entry for found in of.values() for entry in found}.values())


def _said(value: Any) -> str:
    if isinstance(value, tuple):
        return "x".join(map(_said, value))
    short = f"{value:g}" if isinstance(value, float) else str(fields.plain(value))
    return repr(value) if isinstance(value, float) and float(short) != value else short
