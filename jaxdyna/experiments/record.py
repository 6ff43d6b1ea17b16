"""``python -m jaxdyna.experiments.record [NAME...]``: what the lab book has to hold, what of it is
stale, and how it is recorded anew.

The lab book is a folder: ``records.toml`` says what each record asks and which command answers it,
``seeds.toml`` which base seeds were looked at, ``primary.toml`` which comparisons were decided on
before they were made. A record is the folder of its name.
"""

import shlex
import subprocess
import sys
import tomllib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Self

import tyro
from rich.console import Console
from rich.table import Table

from jaxdyna import fields
from jaxdyna.experiments.engine import Record, Results, cli, folders, storage
from jaxdyna.experiments.engine.experiment import chosen
from jaxdyna.experiments.engine.loaded import load
from jaxdyna.experiments.engine.record import command_of, recorded, results_of, write_report
from jaxdyna.experiments.engine.session import Session, flags_between, identity_of, prepared
from jaxdyna.experiments.report.summaries import restricted
from jaxdyna.experiments.report.tables import figure_at, interval, markdown_table, number, spoken
from jaxdyna.fields import setting
from jaxdyna.statistics import holm, ratio_of_means

PACKAGE = "jaxdyna.experiments"
PROG = f"python -m {PACKAGE}.record"
BOOK = storage.PACKAGE.parent / "experiments"
TABLES = ("records.toml", "seeds.toml", "primary.toml")
MISSING, OLDER, UNFINISHED = "not recorded yet", "older format", "unfinished"
OTHER_CODE = "other code or versions"
INTERRUPTED = (130, 143)


@dataclass(frozen=True)
class Call:
    """Lists the records of the lab book, or makes those that are named."""

    names: tyro.conf.Positional[tuple[str, ...]] = setting((), "records; none: all are listed")
    list: bool = setting(False, "list them, play nothing")
    redraw: bool = setting(False, "draw reports anew, play nothing; without names all")
    primary: bool = setting(False, "show the primary comparisons")
    shard: str | None = setting(None, "I/N: play the I-th of N parts; the last one merges")
    fresh: bool = setting(False, "drop unfinished work instead of going on with it")
    unclean: bool = setting(False, "record from a work tree with changes, too")
    book: Path = setting(BOOK, "the lab book")
    out: Path | None = setting(None, "where the records' folders are; without, in the lab book")

    @property
    def part(self) -> tuple[int, int]:
        """``(I, N)`` of ``--shard``."""
        return cli.Call(shard=self.shard).shards

    @property
    def folder(self) -> Path:
        """Where the records' folders are, from here where they are below."""
        folder = (self.out or self.book).resolve()
        below = folder.is_relative_to(Path.cwd())
        return folder.relative_to(Path.cwd()) if below else folder


@dataclass(frozen=True)
class Plan:
    """A record as the lab book has it."""

    name: str  #: of its folder
    asks: str  #: its question
    command: str  #: module and flags, as after ``python -m jaxdyna.experiments.``
    hours: float | None = None  #: what it costs, where no record says so yet
    #: names of records above it beside which it is read: where one of these is stale, so is this
    builds_on: Sequence[str] = ()
    needs: str = ""  #: a module of an extra, without which its world is not there

    @property
    def playable(self) -> bool:
        """Whether what it needs is installed."""
        return not self.needs or find_spec(self.needs) is not None

    @cached_property
    def session(self) -> Session:
        """What its command comes to today."""
        return self.shard(1, 1)

    def shard(self, number: int, of: int) -> Session:
        """What the command of a part of it comes to; `ValueError` where it is none today."""
        module, *flags = shlex.split(self.command)
        try:
            parts, flags, prog = command_of(f"{PACKAGE}.{module}", *flags)
        except ImportError:
            parts = ()
        if not parts:
            said = f"python -m {PACKAGE}.{module}"
            raise ValueError(f"{self.name}: there is no such experiment: {said}")
        try:
            return prepared(parts, [*flags, "--shard", f"{number}/{of}"], prog)
        except ValueError as error:
            raise ValueError(f"{self.name}: {error}") from None


