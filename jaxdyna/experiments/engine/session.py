"""From the command line to the report: the same for every experiment."""

from __future__ import annotations

import gc
import itertools
import json
import shlex
import signal
import sys
import time
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console

from jaxdyna import fields
from jaxdyna.experiments.engine import cli, folders, programs, progress, storage, trained, work
from jaxdyna.experiments.engine.checkpoint import Store, checkpoints_below
from jaxdyna.experiments.engine.distributed import Processes, taken
from jaxdyna.experiments.engine.experiment import Entry, Experiment, Record, Study, chosen, entries
from jaxdyna.experiments.engine.loaded import load
from jaxdyna.experiments.engine.record import (
    different,
    home_of,
    read_back,
    results_of,
    write_report,
)
from jaxdyna.experiments.engine.storage import InputError, Results
from jaxdyna.statistics import episodes_to_solve

NOT_SETTINGS = ("arms",)
COMPILED = 4  #: programs that are compiled at a time, at the most
FROM = ("part", "preset")


def main(
    *parts: Experiment | Study, argv: Sequence[str] | None = None, prog: str | None = None,
    log: Sequence[progress.Tracker] = (),
) -> int:  # fmt: skip
    """Runs an experiment from the command line and returns the exit code: 0, 130 after Ctrl-C, 1
    where another process of the run was lost. `SystemExit` with code 2 and one line on bad input,
    with 0 after ``--help``.

    Args:
        parts: what ``--part`` chooses from by name; the first is the default.
        argv: the arguments, by default the process's.
        prog: the command as the user types it.
        log: who is told of the first runs of each arm, beside those that ``--log`` names.
    """
    cli.spell_out()
    if argv is None:  # a process of its own: tracing need not search what was imported for garbage
        gc.freeze()
        argv = sys.argv[1:]
    argv, said = taken(argv)
    prog = prog or _prog()
    processes = Processes()
    with cli.while_read(), ExitStack() as stack:
        with cli.refused(prog, argv):
            if said is not None:
                processes.found(said, stack)
            session = replace(prepared(parts, argv, prog), processes=processes)
            session.begin(stack, log)
        with cli.refused(prog, argv, (InputError,)):
            code = session.run()
    return code


def prepared(parts: Sequence[Experiment | Study], argv: Sequence[str], prog: str) -> Session:
    """The session that is asked for, not begun; `ValueError` if bad, `SystemExit` after help."""
    asked = [word for word in argv if word not in ("--help", "-h", "--help-all")]
    if {"--resume", "--fresh"} <= set(asked):
        raise ValueError("--resume goes on with unfinished work, --fresh drops it: leave one out")
    if "--out=" in asked or ("--out", "") in itertools.pairwise(asked):
        raise ValueError("--out is empty: name a folder, . for this one")
    call, rest = cli.read(cli.Call, asked, prog, return_unknown_args=True)
    earlier = _earlier(call, parts[0].name)
    call = replace(call, **{name: earlier[name] for name in FROM if name in earlier})
    known = {part.name: part for part in parts}
    part = cli.by_name(known, "part", call.part)
    experiment = part.experiment() if isinstance(part, Study) else part
    default = cli.by_name(experiment.presets, "preset", call.preset)
    default = fields.restored(default, earlier.get("config", {}))
    if earlier and call.sweep:  # its rows have other names than those of an earlier one
        arms = dict.fromkeys(name.partition("@")[0] for name in default.arms)
        default = replace(default, arms=tuple(arms))
    preset = call.preset or next(iter(experiment.presets))
    quick = experiment.quick.get(preset)
    if len(asked) < len(argv):
        print(cli.help_text(prog, known, experiment, default, "--help-all" in argv))
        raise SystemExit(0)
    if call.quick:
        if not quick:
            raise ValueError(f"--quick: {experiment.name} has none: lower --seeds and --episodes")
        default = fields.changed(default, {**quick, "quick": True})
    asked_for = cli.parse(default, rest, prog)
    options = asked_for.resolved()
    if "--arms" in rest and not options.arms:
        raise ValueError("--arms is empty: name arms, or leave it out for all")
    sweep = cli.swept(options, call.sweep) or read_back(default, earlier.get("sweep", {}))
    every = entries(experiment, asked_for, sweep)
    if not every and (sweep or call.shards[1] > 1):
        raise ValueError(
            f"--sweep and --shard divide runs, of which {experiment.name} has none: leave them out"
        )
    command = f"{prog} {shlex.join(word for word in argv if word != '--resume')}".strip()
    first = call.part is None or call.part == parts[0].name
    name = parts[0].name if first else f"{parts[0].name}-{experiment.name}"
    out, (number, of) = Path("runs") / (f"{name}-{preset}" if first else name), call.shards
    if of > 1:
        out = out / "parts" / f"{number}-of-{of}"
    return Session(
        parts[0].name, part, experiment, options, every, sweep, call, call.out or out, command
    )


