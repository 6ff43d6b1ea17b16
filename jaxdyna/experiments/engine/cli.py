"""Command lines derived from declared settings, with errors of one line."""

import ast
import contextlib
import dataclasses
import io
import os
import re
import select
import shlex
import shutil
import signal
import sys
import textwrap
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial, wraps
from pathlib import Path
from typing import Annotated, Any, NoReturn, TypeVar, get_args

import tyro
from rich.markdown import Markdown

from jaxdyna import fields
from jaxdyna.experiments.engine import storage
from jaxdyna.experiments.engine.experiment import Experiment, Options
from jaxdyna.experiments.engine.progress import TRACKERS
from jaxdyna.fields import Leaf, SettingError, setting

O = TypeVar("O")  # noqa: E741


@dataclasses.dataclass(frozen=True)
class Call:
    """What a command line says beside an experiment's settings."""

    part: str | None = setting(None, "which part of the experiment")
    preset: str | None = setting(None, "whose settings are the defaults")
    quick: bool = setting(False, "a look at everything in minutes")
    out: Path | None = setting(None, "folder for the results")
    resume: bool = setting(False, "go on with the run in that folder, bit for bit")
    fresh: bool = setting(False, "begin anew where that folder has the unfinished work of a run")
    sweep: tyro.conf.UseAppendAction[tuple[str, ...]] = setting(
        (), "FIELD=V,V,...: each arm with each value of a setting; several make a grid"
    )
    from_: Annotated[Path | None, tyro.conf.arg(name="from")] = setting(
        None, "a results.json: all settings as there, but for those that are given"
    )
    cache: bool = setting(
        True,
        "keep compiled programs in the user's cache folder and use what is there; "
        "--no-cache: neither",
    )
    keep_runs: int = setting(
        10, "runs of each arm, the first ones, whose policy and model are kept for jaxdyna.load; "
        "0: none", at_least=0)  # fmt: skip
    film: bool = setting(False, "shows in the report an episode of what each arm has learned")
    log: tuple[str, ...] = setting(
        (), "who beside log.jsonl is told how each arm's first ten runs do", choices=[*TRACKERS]
    )
    shard: str | None = setting(
        None, "I/N: the I-th of N equal parts of the runs; `merge` puts them together"
    )
    distributed: str | None = setting(
        None,
        "one of several processes that share the runs and the folder, as Slurm, Kubernetes, Open "
        "MPI or a TPU pod says; HOST:PORT,I/N: the I-th of N, the first at that address",
    )

    @property
    def shards(self) -> tuple[int, int]:
        """``(I, N)``; `ValueError` where it is not of that form."""
        number, _, of = (self.shard or "1/1").partition("/")
        if not (number.isdecimal() and of.isdecimal() and 1 <= int(number) <= int(of)):
            raise ValueError(f"--shard is {self.shard}: give I/N with I from 1 to N")
        return int(number), int(of)


ENDS = signal.SIGINT, signal.SIGTERM
STDOUT = 1  #: its file descriptor
NOT_SWEPT = {leaf.path.rstrip("_") for kind in (Call, Options) for leaf in fields.leaves(kind())}


def read(kind: type[O], argv: Sequence[str], prog: str, **how: Any) -> Any:
    """What words say of a dataclass's fields, ``how`` being `tyro.cli`'s; `ValueError` if bad."""
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(kind, args=list(argv), prog=prog, **how)
    except TypeError as error:
        raise ValueError(str(error)) from None
    except SystemExit as stop:
        cause: BaseException | None = stop
        while cause is not None and not isinstance(cause, SettingError):
            cause = cause.__context__  # tyro puts it in a panel, by the name of its field alone
        raise cause or ValueError(_one_line(complaint.getvalue())) from None


def earlier(path: Path) -> storage.Results:
    """What ``--from`` names: a results.json, or the folder of one; `ValueError` without one."""
    results = storage.read_json(path / "results.json" if path.is_dir() else path)
    if results is None:
        raise ValueError(
            f"--from {path}: there is no result: name a results.json, or a folder that has one"
        )
    return results


