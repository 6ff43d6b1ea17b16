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
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna.experiments.engine.checkpoint import Kept, Store, stacked
from jaxdyna.experiments.engine.memory import afford, held, spare, used_by
from jaxdyna.experiments.engine.storage import cores
from jaxdyna.sweep import over_runs
from jaxdyna.trees import named_leaves
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

BEGUN = 8
"""Blocks a worker that are begun at most, so that their runs can be packed together."""


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
        interrupted: set by Ctrl-C: every block is saved after its piece, then `Interrupted` raised.
    """

    workers: int = 0
    interrupted: threading.Event = field(default_factory=threading.Event)
    programs: dict[Any, _Program] = field(default_factory=dict)

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
        count = len(runs.seed)
        collected = work.collect(runs) if work.collect else None
        say("compiling", 0, 0)
        began = time.perf_counter()
        where = places(self.workers)[: -(-count // work.block)]
        programs = {
            place: self._program(work, runs, collected, place, where.count(place))
            for place in set(where)
        }
        compile_s = time.perf_counter() - began
        tally = _Tally(say, count, store.seconds() if store else 0.0)
        play = _Play(runs, runs.keys, runs.judging, collected, over, store, tally, {})
        failed = threading.Event()

        def stopped() -> bool:
            return failed.is_set() or self.interrupted.is_set()

        pool = _Pool(play, programs, where, stopped)

        def serve(place: jax.Device) -> None:
            block = None
            try:
                while block := pool.next(place, block):
                    block.play_piece()
            except BaseException:
                failed.set()
                raise
            finally:
                pool.save()

        with ThreadPoolExecutor(len(where)) as threads:
            futures = [threads.submit(serve, place) for place in where]
        for future in futures:
            future.result()
        if len(play.curves) < count:
            raise Interrupted
        curves = [play.curves[row] for row in range(count)]
        return Played(curves, Seconds(compile_s, tally.seconds()))

    def _program(
        self, work: Work, runs: Runs, collected: Any, place: jax.Device, at_once: int
    ) -> _Program:
        shapes = jax.tree.map(lambda leaf: (leaf.shape[1:], str(leaf.dtype)), runs.hparams)
        known = (work, str(shapes), place)
        if known not in self.programs:
            self.programs[known] = _Program(work, runs, collected, place, at_once)
        return self.programs[known]


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


class _Play(NamedTuple):
    """What all blocks have in common; ``curves`` are of the runs that are over, by their row."""

    runs: Runs
    keys: Key
    judging: Key
    collected: Any
    over: Over | None
    store: Store | None
    tally: _Tally
    curves: dict[int, Curves]


class _Pool:
    """The runs that are not over, in blocks. A worker takes the least advanced one that waits on
    its device, plays a piece of it and gives it back. Where those that wait at the same unit have
    so few runs left that these fit into fewer blocks, they are packed anew. More are begun than
    there are workers, so that some wait; nobody waits for another's piece.
    """

    def __init__(
        self, play: _Play, programs: Mapping[jax.Device, _Program], where: Sequence[jax.Device],
        stopped: Callable[[], bool],
    ):  # fmt: skip
        self.play, self.programs, self.where, self.stopped = play, programs, where, stopped
        self.size, self.lock = programs[where[0]].work.block, threading.Lock()
        self.waiting: dict[jax.Device, list[_Block]] = {place: [] for place in programs}
        self.playing = dict.fromkeys(programs, 0)
        units, store = play.runs.units, play.store
        self.may_shrink = self.size > 1 and (play.over is not None or units.min() < units.max())
        kept = {row: (store and store.load(row)) or Kept() for row in range(len(units))}
        play.curves.update({row: run.metrics for row, run in kept.items() if run.over})
        if played := sum(run.done for run in kept.values()):
            play.tally.add(played, len(play.curves))
        left = {row: run for row, run in kept.items() if not run.over}
        self.unbegun = [  # those that have states first
            block
            for done in sorted({run.done for run in left.values()}, reverse=True)
            for block in _blocks({row: run for row, run in left.items() if run.done == done},
                                 self.size)
        ]  # fmt: skip

    def next(self, place: jax.Device, played: _Block | None) -> _Block | None:
        """The next one for a worker, who gives back what it has played; None where there is none.
        Nobody plays once `stopped`.
        """
        with self.lock:
            waiting = self.waiting[place]
            if played is not None:
                self.playing[place] -= 1
                if played.live:
                    waiting[:] = self._packed([*waiting, played], played.done)
            if self.stopped():
                return None
            if not waiting:
                self._begin(place)
            waiting = waiting or max(self.waiting.values(), key=len)  # another device's
            if not waiting:
                return None
            block = min(waiting, key=lambda block: block.done)
            waiting.remove(block)
            self.playing[place] += 1
            program = self.programs[place]
            return block if block.program is program else _Block(program, self.play, block.kept())

    def save(self) -> None:
        """Saves those that wait, once it is `stopped`."""
        while self.stopped():
            with self.lock:
                block = next((blocks.pop() for blocks in self.waiting.values() if blocks), None)
            if block is None:
                return
            block.save()

    def _packed(self, waiting: list[_Block], done: int) -> list[_Block]:
        """Of these those at unit ``done`` in as few as can be."""
        same = [block for block in waiting if block.done == done]
        if -(-sum(len(block.live) for block in same) // self.size) == len(same):
            return waiting
        kept = {row: run for block in same for row, run in block.kept().items()}
        fewer = [_Block(same[0].program, self.play, runs) for runs in _blocks(kept, self.size)]
        return [block for block in waiting if block.done != done] + fewer

    def _begin(self, place: jax.Device) -> None:
        """As many as memory affords; other devices get their share."""
        program, workers = self.programs[place], self.where.count(place)
        most = max(1, workers - self.playing[place])
        if self.may_shrink:
            more = BEGUN * workers - self.playing[place]
            most = max(most, spare(used_by(program.piece), more, place))
        for _ in range(min(most, -(-len(self.unbegun) // len(self.programs)))):
            self.waiting[place].append(_Block(program, self.play, self.unbegun.pop(0)))


def _blocks(kept: Mapping[int, Kept], size: int) -> list[dict[int, Kept]]:
    rows = sorted(kept)
    parts = (rows[first : first + size] for first in range(0, len(rows), size))
    return [{row: kept[row] for row in part} for part in parts]


class _Block:
    """Runs that are computed together, all of them at the same unit; filled up with copies.

    Attributes:
        live: the lane of each run that is not over.
        done: units played.
        before: the runs as they were kept, until they are on the device.
    """

    def __init__(self, program: _Program, play: _Play, kept: dict[int, Kept]):
        self.program, self.work, self.play = program, program.work, play
        first = next(iter(kept))
        self.rows = np.array([*kept, *[first] * (self.work.block - len(kept))])
        self.live = {row: lane for lane, row in enumerate(kept)}
        self.done, self.saved_s = kept[first].done, time.perf_counter()
        self.before = kept

    def kept(self) -> dict[int, Kept]:
        """Its runs that are not over, on the host."""
        if self.before:
            return self.before
        leaves = named_leaves(self.state)
        return {
            row: Kept(self.done, *({name: values[lane] for name, values in arrays.items()}
                                   for arrays in (leaves, self.pieces)))
            for row, lane in self.live.items()
        }  # fmt: skip

    def save(self) -> None:
        """Writes a checkpoint of each of its runs."""
        if self.play.store and self.done:
            for row, run in self.kept().items():
                self.play.store.save(row, run, self.play.tally.seconds())
        self.saved_s = time.perf_counter()

    def _begin(self) -> None:
        program, runs = self.program, self.play.runs
        self.hparams = self._put(jax.tree.map(lambda leaf: leaf[self.rows], runs.hparams))
        self.state = program.start(self._put(self.play.keys[self.rows]), self.hparams)
        self.data, self.pieces = None, Curves()
        if program.data is not None:
            self.data = program.data(self._put(self.play.keys[self.rows]), self.hparams)
        if self.play.collected is not None:
            self.data = self._put(jax.tree.map(lambda leaf: leaf[self.rows], self.play.collected))
        if self.done:
            kept = [self.before[row] for row in self.rows]
            self.state = stacked([run.state for run in kept], self.state, program.place)
            self.pieces = {name: np.stack([run.metrics[name] for run in kept])
                           for name in kept[0].metrics}  # fmt: skip
        self.before = {}

    def play_piece(self) -> None:
        """Up to the next unit at which a run of it may be over."""
        if self.before:
            self._begin()
        end = min(int(self.play.runs.units[row]) for row in self.live)
        count = min(self.work.piece - self.done % self.work.piece, end - self.done)
        first, number = self._put((np.int32(self.done), np.int32(count)))
        self.state, metrics = self.program.piece(self.state, self.data, first, number, self.hparams)
        new = {name: _said(values)[:, :count] for name, values in metrics.items()}
        self.pieces = {
            name: np.concatenate([self.pieces[name], values], axis=1) if self.done else values
            for name, values in new.items()
        }
        self.done += count
        played, ended = len(self.live), self._ended()
        for row in ended:
            curves = self._judged(row, self.live.pop(row))
            if self.play.store:
                over = Kept(self.done, metrics=curves, over=True)
                self.play.store.save(row, over, self.play.tally.seconds())
            self.play.curves[row] = curves
        self.play.tally.add(count * played, len(ended))
        if self.live and self.play.store and self.play.store.due(self.saved_s):
            self.save()

    def _ended(self) -> list[int]:
        """Its runs that have just come to their ends. Looked at after whole pieces and after a
        run's own last unit only, so that it does not matter who else is in the block.
        """
        over = np.zeros(len(self.rows), bool)
        if self.done % self.work.piece == 0:
            if self.play.over is not None:
                over = self.play.over(self.pieces)
            if DIVERGED in self.pieces:
                over = over | self.pieces[DIVERGED].any(1)
        units = self.play.runs.units
        return [row for row, lane in self.live.items() if over[lane] or units[row] == self.done]

    def _judged(self, row: int, lane: int) -> Curves:
        """The curves of a run up to now, and what is judged of it."""
        first = self.play.runs.seed[row] == 0
        broken = self.pieces[DIVERGED][lane] if DIVERGED in self.pieces else np.zeros(1)
        end = broken.argmax() + 1 if broken.any() else self.done
        curves = {
            name: values[lane][:end]
            for name, values in self.pieces.items()
            if first or not name.startswith(SHOWN)
        }
        wanted = [name for name in self.program.judging
                  if name == "judge" or (first and not broken.any())]  # fmt: skip
        if not wanted:
            return curves
        own, own_data, hparams = self.program.row((self.state, self.data, self.hparams), lane)
        key = self.play.judging[row]
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
        return jax.device_put(tree, self.program.place)


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
