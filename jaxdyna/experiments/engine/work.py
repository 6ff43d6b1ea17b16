"""What an engine plays: work in units, by many runs, in blocks that are computed together.

A run is a seed of a setting. Its numbers come from its own key, hyper-parameters and data, and from
the size of its block alone: not from who is computed beside it, nor where, nor from what was played
before. Every block is played by the one program that was compiled for its size; on a CPU by as many
threads as there are cores, elsewhere on every device in turn.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from queue import SimpleQueue
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna.experiments.engine.checkpoint import BlockStore, Kept, Store
from jaxdyna.experiments.engine.memory import afford, held, used_by
from jaxdyna.experiments.engine.storage import cores
from jaxdyna.sweep import over_runs
from jaxdyna.types import Key

Curves = dict[str, np.ndarray]
Over = Callable[[Curves], np.ndarray]
"""From what runs have come to, ``[runs, units]``, to whether they are over, bool ``[runs]``."""

SHOWN = "show_"
"""Arrays that are kept of the first run alone begin so; they have no axis of runs."""
DIVERGED = "diverged"
"""A metric, 0 while the numbers of a run are finite. Where they are not, the run is over, and the
rest of its curves is NaN.
"""
JUDGING = 2**32 - 1
"""Folded into the base seed's key: the runs' own keys are its first splits."""


class Work(NamedTuple):
    """What is played, all of it pure functions of one run. The same functions are the same program.

    Attributes:
        init: ``(key, hparams) -> state``: a run before its first unit.
        step: ``(state, data, unit, hparams) -> (state, metrics)``: the unit numbered ``unit`` (from
            0), such as a real episode or a gradient step; metrics are float arrays by name. It may
            use the axis `jaxdyna.sweep.RUNS`, along which runs are computed together.
        data: ``(key, hparams) -> data``: a run's fixed input, made again on resume instead of
            saved; None for none. It gets the key that ``init`` gets.
        collect: ``(runs) -> data`` with the runs' axis in front: the same by the host, such as an
            emulator's episodes, from whatever `Runs` says of them but their keys.
        judge: ``(state, data, key, hparams) -> arrays``: of a run that is over.
        show: likewise of the first run alone: examples, films.
        piece: units between two looks at the clock: a run is over at a multiple of it at the
            earliest.
        block: runs computed together.
    """

    init: Callable[[Key, Any], Any]
    step: Callable[[Any, Any, jax.Array, Any], tuple[Any, dict[str, jax.Array]]]
    data: Callable[[Key, Any], Any] | None = None
    collect: Callable[[Runs], Any] | None = None
    judge: Callable[[Any, Any, Key, Any], dict[str, jax.Array]] | None = None
    show: Callable[[Any, Any, Key, Any], dict[str, jax.Array]] | None = None
    piece: int = 50
    block: int = 1


class Arm(NamedTuple):
    """One side of a comparison. Arms that differ in hparams and units only share their program."""

    work: Work
    hparams: Any
    units: int


class Runs(NamedTuple):
    """The one axis.

    Attributes:
        seed: global numbers ``[runs]``: run ``n`` of the base seed has the same keys in any
            company.
        base: the base seed.
        hparams: leaves ``[runs, ...]``.
        units: the most that each plays, ``[runs]``.
    """

    seed: np.ndarray
    base: int
    hparams: Any
    units: np.ndarray

    @property
    def keys(self) -> Key:
        """The runs' keys."""
        return _keys(jax.random.key(self.base), self.seed)

    @property
    def judging(self) -> Key:
        """The keys of what is judged of them."""
        return _keys(jax.random.fold_in(jax.random.key(self.base), JUDGING), self.seed)


def _keys(key: Key, seed: np.ndarray) -> Key:
    return jax.random.split(key, int(seed.max()) + 1)[seed]