def parse(default: O, argv: Sequence[str], prog: str) -> O:
    """An experiment's settings, flags by dotted path, others as in ``default``: see `read`."""
    kind: Any = type(default)
    known = {leaf.path: leaf for leaf in _shown(default)}
    rest, chosen, words = [], {}, iter(argv)
    for word in words:
        flag, _, value = word.partition("=")
        typed, path = word.startswith("--"), _path(word)
        if typed and path in kind.decided:
            raise ValueError(f"{flag} is decided by {kind.decided[path]}: leave it out")
        if typed and not {path, re.sub(r"(^|\.)no_", r"\1", path)} & known.keys():
            try:
                fields.value_at(default, path)
            except SettingError as error:  # names the closest
                raise ValueError(f"{flag} {error.said.replace('_', '-')}") from None
            raise ValueError(f"{flag} is several settings: name one of them")
        if typed and path in known and callable(known[path].value):  # tyro has no flag for it
            chosen[path] = value or next(words, "")
        else:
            rest.append(word)
    default = fields.restored(default, chosen)
    return read(kind, rest, prog, default=default, config=(tyro.conf.SuppressFixed,))


def swept(options: Any, said: Sequence[str]) -> dict[str, list[Any]]:
    """Values by dotted path, from ``FIELD=V,V,...`` of each ``--sweep``; `ValueError` on others."""
    grid: dict[str, list[Any]] = {}
    known = {leaf.path: leaf for leaf in fields.leaves(options)}
    for one in said:
        name, equals, values = one.partition("=")
        path = _path(name)
        if not (name and equals and values):
            raise ValueError(f"--sweep {one}: give it as FIELD=V,V,...")
        if path in NOT_SWEPT:
            raise ValueError(f"--sweep {path} makes no sense: every run has the same")
        if path in options.decided:
            raise ValueError(f"--sweep {path}: it is decided by {options.decided[path]}")
        if path not in known:
            fields.value_at(options, path)  # names the closest
            raise ValueError(f"--sweep {path}: name one setting of it")
        if path in grid:
            raise ValueError(f"--sweep {path} twice: give all its values at once")
        grid[path] = [_value(options, known[path], text) for text in values.split(",")]
        if len(set(grid[path])) < len(grid[path]):
            raise ValueError(f"--sweep {one}: a value stands there twice")
    return grid


def _value(options: Any, leaf: Leaf, text: str) -> Any:
    """A setting's value as typed; the numbers of a tuple are joined by x."""

    def read(word: str) -> Any:
        try:
            return ast.literal_eval(word)
        except (ValueError, SyntaxError):
            return word

    value = [read(word) for word in text.split("x")] if "tuple" in str(leaf.hint) else read(text)
    return fields.value_at(fields.restored(options, {leaf.path: value}), leaf.path)


def help_text(
    prog: str, parts: Iterable[str], experiment: Experiment, default: Any, everything: bool
) -> str:
    """What ``--help`` shows: the everyday settings; ``--help-all``: every one."""
    width = min(shutil.get_terminal_size((100, 24)).columns, 100)
    arms = [*dict.fromkeys(name.partition("@")[0] for name in experiment.arms(default.resolved()))]
    hidden = () if experiment.quick.get(default.preset) else ("quick",)
    lines = [
        f"usage: {prog} [--part {{{','.join(parts)}}}] "
        f"[--preset {{{','.join(experiment.presets)}}}] [--FLAG VALUE ...]", ""]  # fmt: skip
    lines += textwrap.wrap(" ".join((type(default).__doc__ or "").split("\n\n")[0].split()), width)
    for title, leaves in (("call", list(fields.leaves(Call()))), ("settings", _shown(default))):
        lines += ["", f"{title}:"]
        for leaf in leaves:
            if leaf.path not in hidden and (leaf.everyday or everything or title == "call"):
                words = arms if leaf.path == "arms" else ()
                lines += _flag(leaf, width, words, "" if title == "call" else "None")
    more = "" if everything else "; with all settings"
    return "\n".join([*lines, "  --help, --help-all", f"      this{more}"])


def _shown(default: Any) -> list[Leaf]:
    hidden = (*default.decided, "preset", "quick")
    return [
        leaf
        for leaf in fields.leaves(default)
        if leaf.path not in hidden and not (callable(leaf.value) and not leaf.choices)
    ]


def _flag(leaf: Leaf, width: int, words: Sequence[str], none: str) -> list[str]:
    words = [*words, *leaf.choices, *(one for one in get_args(leaf.hint) if isinstance(one, str))]
    value = fields.plain(leaf.value)
    value = " ".join(shlex.quote(str(one)) for one in value) if isinstance(value, list) else value
    value = none if value is None else value
    value = "" if value is False or value == "" else f"  [{value}]"
    choice = f" {{{','.join(map(shlex.quote, words))}}}" if words else ""
    head = f"--{leaf.path.rstrip('_').replace('_', '-')}{choice}{value}"
    indented = partial(
        textwrap.wrap, width=width, subsequent_indent=" " * 6, break_long_words=False
    )
    return [*indented(head, initial_indent="  ", break_on_hyphens=False),
            *indented(leaf.help, initial_indent=" " * 6)]  # fmt: skip