def _earlier(call: cli.Call, name: str) -> Results:
    """What ``--from`` names; nothing without. `ValueError` where it is no result of this
    experiment, or another part or preset is asked for.
    """
    if call.from_ is None:
        return {}
    earlier = cli.earlier(call.from_)
    if "config" not in earlier or "part" not in earlier:
        raise ValueError(f"--from {call.from_}: it is no result of today's format")
    if earlier["experiment"] != name:
        raise ValueError(f"--from {call.from_} is a result of {earlier['experiment']}: play it by "
                         "that command")  # fmt: skip
    for said in FROM:
        if getattr(call, said) not in (None, earlier[said]):
            raise ValueError(f"--{said}: --from says which; leave one of them out")
    return earlier


def _prog() -> str:
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    name = (spec.name if spec else Path(sys.argv[0]).name).removesuffix(".__main__")
    return f"python -m {name}" if spec else f"python {name}"


@dataclass
class Session:
    """Plays what is not finished, keeps what is on disk, and reports."""

    family: str  #: the name of the experiment whose part this is
    part: Experiment | Study  #: what ``main`` was given
    experiment: Experiment  #: what is played
    options: Any  #: its settings, resolved
    every: list[Entry]  #: each of ``results["arms"]`` that there can be
    sweep: Mapping[str, Sequence[Any]]  #: values by dotted path
    call: cli.Call  #: what else was asked for
    out: Path  #: the folder for the results
    command: str  #: as typed
    processes: Processes = field(default_factory=Processes)  #: that share the work
    console: Console = field(
        default_factory=lambda: Console(highlight=False, width=None if sys.stdout.isatty() else 100)
    )

    def begin(self, stack: ExitStack, log: Sequence[progress.Tracker] = ()) -> None:
        """Makes the arms, takes the folder, until the stack is closed, for this process alone, and
        takes up what is there or sets it aside; `ValueError` with what to change.
        """
        self.began, self.earlier = time.perf_counter(), None
        self.share = stack.enter_context(programs.kept()) if self.call.cache else lambda: None
        self.curves: dict[str, work.Curves] = {}
        self.timing: dict[str, dict[str, float]] = {}
        self.measured: dict[str, Any] = {}
        self.earlier_s = 0.0
        self.others: Results = {}  # what was played by other code or versions
        homes = {self.options.home, self.experiment.arms.__module__}
        self.made = storage.made_with(homes)
        if not self.seeds:
            raise ValueError("--shard has more parts than there are --seeds: give fewer")
        self.entries = chosen(self.every, self.options.arms)
        self.arms = {entry.name: entry.make() for entry in self.entries}
        self.trackers = [*progress.trackers(self.call.log), *log]
        with self.processes.after_first():
            self._take_folder(stack)
        self.logged = progress.logged(self.out)

    def _take_folder(self, stack: ExitStack) -> None:
        first = self.processes.first
        whose = {"experiment": self.family, "part": self.experiment.name}
        if first and self.call.resume and not self.out.is_dir():
            raise ValueError(f"nothing to resume in {self.out}: run once without --resume")
        if not first and not (self.checkpoints / "settings.json").is_file():
            raise ValueError(
                f"process {self.processes.number} does not see --out {self.out} as the first made "
                "it: choose a folder that all hosts share"
            )
        lock = stack.enter_context(folders.held(self.out, alone=first))
        if self.call.resume or not first:
            try:
                self._take_up(whose)
            except (KeyError, TypeError, AttributeError) as error:
                raise ValueError(
                    f"{self.out / 'results.json'} is not as it was written ({error!r}): restore it"
                ) from None
        else:
            folders.claim(self.out, whose, self.call.fresh)
        if first:
            self.checkpoints.mkdir(exist_ok=True)
            storage.write_json(self.checkpoints / "settings.json", self.identity() | self.made)
            progress.gather([self.out], self.out)
            if self.processes.of > 1:
                folders.share(lock)

    def run(self) -> int:
        """Plays, reports, returns `main`'s exit code; `InputError` where a user can mend it."""
        code, first = 0, self.processes.first
        engine = work.Engine(keep=self.call.keep_runs, interrupted=self.processes.interrupted)
        self.processes.tell = self._stopped
        try:
            with _deferred_interrupt(engine):
                if first:
                    self._measure()
                self._play(engine, self.arms)
            if first:
                folders.clear(self.checkpoints)
        except jax.errors.JaxRuntimeError as error:
            if "RESOURCE_EXHAUSTED" not in str(error):
                raise
            raise InputError("out of memory: lower --block, --seeds or --episodes") from None
        except KeyboardInterrupt:
            code = 1 if self.processes.lost else 130
            if first and not self.processes.lost:
                self._stopped("Interrupted")
        if first and (self.curves or self.measured):
            try:
                with cli.receiving(dict.fromkeys(cli.ENDS, signal.default_int_handler)):
                    self._report()
            except KeyboardInterrupt:
                code = 130
                self.console.print("Interrupted. The same command with --resume makes the report.")
            except OSError as error:
                raise storage.unwritten(self.out, error) from None
        return code

    def _stopped(self, why: str) -> None:
        self.console.print(
            f"{why}. What is finished is in {self.out}; the same command with --resume goes on."
        )

    @property
    def checkpoints(self) -> Path:
        """Where they lie until all is finished."""
        return self.out / folders.CHECKPOINTS

    @property
    def seeds(self) -> list[int]:
        """The global numbers of the runs that are played."""
        number, of = self.call.shards
        return list(range(number - 1, self.options.seeds, of))

    def _play(self, engine: work.Engine, arms: Mapping[str, work.Arm]) -> None:
        """Plays the entries that are not finished: those of one arm that are one work together, as
        one axis of runs, which several processes share.
        """
        together: dict[Any, list[Entry]] = {}
        for entry in self.entries:
            if entry.name not in self.curves:
                arm = arms[entry.name]
                program = arm.work, jax.tree.structure(arm.hparams)
                together.setdefault((entry.arm, program), []).append(entry)
        counts = Counter(arm for arm, _ in together)
        groups = {_group_name(group, counts): group for group in together.values()}
        works, stores, totals, told = {}, {}, {}, {}
        for name, group in groups.items():
            played = [arms[entry.name] for entry in group]
            runs = work.runs_of(played, self.seeds, self.options.seed)
            rows = self.processes.rows(len(runs.seed), played[0].work.block)
            folder = self.checkpoints / _identifier(group, runs)
            if rows:
                works[name] = played[0].work, runs.only(rows)
                stores[name] = Store(folder, self.console.print)
                totals[name] = int(works[name][1].units.max()), len(rows)
                told[name] = self._told(group, rows)
        names = [*works]
        at_once, over = min(storage.cores(), COMPILED), self._over()
        console = self.console if self.processes.first else Console(quiet=True)
        with progress.Bars(console, totals) as bars:
            for ahead in (names[at : at + at_once] for at in range(0, len(names), at_once)):
                for name in ahead:
                    bars.tell(name, "compiling", 0, 0)
                engine.prepare(dict(works[name] for name in ahead))
                self.share()  # before hours of playing, for others that start
                for name in ahead:
                    bars.tell(name, "waiting", 0, 0)
                for name in ahead:
                    say = partial(bars.tell, name)
                    with ExitStack() as stack:
                        for run in told[name]:
                            stack.callback(run.close)
                        done = engine.play(*works[name], over, stores[name], say, told[name])
                    lengths = [len(run.get("real_return", ())) for run in done.curves]
                    bars.tell(name, "done", max(lengths) or totals[name][0], len(lengths))
                    self.timing[name] = done.seconds._asdict()
                    self.share()
                    if self.processes.of == 1:
                        self._keep(groups[name], done.curves)
        self.processes.leave()
        if self.processes.of > 1 and self.processes.first:
            for name, group in groups.items():
                self._keep(group, stores[name].gathered(len(group) * len(self.seeds)))

    def _told(self, group: Sequence[Entry], rows: Sequence[int]) -> list[progress.Log]:
        """The logs of some runs of a group."""
        runs = [(entry, seed) for entry in group for seed in self.seeds]
        return [
            progress.Log(self.out / progress.LOG, entry.name, seed, entry.options, self.trackers,
                     self.logged.get((entry.name, seed), 0))
            for entry, seed in (runs[row] for row in rows)
        ]  # fmt: skip

    def _keep(self, group: Sequence[Entry], curves: Sequence[work.Curves]) -> None:
        """Takes up and writes what has been played of entries, run by run."""
        each = len(self.seeds)
        for number, entry in enumerate(group):
            own = zip(self.seeds, curves[number * each :], strict=False)
            rest = [trained.write(self.out, entry.name, seed, run) for seed, run in own]
            self.curves[entry.name] = work.joined(rest)
        self._write()

    def _over(self) -> work.Over | None:
        """When a run is over: so many episodes after it has solved."""
        solves, stop = self.experiment.rule(self.options), self.options.stop_after_solved
        if solves is None or stop is None:
            return None

        def over(curves: work.Curves) -> np.ndarray:
            played = curves["real_return"].shape[1]
            return played >= episodes_to_solve(solves.score(curves), solves) + stop

        return over

    def _measure(self) -> None:
        """What the host measures, unless an earlier run has it."""
        for name, measure in self.experiment.measures.items():
            if name not in self.measured:
                began = time.perf_counter()
                found = measure(self.options, self.console.print)
                self.timing[name] = {"measure_s": time.perf_counter() - began}
                self.measured[name] = json.loads(json.dumps(found))
                self._write()

    def identity(self) -> Results:
        """What a run must have in common with the one that it resumes, or else is another one."""
        return identity_of({
            "experiment": self.family, "part": self.experiment.name,
            "sweep": fields.plain(dict(self.sweep)), "runs": {"shard": list(self.call.shards)},
            "config": fields.plain(self.options)})  # fmt: skip

    def _take_up(self, whose: Mapping[str, str]) -> None:
        """Reads what an earlier run of these settings finished; `ValueError` without one."""
        begun = storage.read_json(self.checkpoints / "settings.json")
        results = storage.read_json(self.out / "results.json")
        if not all(folders.is_of(about, whose) for about in (begun, results) if about is not None):
            raise ValueError(f"--out {self.out} has files of no such run: choose its own folder")
        finished, now = results and identity_of(results), self.identity()
        stores = [*map(Store, {path.parent for path in checkpoints_below(self.checkpoints)})]
        before = begun or finished
        if before is None and stores:
            raise ValueError(
                f"{self.checkpoints / 'settings.json'} is gone: restore it, or remove that folder"
            )
        if before is None:
            raise ValueError(f"nothing to resume in {self.out}: run once without --resume")
        if flags := flags_between(before, now):
            raise ValueError(
                f"the run in {self.out} had other settings for {flags}: resume with the same, or "
                "choose another --out"
            )
        begun_with = {name: (begun or {}).get(name) for name in self.made}
        if (stores or not self.processes.first) and begun_with != self.made:
            raise ValueError(
                f"the run in {self.out} was begun with {storage.changes(begun_with, self.made)}: a "
                "run of both would be neither; go on with what it was begun with, or begin anew "
                "with --fresh"
            )
        if self.processes.first:  # which tells how long all took
            self.earlier_s = sum(store.seconds() for store in stores)
        if not finished or different(finished["config"], now["config"]):
            return
        self.earlier = results
        self.timing = results["timing"]["arms"]
        self.earlier_s += sum(one.get("compile_s", 0.0) for one in self.timing.values())
        self.earlier_s = max(self.earlier_s, results["timing"]["total_s"])
        self.measured = {one: results[one] for one in self.experiment.measures if one in results}
        if results["command"] != self.command:
            self.command = f"{results['command']} && {self.command} --resume"
        self.curves = storage.read_curves(self.out / "curves.npz", storage.identity(results))
        then = {name: results.get(name) for name in ("versions", "commit", "source")}
        self.others = results.get("made_otherwise", {})
        if then["source"] != self.made["source"] or then["versions"] != self.made["versions"]:
            self.others = dict.fromkeys(self.curves, then) | self.others

    def _write(self) -> None:
        ordered = [entry.name for entry in self.entries]
        names = [name for name in (*ordered, *self.curves) if name in self.curves]
        self.curves = {name: self.curves[name] for name in dict.fromkeys(names)}
        timing = {"arms": self.timing, "total_s": self.earlier_s + time.perf_counter() - self.began}
        if self.processes.of > 1:
            timing["shards"] = self.processes.of
        made, others = storage.provenance(self.made, self.earlier), self.others
        done = self.curves.keys() | self.measured.keys()
        if self.earlier and done <= self.earlier["arms"].keys() | self.earlier.keys():
            made = {name: self.earlier.get(name) for name in made}  # drawn anew, not played
            others = self.earlier.get("made_otherwise", {})
        runs = {"seeds": self.seeds, "of": self.options.seeds, "shard": list(self.call.shards),
                "block": self.options.block}  # fmt: skip
        about = {
            "experiment": self.family, "part": self.experiment.name, "command": self.command,
            **home_of(self.part), **made, "runs": runs,
            "sweep": fields.plain(dict(self.sweep)), "timing": timing, **self.measured}  # fmt: skip
        if others:
            about["made_otherwise"] = others
        if missing := [name for name in ordered if name not in self.curves]:
            about["unfinished"] = missing
        self.results = results_of(self.experiment, self.options, self.every, self.curves, about)
        storage.write_json(self.out / "results.json", self.results)
        whose = storage.identity(self.results)  # the curves come last: they tell what is done
        storage.write_curves(self.out / "curves.npz", self.curves, whose)

    def _report(self) -> None:
        self._write()
        if self.call.film and "unfinished" not in self.results:
            try:
                load(self.out, self.part).film()
            except ValueError as error:
                self.console.print(f"There is no film: {error}", markup=False)
        record = Record(self.options, self.results, self.curves, self.out)
        text = write_report(self.experiment, record)
        self.console.print(cli.spoken(text))
        seconds = f"{self.results['timing']['total_s']:.0f} s in all"
        self.console.print(f"Report: {self.out / 'report.md'}, report.html ({seconds})")


