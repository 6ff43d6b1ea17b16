"""Command lines derived from dataclasses, with errors of one line."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import math
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import jax
import tyro

from jaxdyna.experiments.report import cores

Options = TypeVar("Options")


def parse(
    presets: dict[str, Options], argv: Sequence[str] | None, prog: str, *, spread: bool = True
) -> Options:
    """Reads the command line; ``--preset`` chooses where all other options start from.

    Args:
        presets: options by the name of their preset, the default one first.
        argv: the arguments, by default the process's.
        prog: the command as the user types it.
        spread: make every core a device (`use_every_core`).

    Raises:
        SystemExit: with code 2 and one line on bad input, with 0 after ``--help``.
    """
    if spread:
        use_every_core()
    argv = list(sys.argv[1:] if argv is None else argv)
    default = presets.get(_preset_name(argv), next(iter(presets.values())))
    kind: Any = type(default)
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(
                kind, default=default, args=argv, prog=prog, config=(tyro.conf.SuppressFixed,)
            )
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        fail(_one_line(complaint.getvalue()), prog)
    except (ValueError, TypeError) as error:
        fail(str(error), prog)


def use_every_core() -> None:
    """Makes each CPU core a device of its own, among which `jaxdyna.sweep` deals out the seeds.
    Without effect once JAX is in use, and on a machine with an accelerator.
    """
    with contextlib.suppress(RuntimeError):
        jax.config.update("jax_num_cpu_devices", cores())


def fail(message: str, prog: str) -> NoReturn:
    """Ends the process with code 2 and one line."""
    print(f"{prog}: error: {message}", file=sys.stderr)
    raise SystemExit(2)


def check_common(options: Any) -> None:
    """Checks the options that every experiment has.

    Raises:
        ValueError: with what to change.
    """
    for name in ("seeds", "episodes"):
        if getattr(options, name, 1) < 1:
            raise ValueError(f"--{name} is {getattr(options, name)}: it must be at least 1")
    if not 0 <= options.seed < 2**32:
        raise ValueError(f"--seed is {options.seed}: it must lie between 0 and 2^32 - 1")
    stop = getattr(options, "stop_after_solved", None)
    if stop is not None and stop < 0:
        raise ValueError("--stop-after-solved is negative: give 0 or more, or None")


def check_numbers(settings: Any, flag: str, may_be_infinite: Sequence[str] = ()) -> None:
    """Checks that every number in nested dataclasses is finite.

    Args:
        settings: a dataclass.
        flag: how the command line names it, such as ``--hparams``.
        may_be_infinite: names of fields that only must not be NaN.

    Raises:
        ValueError: with what to change.
    """
    for item in dataclasses.fields(settings):
        value, name = getattr(settings, item.name), f"{flag}.{item.name.replace('_', '-')}"
        if dataclasses.is_dataclass(value):
            check_numbers(value, name, may_be_infinite)
        elif isinstance(value, float) and not math.isfinite(value):
            if not math.isnan(value) and item.name in may_be_infinite:
                continue
            raise ValueError(f"{name} is {value}: it must be a finite number")


def check_writable(directory: Path) -> None:
    """Makes the folder and tries it, before an hour's work is lost for want of it.

    Raises:
        ValueError: where it cannot be written to.
    """
    probe = directory / f".probe-{os.getpid()}"
    try:
        directory.mkdir(parents=True, exist_ok=True)
        probe.write_bytes(b"")
        probe.unlink()
    except OSError as error:
        raise ValueError(
            f"cannot write to --out {directory} ({error.strerror}): choose another folder"
        ) from None


def _preset_name(argv: list[str]) -> str:
    for position, argument in enumerate(argv):
        if argument == "--preset" and position + 1 < len(argv):
            return argv[position + 1]
        if argument.startswith("--preset="):
            return argument.removeprefix("--preset=")
    return ""


def _one_line(panel: str) -> str:
    """The message inside a framed panel, up to its first rule."""
    inside: list[str] = []
    for line in panel.splitlines():
        text = line.strip("│╭╮╰╯─ ")
        if set(line) <= set("│─ ") and inside:
            break
        if line.startswith("│") and text:
            inside.append(text)
    return " ".join(inside) or " ".join(panel.split())