def spell_out() -> None:
    """What standard output has no sign for, such as ≥ in Latin alphabets, is printed as its code
    instead of ending a finished run.
    """
    if isinstance(sys.stdout, io.TextIOWrapper) and not sys.stdout.encoding.startswith("utf"):
        sys.stdout.reconfigure(errors="backslashreplace")


def spoken(report: str) -> Markdown:
    """A report up to its first figure, for a console; names of what was swept may be broken."""
    return Markdown(re.sub(r"(?<=\w)@(?=\w)", "@ ", report.partition("\n![")[0]))


def command(kind: type[O], prog: str, flags: str, more: str = "", bare: bool = False) -> Any:
    """Makes the ``main`` of a command that is no experiment, from what it does: a function of what
    the arguments, by default the process's, say of the fields of a dataclass, and of these, to the
    exit code. On bad input it is `SystemExit` with code 2 and one line.

    Args:
        kind: the dataclass.
        prog: the command.
        flags: what may follow, for the help.
        more: that is said there.
        bare: whether there is something to do without arguments.
    """

    def made(run: Callable[[O, Sequence[str]], int]) -> Callable[..., int]:
        @wraps(run)
        def main(argv: Sequence[str] | None = None) -> int:
            spell_out()
            argv = sys.argv[1:] if argv is None else argv
            with while_read(), refused(prog, argv):
                if {"-h", "--help"} & set(argv) or not (argv or bare):
                    print(f"usage: {prog} {flags}\n\n{kind.__doc__}{more}")
                    return 0
                code = run(read(kind, argv, prog), argv)
            return code

        return main

    return made


@contextlib.contextmanager
def while_read() -> Iterator[None]:
    """Where nobody reads on what is printed, the process ends silently, with SIGPIPE's code."""
    try:
        try:
            yield
        finally:
            print(end="", flush=True)
    except BrokenPipeError:
        poll = select.poll()
        poll.register(STDOUT, 0)
        if not any(event & (select.POLLERR | select.POLLHUP) for _, event in poll.poll(0)):
            raise  # it was another pipe
        os.dup2(os.open(os.devnull, os.O_WRONLY), STDOUT)
        raise SystemExit(128 + signal.SIGPIPE) from None


@contextlib.contextmanager
def refused(
    prog: str, argv: Sequence[str], kinds: tuple[type[Exception], ...] = (ValueError, ImportError)
) -> Iterator[None]:
    """Bad input, told meanwhile by such an error, ends the process with code 2 and one line."""
    try:
        yield
    except kinds as error:
        if isinstance(error, SettingError):
            fail(f"{flag_of(error, argv)} {error.said}", prog)
        fail(str(error), prog)


@contextlib.contextmanager
def receiving(handlers: Mapping[int, Any]) -> Iterator[None]:
    """Who receives signals meanwhile, by their numbers; nobody else outside the main thread."""
    here = threading.current_thread() is threading.main_thread()
    before = {number: signal.signal(number, one) for number, one in handlers.items() if here}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def fail(message: str, prog: str) -> NoReturn:
    """Ends the process with code 2 and one line."""
    print(f"{prog}: error: {' '.join(message.split())}", file=sys.stderr)
    raise SystemExit(2)


def flag_of(error: SettingError, argv: Sequence[str]) -> str:
    """The flag that was typed for a setting, or else that of its path."""
    for word in argv:
        path = _path(word)
        if word.startswith("--") and (path == error.path or path.endswith(f".{error.path}")):
            return word.partition("=")[0]
    return f"--{error.path.replace('_', '-')}"


def _path(word: str) -> str:
    return word.partition("=")[0].removeprefix("--").replace("-", "_")


def _one_line(panel: str) -> str:
    """The message inside a framed panel, up to its first rule, without a terminal's colours."""
    inside: list[str] = []
    panel = re.sub(r"\x1b\[[0-9;]*m", "", panel)
    for line in panel.splitlines():
        text = line.strip("│╭╮╰╯─ ")
        if set(line) <= set("│─ ") and inside:
            break
        if line.startswith("│") and text:
            inside.append(text)
    return " ".join(inside) or " ".join(panel.split())


def by_name(known: Mapping[str, O], what: str, name: str | None) -> O:
    """What ``--part`` or ``--preset`` names, the first without; `ValueError` where none has it."""
    if name is not None and name not in known:
        raise ValueError(f"--{what} {name}: there is no such {what}; there are {', '.join(known)}")
    return known[name] if name is not None else next(iter(known.values()))