def runs_of(arms: Sequence[Arm], seeds: Sequence[int], base: int) -> Runs:
    """Runs of these seeds for each of several arms of one work, arm by arm."""

    def along(*values: Any) -> np.ndarray:
        return np.repeat(np.stack([_array(value) for value in values]), len(seeds), axis=0)

    return Runs(
        seed=np.tile(np.asarray(seeds), len(arms)),
        base=base,
        hparams=jax.tree.map(along, *(arm.hparams for arm in arms)),
        units=np.repeat([arm.units for arm in arms], len(seeds)),
    )


def _array(value: Any) -> np.ndarray:
    """Single precision, as what Python numbers become where they meet single precision."""
    array = np.asarray(value)
    kinds = {"f": np.float32, "i": np.int32}
    return array.astype(kinds.get(array.dtype.kind, array.dtype))


class Seconds(NamedTuple):
    """By the clock on the wall; ``run_s`` with what was played before a resume."""

    compile_s: float
    run_s: float


class Played(NamedTuple):
    """What runs came to.

    Attributes:
        curves: a dictionary a run: metrics ``[units]``, what was judged, and of those with
            seed 0 what is shown.
        seconds: taken.
    """

    curves: list[Curves]
    seconds: Seconds


class Interrupted(KeyboardInterrupt):
    """Ctrl-C; what was played is saved."""


Progress = Callable[[str, int, int], None]
"""``(stage, units done, runs over)``."""