class State:
    """A record, or a shard of one, beside what it is to be.

    Attributes:
        results: its ``results.json``, None without.
        begun: whether there is unfinished work.
        stale: what is not as the lab book and today's settings have it, in words.
        other_code: whether code or versions were others, which may move no more than roundings.
    """

    def __init__(self, folder: Path, session: Session):
        self.results = storage.read_json(folder / "results.json")
        self.begun = (folder / folders.CHECKPOINTS).exists()
        self.stale = [UNFINISHED] if self.begun else self._differs(session)
        self.other_code = not self.stale and self._made_otherwise()

    def _differs(self, session: Session) -> list[str]:
        if self.results is None:
            return [MISSING]
        if "part" not in self.results:
            return [OLDER]
        try:
            recorded(self.results)
        except ValueError as error:
            return [f"other settings ({error})"]
        flags = [flags_between(identity_of(self.results), session.identity())]
        names = {entry.name for entry in chosen(session.every, session.options.arms)}
        flags += ["--arms"] if names != self.results["arms"].keys() else []
        said = ", ".join(filter(None, flags))
        return [f"other settings ({said})"] if said else []

    def _made_otherwise(self) -> bool:
        made, results = storage.made_with(()), self.results or {}
        then = [results[name] != made[name] for name in ("source", "versions")]
        return any(then) or "made_otherwise" in results

    @classmethod
    def of(cls, plan: Plan, plans: Mapping[str, Plan], folder: Path) -> Self:
        """A whole record's, and what of those that it builds on is stale."""
        state = cls(folder / plan.name, plan.session)
        below = [name for name in plan.builds_on if cls.of(plans[name], plans, folder).stale]
        if not state.stale and below:
            state.stale = [f"builds on {', '.join(below)}"]
        return state

    def __str__(self) -> str:
        return ", ".join(self.stale + [OTHER_CODE] * self.other_code) or "as today"


FLAGS = [f"\n  --{leaf.path}: {leaf.help}" for leaf in fields.leaves(Call())][1:]


@cli.command(Call, PROG, "[NAME...]", "\n" + "".join(FLAGS), bare=True)
def main(call: Call, argv: Sequence[str]) -> int:
    """Lists, records, redraws or compares, and returns the exit code; `ValueError` if it cannot."""
    plans, _ = read_plans(call.book), call.part
    if unknown := [name for name in call.names if name not in plans]:
        raise ValueError(f"{unknown[0]}: no such record; there are {', '.join(plans)}")
    asked = {name: plan for name, plan in plans.items() if name in call.names} or plans
    for name in [name for name, plan in asked.items() if not plan.playable]:
        if name in call.names:
            raise ValueError(f"{name} needs {plans[name].needs}: install it")
        print(f"{name} is left out: {plans[name].needs} is not installed")
        asked = {other: plan for other, plan in asked.items() if other != name}
    if call.primary:
        print(primary(call.book, call.folder))
    elif call.redraw:
        redraw(asked, call.folder)
    elif call.list or not call.names:
        listed(asked, plans, call.folder)
    else:
        return record(asked.values(), call, [word for word in argv if word != "--fresh"])
    return 0


def read_plans(book: Path) -> dict[str, Plan]:
    """The records of the lab book, by name; `ValueError` without a lab book, or where what it says
    of a record is none.
    """
    try:
        plans = {name: Plan(name, **said) for name, said in _table(book, "records").items()}
    except TypeError as error:
        raise ValueError(f"{book / 'records.toml'}: {error}") from None
    above: set[str] = set()
    for plan in plans.values():
        if lacking := sorted(set(plan.builds_on) - above):
            raise ValueError(f"{plan.name} builds on {', '.join(lacking)}: no record above it")
        above.add(plan.name)
    return plans


