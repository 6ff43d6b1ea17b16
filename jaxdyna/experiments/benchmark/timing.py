"""How things are timed: in turns, so that a machine that slows down does so for all, each turn long
enough for the clock; medians count. And what the machine can do at all, beside which times stand.
"""

import time
from collections.abc import Callable, Mapping
from math import ceil
from typing import Any

import jax
import numpy as np

from jaxdyna.experiments.engine import Results

OURS, PYTORCH = "jaxdyna", "PyTorch"
LEAST_S = 0.1  #: of a turn
UNITS = {"s": 1.0, "ms": 1e3, "GiB": 2.0**-30}
#: the yardstick: by its name how many products of how many rows and columns
PRODUCTS = {"one of 2048x2048": (1, 2048, 2048), "ten of 64x256 and 256x256": (10, 64, 256)}
Work = Callable[[], float]  #: returns how many units it was, once all of their results are there


def in_turns(
    works: Mapping[str, Work | None], rounds: int, least_s: float = LEAST_S,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, np.ndarray]:  # fmt: skip
    """Seconds a unit ``[rounds]`` of each work, by its name; of None, which cannot be had, nothing.

    Each is called once before, which does not count, and once to see how many calls make a turn of
    ``least_s`` seconds; where that is 0, a turn is one call.
    """

    def turn(work: Work, calls: int) -> tuple[float, float]:
        began = clock()
        units = sum(work() for _ in range(calls))
        return clock() - began, units

    there = {name: work for name, work in works.items() if work}
    calls = dict.fromkeys(there, 1)
    for name, work in there.items():
        work()
        if least_s:
            calls[name] = max(1, ceil(least_s / max(turn(work, 1)[0], 1e-9)))
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
    """A line of a table.

    Args:
        what: was measured.
        unit: of the medians that it tells: one of `UNITS`, or so many of something ``/s``.
        ours: seconds a unit, of each turn, or bytes; None where there is nothing of ours.
        whose: what it stands beside.
        theirs: likewise, of the same turns; None where it cannot be had.
        ceiling: units a second that cannot be exceeded, where that is known.
    """

    def told(taken: Any) -> float | None:
        if taken is None:
            return None
        median = float(np.median(taken))
        return 1 / median if unit.endswith("/s") else median * UNITS[unit]

    found = Results(what=what, unit=unit, ours=told(ours), whose=whose, theirs=told(theirs))
    if ceiling:
        found["share"] = (told(ours) or 0.0) / ceiling
    if ours is not None and theirs is not None:
        ratio = np.atleast_1d(np.asarray(theirs) / np.asarray(ours))
        found.update(ratio=float(np.median(ratio)), ends=[float(ratio.min()), float(ratio.max())])
    return found


def jitted(function: Callable[..., Any], *args: Any, units: float) -> Work:
    """A compiled call as work of so many units."""
    call = jax.jit(function).lower(*args).compile()
    return in_units(lambda: jax.block_until_ready(call(*args)), units)


def in_units(call: Callable[[], Any], units: float) -> Work:
    """A call as work of so many units."""

    def work() -> float:
        call()
        return units

    return work


def product(count: int, rows: int, columns: int, rounds: int) -> float:
    """Floating-point operations a second of so many products of ``rows x columns`` and a square
    matrix, each with its own, in single precision; of small ones many in a row, in one program.
    """
    operations, (key_x, key_y) = 2 * count * rows * columns**2, jax.random.split(jax.random.key(0))
    x = jax.random.normal(key_x, (count, rows, columns))
    y = jax.random.normal(key_y, (count, columns, columns)) / columns**0.5
    loops = max(1, 2**28 // operations)
    chain = jitted(lambda x, y: jax.lax.fori_loop(0, loops, lambda _, x: x @ y, x), x, y,
                   units=loops * operations)  # fmt: skip
    return 1 / float(np.median(in_turns({OURS: chain}, rounds)[OURS]))


def yardstick(rounds: int) -> Results:
    """GFLOP/s of `PRODUCTS`."""
    return {name: product(*shape, rounds) / 1e9 for name, shape in PRODUCTS.items()}