@dataclass
class Engine:
    """Plays works and keeps their programs.

    Attributes:
        workers: blocks that are played at a time; by default one a core, or one a device.
        programs: that were compiled.
        prepared: the seconds that it took ahead of time.
        interrupted: set by Ctrl-C: every block is saved after its piece, then `Interrupted` raised.
    """

    workers: int = 0
    interrupted: threading.Event = field(default_factory=threading.Event)
    programs: dict[Any, _Program] = field(default_factory=dict)
    prepared: dict[Work, float] = field(default_factory=dict)

    def play(
        self, work: Work, runs: Runs, over: Over | None = None, store: Store | None = None,
        say: Progress = lambda *_: None,
    ) -> Played:  # fmt: skip
        """Plays runs to their ends.

        Args:
            work: what.
            runs: whose; padded to whole blocks with copies.
            over: when a run is over before its last unit; None never.
            store: where checkpoints lie; None keeps none: a library call.
            say: is told how far it is, from any thread.

        Raises:
            Interrupted: after Ctrl-C.
            InputError: where a checkpoint is another version's, or there is too little memory.
            Exception: of the first block that fails; the others are saved after their pieces.
        """
        rows = np.arange(len(runs.seed))
        blocks = [rows[first : first + work.block] for first in range(0, len(rows), work.block)]
        collected = work.collect(runs) if work.collect else None
        say("compiling", 0, 0)
        began = time.perf_counter()
        where = places(self.workers)[: len(blocks)]
        programs = self._programs(work, runs, collected, where)
        compile_s = time.perf_counter() - began + self.prepared.pop(work, 0.0)
        tally = _Tally(say, len(runs.seed), store.seconds() if store else 0.0)
        failed = threading.Event()
        free: SimpleQueue[Any] = SimpleQueue()
        for place in where:
            free.put(place)

        def stopped() -> bool:
            return failed.is_set() or self.interrupted.is_set()

        def play_block(number: int) -> list[Curves]:
            place = free.get()
            try:
                block = _Block(programs[place], runs, blocks[number], over, tally, stopped)
                return block.play(collected, store.block(number) if store else None)
            except BaseException:
                failed.set()
                raise
            finally:
                free.put(place)

        with ThreadPoolExecutor(len(where)) as pool:
            futures = [pool.submit(play_block, number) for number in range(len(blocks))]
        errors = [error for future in futures if (error := future.exception()) is not None]
        if errors:
            real = [error for error in errors if not isinstance(error, Interrupted)]
            raise (real or errors)[0]
        curves = [run for future in futures for run in future.result()]
        return Played(curves, Seconds(compile_s, tally.seconds()))

    def prepare(self, several: Mapping[Work, Runs]) -> None:
        """Compiles at a time what is played next, which alone uses little more than a core; not
        what waits for data that the host collects.

        Raises:
            InputError: where there is too little memory.
        """

        def compiled(work: Work) -> float:
            began, runs = time.perf_counter(), several[work]
            blocks = -(-len(runs.seed) // work.block)
            self._programs(work, runs, None, places(self.workers)[:blocks])
            return time.perf_counter() - began

        works = [work for work in several if not work.collect]
        began = time.perf_counter()
        with ThreadPoolExecutor(max(len(works), 1)) as pool:
            each = [*pool.map(compiled, works)]
        share = (time.perf_counter() - began) / max(sum(each), 1e-9)
        self.prepared |= {work: share * one for work, one in zip(works, each, strict=True)}

    def _programs(
        self, work: Work, runs: Runs, collected: Any, where: Sequence[jax.Device]
    ) -> dict[jax.Device, _Program]:
        shapes = str(jax.tree.map(lambda leaf: (leaf.shape[1:], str(leaf.dtype)), runs.hparams))
        for place in set(where):
            if (work, shapes, place) not in self.programs:
                made = _Program(work, runs, collected, place, where.count(place))
                self.programs[work, shapes, place] = made
        return {place: self.programs[work, shapes, place] for place in set(where)}


def places(workers: int = 0) -> list[jax.Device]:
    """The device of each worker: on a CPU as many as this process may use cores, on one device."""
    devices = jax.devices()
    if devices[0].platform == "cpu":
        return [devices[0]] * (workers or cores())
    return devices[: workers or len(devices)]


class _Program:
    """A work compiled for blocks of its size on one device."""

    def __init__(self, work: Work, runs: Runs, collected: Any, place: jax.Device, at_once: int):
        self.work, self.place, self.lock = work, place, threading.Lock()
        keys, hparams = self.put(_shaped(work.block, (runs.keys, runs.hparams)))

        def piece(state: Any, data: Any, first: jax.Array, count: jax.Array, hparams: Any) -> Any:
            def one(state: Any, data: Any, hparams: Any) -> Any:
                return _loop(work, state, data, first, count, hparams)

            return over_runs(one, work.block)(state, data, hparams)

        start = jax.jit(over_runs(work.init, work.block)).lower(keys, hparams)
        making = work.data and jax.jit(over_runs(work.data, work.block)).lower(keys, hparams)
        data = making.out_info if making else _shaped(work.block, collected)
        state, data = self.put((start.out_info, data))
        afford(held(state, data), work.block, at_once, place)  # before it compiles for minutes
        number = self.put(jax.ShapeDtypeStruct((), jnp.int32))
        piece_of = jax.jit(piece, donate_argnums=0).lower(state, data, number, number, hparams)
        lowered = [(start, _quickly(place)), (piece_of, {}), *([(making, {})] if making else [])]
        with ThreadPoolExecutor(len(lowered)) as pool:  # XLA compiles without Python's lock
            self.start, self.piece, *rest = pool.map(
                lambda one: one[0].compile(compiler_options=one[1]), lowered
            )
        afford(used_by(self.piece), work.block, at_once, place)
        self.data = rest[0] if rest else None
        self.judging = {
            name: jax.jit(call)
            for name, call in (("judge", work.judge), ("show", work.show))
            if call is not None
        }
        self.row = jax.jit(lambda tree, row: jax.tree.map(lambda leaf: leaf[row], tree))

    def put(self, tree: Any) -> Any:
        """Shapes on this program's device."""
        where = jax.sharding.SingleDeviceSharding(self.place)
        return jax.tree.map(
            lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=where), tree
        )


def _quickly(place: jax.Device) -> dict[str, Any]:
    """How XLA compiles what is run once: on a CPU it optimises less, in less than half the time."""
    told = "xla_backend_optimization_level" in os.environ.get("XLA_FLAGS", "")
    return {} if told or place.platform != "cpu" else {"xla_backend_optimization_level": 1}