def _table(book: Path, name: str) -> Any:
    path = book / f"{name}.toml"
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, tomllib.TOMLDecodeError) as error:
        raise ValueError(f"{path} is no table of a lab book ({error})") from None


def listed(asked: Mapping[str, Plan], plans: Mapping[str, Plan], folder: Path) -> None:
    """Prints each record's base seed, hours, commit and day, whether it is stale, and question."""
    table = Table("record", "seed", "hours", "recorded", "state", "asks", box=None)
    for name, plan in asked.items():
        state = State.of(plan, plans, folder)
        table.add_row(
            name, str(plan.session.options.seed), number(cost(plan, state.results), 2),
            _where(folder / name, state.results), str(state), plan.asks)  # fmt: skip
    Console(highlight=False, width=None if sys.stdout.isatty() else 160).print(table)


def _where(folder: Path, results: Results | None) -> str:
    """The commit that played it and the day that put it here; where it does not say, by which."""
    commit = (results or {}).get("commit")
    asked = "log", "-1", "--format=%h %as", "--", f"{folder.name}/results.json"
    put, _, day = (storage.git(folder.parent, *asked) or "").partition(" ")
    ran = f"{commit['id'][:7]}{'' if commit['clean'] else ' with changes'}" if commit else put
    return f"{ran} {day}".strip() or "-"


def cost(plan: Plan, results: Results | None) -> float | None:
    """Hours that its record took, or is guessed to take."""
    seconds = (results or {}).get("timing", {}).get("total_s")
    return plan.hours if seconds is None else seconds / 3600


def record(plans: Collection[Plan], call: Call, argv: Sequence[str]) -> int:
    """Makes records one after the other, each by its own command, and returns the exit code: that
    of the last that failed; an interruption ends them all. `ValueError` where what is recorded
    could not be named by a commit, or would confirm nothing.
    """
    commit = storage.commit()
    changed = storage.git(call.book, "status", "--porcelain", "--", *TABLES)
    if not call.unclean and (not commit or not commit["clean"] or changed):
        raise ValueError("code or lab book have changes that no commit names: commit them, or add "
                         "--unclean")  # fmt: skip
    for plan in plans:
        check_seed(plan, call.book)
    worst = 0
    for plan in plans:
        code = _made(plan, call)
        if code in INTERRUPTED:
            print(f"{plan.name} was interrupted: `{PROG} {shlex.join(argv)}` goes on with it.")
            return code
        if code:
            print(f"{plan.name} ended with code {code}: mend that, and call it again.")
        worst = code or worst
    return worst


def check_seed(plan: Plan, book: Path) -> None:
    """Raises ValueError where a record is to confirm what its base seed was looked at for; those
    that build on it came after.
    """
    later = {other.name for other in read_plans(book).values() if plan.name in other.builds_on}
    primary = {said["record"] for said in _table(book, "primary")["comparisons"]}
    for said in _table(book, "seeds")["seeds"]:
        seen = said["looked_at"] and said["by"] not in later | {plan.name}
        if plan.name in primary and seen and said["seed"] == plan.session.options.seed:
            raise ValueError(
                f"{plan.name} is a primary comparison's, and its base seed {said['seed']} was "
                f"looked at by {said['by']} on {said['date']}: give it one that is held out"
            )


def _made(plan: Plan, call: Call) -> int:
    """Plays what is not as it should be, merges what is whole, and returns the exit code."""
    one, of = call.part
    module, *flags = shlex.split(plan.command)
    folder = call.folder / plan.name
    parts = {each: folder / folders.PARTS / f"{each}-of-{of}" for each in range(1, of + 1)}
    where, session = (parts[one], plan.shard(one, of)) if of > 1 else (folder, plan.session)
    state = State(where, session)
    if state.stale or state.other_code:
        flags += ["--shard", f"{one}/{of}"] if of > 1 else []
        flags += [("--fresh" if call.fresh else "--resume")] if state.begun else []
        if code := _run(module, *flags, "--keep-runs", "0", "--out", str(where)):
            return code
    else:
        print(f"{where}: {state}, nothing to play")
    if of == 1:
        return 0
    waiting = [each for each, part in parts.items() if State(part, plan.shard(each, of)).stale]
    if waiting:
        print(f"{plan.name}: {len(waiting)} of {of} shards are still to be played.")
        return 0
    whole = State(folder, plan.session)
    if whole.stale or whole.other_code:
        return _run("merge", *map(str, parts.values()), "--out", str(folder))
    return 0