def identity_of(results: Results) -> Results:
    """A finished run's `Session.identity`, out of its ``results.json``."""
    return {
        **{name: results.get(name) for name in ("experiment", "part", "sweep")},
        "shard": results.get("runs", {}).get("shard"),
        "config": {k: v for k, v in results["config"].items() if k not in NOT_SETTINGS},
    }


def flags_between(before: Results, now: Results) -> str:
    """The flags in which two runs differ by their `Session.identity`; empty where in none."""
    differ = [name for name in now if name != "config" and before.get(name) != now[name]]
    differ += different(before["config"], now["config"])
    return ", ".join(f"--{name.replace('_', '-')}" for name in differ)


def _group_name(group: Sequence[Entry], counts: Mapping[str, int]) -> str:
    """What entries that are played together are called, when so many groups are of each arm."""
    first = group[0]
    if len(group) == 1:
        return first.name
    return first.arm if counts[first.arm] == 1 else f"{first.name} and {len(group) - 1} more"


def _identifier(group: Sequence[Entry], runs: work.Runs) -> str:
    """A folder's name for the checkpoints of just these runs."""
    names = [entry.name for entry in group]
    arrays = [names, *jax.tree.leaves((runs.seed, runs.hparams, runs.units))]
    digest = zlib.crc32(b"".join(np.ascontiguousarray(leaf).tobytes() for leaf in arrays))
    safe = "".join(letter if letter.isalnum() or letter in "-_" else "_" for letter in group[0].arm)
    return f"{safe}-{digest:08x}"


@contextmanager
def _deferred_interrupt(engine: work.Engine) -> Iterator[None]:
    """Ctrl-C and SIGTERM let the pieces in progress end and be saved; a second one interrupts at
    once. Outside the main thread they do nothing.
    """

    def receive(signum: int, frame: Any) -> None:
        if engine.interrupted.is_set():
            raise KeyboardInterrupt
        engine.interrupted.set()

    with cli.receiving(dict.fromkeys(cli.ENDS, receive)):
        yield
    if engine.interrupted.is_set():
        raise work.Interrupted