def _shaped(block: int, tree: Any) -> Any:
    return jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct((block, *leaf.shape[1:]), leaf.dtype), tree
    )


def _loop(work: Work, state: Any, data: Any, first: Any, count: Any, hparams: Any) -> Any:
    """``count`` units from number ``first`` on, both traced, so that one program serves any number
    up to `Work.piece`; metrics are ``[piece, ...]``, of which so many count.
    """

    step = jax.jit(work.step, inline=True)  # what is traced for its shapes is not traced again

    def unit(number: jax.Array, carry: Any) -> Any:
        state, kept = carry
        state, new = step(state, data, first + number, hparams)
        kept = jax.tree.map(lambda all_, one: all_.at[number].set(one), kept, new)
        return state, kept

    shapes = jax.eval_shape(step, state, data, first, hparams)[1]
    kept = jax.tree.map(lambda one: jnp.zeros((work.piece, *one.shape), one.dtype), shapes)
    return jax.lax.fori_loop(0, count, unit, (state, kept))


class _Block:
    """Runs that are computed together, from their first unit to the end of the last of them."""

    def __init__(
        self, program: _Program, runs: Runs, rows: np.ndarray, over: Over | None, tally: _Tally,
        stopped: Callable[[], bool],
    ):  # fmt: skip
        self.program, self.work, self.place = program, program.work, program.place
        self.runs, self.over, self.tally, self.stopped = runs, over, tally, stopped
        padded = np.concatenate([rows, np.repeat(rows[:1], self.work.block - len(rows))])
        self.rows, self.padded = rows, padded
        self.hparams = self._put(jax.tree.map(lambda leaf: leaf[padded], runs.hparams))
        self.judging = runs.judging
        self.over_at: dict[int, Curves] = {}
        self.done, self.pieces = 0, Curves()

    def play(self, collected: Any, store: BlockStore | None) -> list[Curves]:
        """What each of its runs came to."""
        kept = store.load() if store else None
        if kept is not None:
            self.done, self.pieces, self.over_at = kept.done, kept.metrics, kept.over
            self.tally.add(self.done * len(self.rows), len(self.over_at))
        if self._left():
            self._play_on(collected, store, kept)
            if store:
                store.save(Kept(self.done, None, {}, self.over_at), self.tally.seconds())
        return [self.over_at[row] for row in range(len(self.rows))]

    def _left(self) -> list[int]:
        return [row for row in range(len(self.rows)) if row not in self.over_at]

    def _play_on(self, collected: Any, store: BlockStore | None, kept: Kept | None) -> None:
        if self.stopped():
            raise Interrupted
        keys, program = self._put(self.runs.keys[self.padded]), self.program
        state = program.start(keys, self.hparams)
        data = None
        if program.data is not None:
            data = program.data(self._put(self.runs.keys[self.padded]), self.hparams)
        if collected is not None:
            data = self._put(jax.tree.map(lambda leaf: leaf[self.padded], collected))
        if kept is not None:
            state = kept.into(state, self.place)
        while self._left():
            ends = [int(self.runs.units[self.rows[row]]) for row in self._left()]
            count = min(self.work.piece - self.done % self.work.piece, min(ends) - self.done)
            first, number = self._put((np.int32(self.done), np.int32(count)))
            state, metrics = program.piece(state, data, first, number, self.hparams)
            new = {name: _said(values)[:, :count] for name, values in metrics.items()}
            self.pieces = {
                name: np.concatenate([self.pieces[name], values], axis=1) if self.done else values
                for name, values in new.items()
            }
            self.done += count
            ended = self._ended()
            for row in ended:
                self.over_at[row] = self._judged(row, state, data)
            self.tally.add(count * len(self.rows), len(ended))
            stop = self.stopped()
            if store and self._left() and (stop or store.due()):
                saved = Kept(self.done, state, self.pieces, self.over_at)
                store.save(saved, self.tally.seconds())
            if stop and self._left():
                raise Interrupted

    def _ended(self) -> list[int]:
        """The rows of runs that have just come to their ends. Looked at after whole pieces and
        after a run's own last unit only, so that it does not matter who else is in the block.
        """
        over = np.zeros(len(self.padded), bool)
        if self.done % self.work.piece == 0:
            if self.over is not None:
                over = self.over(self.pieces)
            if DIVERGED in self.pieces:
                over = over | self.pieces[DIVERGED].any(1)
        units = self.runs.units[self.padded]
        return [row for row in self._left() if over[row] or units[row] == self.done]

    def _judged(self, row: int, state: Any, data: Any) -> Curves:
        """The curves of a run up to now, and what is judged of it."""
        first = self.runs.seed[self.rows[row]] == 0
        broken = self.pieces[DIVERGED][row] if DIVERGED in self.pieces else np.zeros(1)
        end = broken.argmax() + 1 if broken.any() else self.done
        curves = {
            name: values[row][:end]
            for name, values in self.pieces.items()
            if first or not name.startswith(SHOWN)
        }
        wanted = [name for name in self.program.judging
                  if name == "judge" or (first and not broken.any())]  # fmt: skip
        if not wanted:
            return curves
        own, own_data, hparams = self.program.row((state, data, self.hparams), row)
        key = self.judging[self.rows[row]]
        for name in wanted:
            with self.program.lock:  # two threads would compile it twice
                judged = self.program.judging[name](
                    own, own_data, jax.random.fold_in(key, int(name == "show")), hparams
                )
            prefix = SHOWN if name == "show" else ""
            found = {f"{prefix}{name}": _said(values) for name, values in judged.items()}
            if broken.any():  # whatever a broken run does is no result
                found = {name: np.full(values.shape, np.nan, np.float32)
                         for name, values in found.items()}  # fmt: skip
            curves |= found
        return curves

    def _put(self, tree: Any) -> Any:
        return jax.device_put(tree, self.place)