def _run(module: str, *flags: str) -> int:
    """Runs a command in a process of its own, so that it takes no more memory, and says no other
    thing of itself, than where it is typed; Ctrl-C and SIGTERM go to it, once each.
    """
    words = [sys.executable, "-m", f"{PACKAGE}.{module}", *flags]
    print(f"$ python {shlex.join(words[1:])}", flush=True)
    with (
        subprocess.Popen(words, start_new_session=True) as child,
        cli.receiving(dict.fromkeys(cli.ENDS, lambda sent, _: child.send_signal(sent))),
    ):
        code = child.wait()
    return code if code >= 0 else 128 - code


def redraw(plans: Mapping[str, Plan], folder: Path) -> None:
    """Writes results, reports, figures anew from curves of records whose settings are today's."""
    for name, plan in plans.items():
        state, out = State(folder / name, plan.session), folder / name
        if state.results is None or state.stale:
            print(f"{name}: not drawn ({state})")
            continue
        left = load(out)
        every, about = [*left.entries.values()], left.results
        with folders.held(out):
            results = results_of(left.experiment, left.options, every, left.curves, about)
            storage.write_json(out / "results.json", results)
            now = storage.identity(results)
            if now != storage.identity(about):  # settings that there were not then
                storage.write_curves(out / "curves.npz", left.curves, now)
            write_report(left.experiment, Record(left.options, results, left.curves, out))
        print(f"{name}: drawn")


def primary(book: Path, folder: Path) -> str:
    """The primary comparisons as a table: those that are recorded as they were planned with ratio,
    95% interval, p and Holm's p of them all, where those that are not count as p = 1.
    """
    said = _table(book, "primary")
    found = [_compared(one, folder) for one in said["comparisons"]]
    adjusted = holm([1.0 if ratio is None or ratio["p"] is None else ratio["p"] for ratio in found])
    rows = []
    for one, ratio, p in zip(said["comparisons"], found, adjusted, strict=True):
        what = f"{spoken(one['measure'])}, B = {one['budget']:,} episodes"
        told = [MISSING, "-", "-"] if ratio is None else [
            f"{number(ratio['ratio'], 2)} ({interval(ratio['ci95'], 2)})", number(ratio["p"], 4),
            number(p, 4)]  # fmt: skip
        arms = f"{' : '.join(one['arms'])}, n = {one['runs']}"
        rows.append([one["record"], arms, what, *told])
    header = ["record", "arms", "measure", "ratio (95% interval)", "p", "Holm's p"]
    return f"{markdown_table(header, rows)}\n{said['test']}"


def _compared(said: Mapping[str, Any], folder: Path) -> Results | None:
    """One comparison's `statistics.ratio_of_means`, as the table says, however many solve; None
    where it is not recorded as planned.
    """
    results = storage.read_json(folder / said["record"] / "results.json") or {}
    arms, runs = results.get("arms", {}), results.get("runs", {})
    if "unfinished" in results or not set(said["arms"]) <= arms.keys() or "of" not in runs:
        return None
    config = results["config"]
    planned = (said["seed"], said["budget"], list(range(said["runs"])))
    if (config["seed"], config["episodes"], runs["seeds"]) != planned:
        return None
    one, other = (restricted(figure_at(arms[name], said["measure"])) for name in said["arms"])
    return ratio_of_means(one, other)


if __name__ == "__main__":
    sys.exit(main())
