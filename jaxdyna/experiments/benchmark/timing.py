"""How things are timed: in turns, so that a machine that slows down does so for all, each turn long
enough for the clock; medians count. And what the machine can do at all, beside which times stand.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from functools import cache
from importlib import import_module
from math import ceil
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna.experiments.engine import InputError, Results, programs, storage

OURS, PYTORCH = "jaxdyna", "PyTorch"
EXAMPLES = storage.PACKAGE.parent / "docs" / "examples"
"""Where the rivals are, in a checkout."""
LEAST_S = 0.1
"""Of a turn, at the least."""
UNITS = {"s": 1.0, "ms": 1e3, "GiB": 2.0**-30}
PRODUCTS = {"one of 2048x2048": (1, 2048, 2048), "ten of 64x256 and 256x256": (10, 64, 256)}
"""The yardstick: by its name how many products of how many rows and columns."""
COMMAND = """import json, resource, subprocess, sys, time
began = time.perf_counter()
ran = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
used = resource.getrusage(resource.RUSAGE_CHILDREN)
unit = 1 if sys.platform == "darwin" else 1024
print(json.dumps([time.perf_counter() - began, used.ru_maxrss * unit, ran.returncode, ran.stderr]))
"""
"""Between this process and what is measured: a process begins with the peak of its parent's."""
Work = Callable[[], float]
"""Returns how many units it was, once all of their results are there."""


def in_turns(
    works: Mapping[str, Work | None], rounds: int, least_s: float = LEAST_S,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, np.ndarray]:  # fmt: skip
    """Seconds a unit ``[rounds]`` of each work, by its name; None of one that cannot be had.

    Each is called once before, which does not count, and once to see how many calls make a turn of
    ``least_s`` seconds; where that is 0, a turn is one call.
    """

    def turn(work: Work, calls: int) -> tuple[float, float]:
        began = clock()
        units = sum(work() for _ in range(calls))
        return clock() - began, units

    there = {name: work for name, work in works.items() if work}
    calls = {}
    for name, work in there.items():
        work()
        calls[name] = max(1, ceil(least_s / max(turn(work, 1)[0], 1e-9))) if least_s else 1
    seconds: dict[str, list[float]] = {name: [] for name in there}
    for _ in range(rounds):
        for name, work in there.items():
            took, units = turn(work, calls[name])
            seconds[name].append(took / units)
    return {name: np.array(each) for name, each in seconds.items()}


def compared(
    what: str, unit: str, works: Mapping[str, Work | None], rounds: int, ceiling: float = 0.0
) -> list[Results]:
    """A `row` of the first work beside each of the others, timed `in_turns`."""
    seconds = in_turns(works, rounds)
    ours, *others = works
    return [row(what, unit, seconds[ours], name, seconds.get(name), ceiling) for name in others]


def row(
    what: str, unit: str, ours: Any, whose: str, theirs: Any = None, ceiling: float = 0.0
) -> Results:
    """A line of the table.

    Args:
        what: was measured.
        unit: of the medians that it tells: one of `UNITS`, or so many of something ``/s``.
        ours: seconds a unit, of each turn, or bytes; None where there is nothing of ours.
        whose: what it stands beside.
        theirs: its seconds, of the same turns; None where it cannot be had.
        ceiling: units a second that cannot be exceeded, where that is known.
    """

    def told(taken: Any) -> float | None:
        if taken is None:
            return None
        median = float(np.median(taken))
        return 1 / median if unit.endswith("/s") else median * UNITS[unit]

    found = {"what": what, "unit": unit, "ours": told(ours), "whose": whose, "theirs": told(theirs)}
    if ceiling:
        found["share"] = (told(ours) or 0.0) / ceiling
    if ours is not None and theirs is not None:
        ratio = np.asarray(theirs) / np.asarray(ours)
        found |= {
            "ratio": float(np.median(ratio)),
            "ends": [float(ratio.min()), float(ratio.max())],
        }
    return found


def jitted(function: Callable[..., Any], *args: Any, units: float = 1.0) -> Work:
    """A compiled call as work of so many units."""
    call = jax.jit(function).lower(*args).compile()

    def work() -> float:
        jax.block_until_ready(call(*args))
        return units

    return work


def product(count: int, rows: int, columns: int, rounds: int) -> float:
    """Floating-point operations a second of so many products of ``rows x columns`` and a square
    matrix, each with its own, in single precision.
    """
    shapes = (count, rows, columns), (count, columns, columns)
    factors = [jax.random.normal(jax.random.key(len(shape)), shape) for shape in shapes]
    work = jitted(jnp.matmul, *factors, units=2.0 * count * rows * columns**2)
    return 1 / float(np.median(in_turns({OURS: work}, rounds)[OURS]))


def yardstick(rounds: int) -> Results:
    """GFLOP/s of `PRODUCTS`."""
    return {name: product(*shape, rounds) / 1e9 for name, shape in PRODUCTS.items()}


@cache
def rival(name: str) -> Any:
    """A module of `EXAMPLES`; None where it is not there, or what it stands on is not installed."""
    try:
        with patch.object(sys, "path", [str(EXAMPLES), *sys.path]):
            return import_module(name)
    except ModuleNotFoundError as error:
        if error.name in (name, "torch", "ale_py"):
            return None
        raise


class Ran(NamedTuple):
    """A process that has ended: seconds by the clock on the wall, and the peak of its memory."""

    seconds: float
    peak_bytes: int


def command(*argv: str, cache: Path | None = None) -> Ran:
    """Runs Python with these arguments, compiled programs in a folder of their own.

    Raises:
        InputError: where it fails, with the last line of what it says.
    """
    environment = os.environ | {programs.FOLDER: str(cache)} if cache else None
    told = subprocess.run(
        [sys.executable, "-c", COMMAND, sys.executable, *argv], env=environment, text=True,
        stdout=subprocess.PIPE, check=True,
    )  # fmt: skip
    seconds, peak, code, said = json.loads(told.stdout)
    if code:
        raise InputError(
            f"python {' '.join(argv[:2])} ended with code {code}: {said.strip().splitlines()[-1]}"
        )
    return Ran(seconds, peak)