def _said(values: Any) -> np.ndarray:
    """On the host, NaN where work was skipped (`jaxdyna.dyna.conditional.nothing`)."""
    values = np.asarray(values)
    debugging = jax.config.jax_debug_nans and values.dtype.kind == "f"  # type: ignore[attr-defined]
    return np.where(values == -np.inf, np.nan, values) if debugging else values


class _Tally:
    """How far all blocks together are, told under a lock."""

    def __init__(self, say: Progress, runs: int, earlier_s: float):
        self.say, self.runs, self.earlier = say, runs, earlier_s
        self.lock, self.done, self.over = threading.Lock(), 0, 0
        self.began = time.perf_counter()

    def add(self, units: int, over: int) -> None:
        """So many units more, and runs that are over."""
        with self.lock:
            self.done, self.over = self.done + units, self.over + over
            self.say("running", self.done // self.runs, self.over)

    def seconds(self) -> float:
        """Since the work began, with those before a resume."""
        return self.earlier + time.perf_counter() - self.began


def joined(curves: Sequence[Curves]) -> Curves:
    """Arrays ``[runs, ...]`` of several runs, each filled up with NaN after its own end; what is
    shown is the first's that has it.
    """
    arrays: Curves = {}
    for name in dict.fromkeys(name for run in curves for name in run):
        values = [np.asarray(run[name]) for run in curves if name in run]
        arrays[name] = values[0] if name.startswith(SHOWN) else _filled(values)
    return arrays


def _filled(values: Sequence[np.ndarray]) -> np.ndarray:
    """Stacked; shorter ones are filled up with NaN."""
    longest = max((len(one) for one in values if one.ndim), default=0)
    if all(one.ndim == 0 or len(one) == longest for one in values):
        return np.stack(values)
    kind = np.result_type(*values, np.float32) if values[0].dtype.kind != "f" else values[0].dtype
    filled = np.full((len(values), longest, *values[0].shape[1:]), np.nan, kind)
    for row, one in zip(filled, values, strict=True):
        row[: len(one)] = one
    return filled
