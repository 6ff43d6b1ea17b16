"""What an engine plays: work in units, by many runs, in blocks that are computed together.

A run is a seed of a setting. Its numbers come from its own key, hyper-parameters and data, and from
the size of its block alone: not from who is computed beside it, nor where, nor from what was played
before. Every block is played by the one program that was compiled for its size; on a CPU by as many
threads as there are cores, elsewhere on every device in turn. So runs may be dealt out anew between
two pieces: as some are over, the others are fewer blocks.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from operator import itemgetter
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna.experiments.engine.checkpoint import Kept, Store, stacked
from jaxdyna.experiments.engine.memory import afford, held, spare, used_by
from jaxdyna.experiments.engine.programs import optimised
from jaxdyna.experiments.engine.storage import cores
from jaxdyna.experiments.engine.trained import EPISODES, Keeper, Trained, told_of
from jaxdyna.sweep import over_runs
from jaxdyna.trees import named_leaves, stack
from jaxdyna.types import Key

Curves = dict[str, np.ndarray]
#: from what runs have come to, ``[runs, units]``, to whether they are over, bool ``[runs]``
Over = Callable[[Curves], np.ndarray]

SHOWN = "show_"  #: arrays that are kept of the first run alone begin so; they have no axis of runs
#: a metric, 0 while the numbers of a run are finite. Where they are not, the run is over, and the
#: rest of its curves is NaN.
DIVERGED = "diverged"
JUDGING = 2**32 - 1  #: folded into the base seed's key: the runs' own keys are its first splits

#: of runs that are over; which of them it is, is folded into the key of a run's judging
HOOKS = ("judge", "show", "keep")
BEGUN = 8  #: blocks a worker that are begun at a time, so that their runs can be packed together


class Work(NamedTuple):
    """What is played: pure functions of one run. The same functions are the same program."""

    init: Callable[[Key, Any], Any]  #: ``(key, hparams) -> state``: a run before its first unit
    #: ``(state, data, unit, hparams) -> (state, metrics)``: the unit numbered ``unit`` (from 0),
    #: such as a real episode or a gradient step; metrics are float arrays by name.
    step: Callable[[Any, Any, jax.Array, Any], tuple[Any, dict[str, jax.Array]]]
    #: ``(key, hparams) -> data``: a run's fixed input, made again on resume instead of saved; None
    #: for none. It gets the key that ``init`` gets.
    data: Callable[[Key, Any], Any] | None = None
    #: ``(runs) -> data`` with the runs' axis in front: the same by the host, such as an emulator's
    #: episodes, from whatever `Runs` says of them but their keys
    collect: Callable[[Runs], Any] | None = None
    #: ``(state, data, key, hparams) -> arrays``: of a run that is over
    judge: Callable[[Any, Any, Key, Any], dict[str, jax.Array]] | None = None
    #: likewise of the first run alone: examples, films
    show: Callable[[Any, Any, Key, Any], dict[str, jax.Array]] | None = None
    #: units between two looks at the clock: a run is over at a multiple of it at the earliest
    piece: int = 50
    block: int = 1  #: runs computed together
    #: to which XLA optimises units on a CPU: 2 compiles in 2/3 of the time, 3 may run faster
    level: int = 3
    #: ``(state, hparams) -> what a run has learned``; the first runs' is kept; None: nothing
    trained: Callable[[Any, Any], Trained] | None = None


class Arm(NamedTuple):
    """One side of a comparison. Arms that differ in hparams and units only share their program."""

    work: Work
    hparams: Any
    units: int


class Runs(NamedTuple):
    """The one axis."""

    #: global numbers ``[runs]``: run ``n`` of the base seed has the same keys in any company
    seed: np.ndarray
    base: int  #: the base seed
    hparams: Any  #: leaves ``[runs, ...]``
    units: np.ndarray  #: the most that each plays, ``[runs]``
    row: np.ndarray  #: which it is of all runs of the work, ``[runs]``

    @property
    def keys(self) -> Key:
        """The runs' keys."""
        return _keys(jax.random.key(self.base), self.seed)

    def only(self, rows: Sequence[int]) -> Runs:
        """Some of them."""
        seed, hparams, units, row = jax.tree.map(
            lambda leaf: leaf[np.array(rows)], (self.seed, self.hparams, self.units, self.row)
        )
        return Runs(seed, self.base, hparams, units, row)

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
        row=np.arange(len(arms) * len(seeds)),
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
    """What runs came to."""

    #: a dictionary a run: metrics ``[units]``, what was judged, and of seed 0 what is shown
    curves: list[Curves]
    seconds: Seconds  #: taken


class Interrupted(KeyboardInterrupt):
    """Ctrl-C; what was played is saved."""


Progress = Callable[[str, int, int], None]  #: ``(stage, units done, runs over)``


class Logger(Protocol):
    """Whoever is told of a run, from any thread, but by one at a time."""

    def log(self, step: int, scalars: Mapping[str, float]) -> None:
        """The means of its metrics over a piece that ends at this unit, those that are finite."""


@dataclass
class Engine:
    """Plays works and keeps their programs."""

    workers: int = 0  #: blocks that are played at a time; by default one a core, or one a device
    #: of how many runs of each arm, the first ones, it is kept what they have learned
    keep: int = 0
    #: set by Ctrl-C: every block is saved after its piece, then `Interrupted` raised
    interrupted: threading.Event = field(default_factory=threading.Event)
    programs: dict[Any, _Program] = field(default_factory=dict)  #: that were compiled
    #: the seconds that compiling took ahead of time
    prepared: dict[Work, float] = field(default_factory=dict)

    def play(
        self, work: Work, runs: Runs, over: Over | None = None, store: Store | None = None,
        say: Progress = lambda *_: None, log: Sequence[Logger] = (),
    ) -> Played:  # fmt: skip
        """Plays runs to their ends.

        Args:
            work: what.
            runs: whose; padded to whole blocks with copies.
            over: when a run is over before its last unit; None never.
            store: where checkpoints lie; None keeps none: a library call.
            say: is told how far it is, from any thread; `progress.shown` draws it.
            log: who is told of each run, one a run; nobody by default.

        Raises:
            Interrupted: after Ctrl-C.
            InputError: where a checkpoint is another version's, or there is too little memory.
            Exception: of the first block that fails; the others are saved after their pieces.
        """
        work, count = self._asked(work), len(runs.seed)
        if log and len(log) != count:
            raise ValueError(f"log has {len(log)} loggers for {count} runs: give one a run")
        collected = work.collect(runs) if work.collect else None
        began = time.perf_counter()
        programs = self._programs(work, runs, collected)
        if any(program.lowered for program in programs):
            say("compiling", 0, 0)
        _compile(programs)
        compile_s = time.perf_counter() - began + self.prepared.pop(work, 0.0)
        pool = _Pool(self, programs, runs, collected, over, store, say, log)
        with ThreadPoolExecutor(len(programs)) as threads:
            workers = [threads.submit(pool.serve, program) for program in programs]
        for worker in workers:
            worker.result()
        if len(pool.curves) < count:
            raise Interrupted
        curves = [pool.curves[row] for row in range(count)]
        return Played(curves, Seconds(compile_s, pool.seconds()))

    def prepare(self, several: Mapping[Work, Runs]) -> None:
        """Compiles at a time what is played next, which alone keeps little more than a core busy;
        not what waits for data that the host collects. `InputError` where memory is short.
        """
        began, took, rest = time.perf_counter(), {}, {}
        with ThreadPoolExecutor(max(len(several), 1)) as pool:  # one compiles as the next is traced
            for work, runs in zip(map(self._asked, several), several.values(), strict=True):
                if not work.collect:
                    traced = time.perf_counter()
                    programs = self._programs(work, runs)
                    took[work] = time.perf_counter() - traced
                    rest[work] = pool.submit(_compile, programs)
        for work, part in rest.items():
            took[work] += part.result()
        share = (time.perf_counter() - began) / max(sum(took.values()), 1e-9)
        self.prepared |= {work: share * one for work, one in took.items()}

    def _asked(self, work: Work) -> Work:
        return work if self.keep else work._replace(trained=None)

    def _programs(self, work: Work, runs: Runs, collected: Any = None) -> list[_Program]:
        """Each worker's; traced here, in the caller's `jax.config` contexts, compiled later."""
        where = places(self.workers)[: -(-len(runs.seed) // work.block)]
        shapes = jax.tree.map(lambda leaf: (leaf.shape[1:], str(leaf.dtype)), runs.hparams)
        known = [(work, str(shapes), place) for place in where]
        for one in {*known} - self.programs.keys():
            place = one[-1]
            self.programs[one] = _Program(work, runs, collected, place, where.count(place))
        return [self.programs[one] for one in known]


def _compile(programs: Sequence[_Program]) -> float:
    """Those that are not yet; returns the seconds that it takes."""
    began = time.perf_counter()
    for program in programs:
        program.compile()
    return time.perf_counter() - began


def places(workers: int = 0) -> list[jax.Device]:
    """The device of each worker: on a CPU as many as this process may use cores, on one device."""
    devices = jax.devices()
    if devices[0].platform == "cpu":
        return [devices[0]] * (workers or cores())
    return devices[: workers or len(devices)]


class _Program:
    """A work for blocks of its size on one device: lowered, then compiled."""

    def __init__(self, work: Work, runs: Runs, collected: Any, place: jax.Device, at_once: int):
        self.work, self.place, self.at_once = work, place, at_once
        keys, hparams = self.shapes((runs.keys, runs.hparams))

        def piece(state: Any, data: Any, first: jax.Array, count: jax.Array, hparams: Any) -> Any:
            def one(state: Any, data: Any, hparams: Any) -> Any:
                return _loop(work, state, data, first, count, hparams)

            return over_runs(one, work.block)(state, data, hparams)

        start = jax.jit(over_runs(work.init, work.block)).lower(keys, hparams)
        making = work.data and jax.jit(over_runs(work.data, work.block)).lower(keys, hparams)
        state, data = self.shapes((start.out_info, making.out_info if making else collected))
        afford(held(state, data), work.block, at_once, place)  # before it compiles for minutes
        key, number = jax.device_put((runs.judging[0], np.int32(0)), place)
        piece_of = jax.jit(piece, donate_argnums=0).lower(state, data, number, number, hparams)
        seldom: dict[str, Any] = {"start": start, "data": making}
        own = jax.tree.map(itemgetter(0), runs.hparams)
        keeper = work.trained and Keeper(work.init, work.trained, own)
        hooks = work.judge, work.show, keeper.keep if keeper else None
        told = state, data, hparams
        for name, hook in zip(HOOKS, hooks, strict=True):
            seldom[name] = hook and jax.jit(partial(_of_one, hook)).lower(key, number, told)
        if keeper:
            seldom["play"] = keeper.play.lower(seldom["keep"].out_info, key, own, EPISODES)
        self.lowered = {name: (one, optimised(1, place)) for name, one in seldom.items() if one}
        self.lowered["piece"] = piece_of, optimised(work.level, place)

    def compile(self) -> None:
        """Compiles it, once, and looks at the memory it takes: `InputError` where it lacks."""
        if not self.lowered:
            return
        with ThreadPoolExecutor(len(self.lowered)) as pool:  # XLA compiles without Python's lock
            made = pool.map(lambda one: one[0].compile(one[1]), self.lowered.values())
            self.calls = dict(zip(self.lowered, made, strict=True))
        afford(used_by(self.calls["piece"]), self.work.block, self.at_once, self.place)
        self.lowered = {}

    def shapes(self, tree: Any) -> Any:
        """Of leaves ``[runs, ...]`` those of a block, on this program's device."""
        where, block = jax.sharding.SingleDeviceSharding(self.place), self.work.block

        def of(leaf: Any) -> jax.ShapeDtypeStruct:
            return jax.ShapeDtypeStruct((block, *leaf.shape[1:]), leaf.dtype, sharding=where)

        return jax.tree.map(of, tree)


def _of_one(judge: Callable, key: Key, lane: jax.Array, held: tuple[Any, Any, Any]) -> Any:
    """What is judged of one run of a block, of which no more is copied than is looked at."""
    state, data, hparams = jax.tree.map(itemgetter(lane), held)
    return judge(state, data, key, hparams)


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


@dataclass
class _Pool:
    """All runs of a play. Those that are not over are in blocks: a worker takes the least advanced
    of those that wait on its device, plays a piece of it and gives it back. Where those that wait
    at the same unit have so few runs left that these fit into fewer blocks, they are packed anew.
    More are begun than there are workers, so that some wait; nobody waits for another's piece.
    """

    engine: Engine
    programs: Sequence[_Program]  #: of each worker
    runs: Runs
    collected: Any
    over: Over | None
    store: Store | None
    say: Progress
    log: Sequence[Logger]

    def __post_init__(self) -> None:
        store, self.began, self.done = self.store, time.perf_counter(), 0
        self.earlier_s = store.seconds(self.runs.row.tolist()) if store else 0.0
        self.lock, self.telling, self.failed = threading.Lock(), threading.Lock(), threading.Event()
        self.keys, self.judging = self.runs.keys, self.runs.judging
        self.size, units = self.programs[0].work.block, self.runs.units
        kept = {row: (store and store.load(number)) or Kept()
                for row, number in enumerate(self.runs.row.tolist())}  # fmt: skip
        self.curves = {row: run.metrics for row, run in kept.items() if run.over}
        differ = units.min() < units.max() or len({run.done for run in kept.values()}) > 1
        self.may_shrink = self.size > 1 and (self.over is not None or differ)
        if played := sum(run.done for run in kept.values()):
            self.tell(played)
        self.unbegun = _blocks({row: run for row, run in kept.items() if not run.over}, self.size)
        self.waiting: list[_Block] = []

    def tell(self, units: int) -> None:
        """So many units more are played."""
        with self.telling:
            self.done += units
            self.say("running", self.done // len(self.runs.seed), len(self.curves))

    def save(self, row: int, run: Kept) -> None:
        """Writes a run's checkpoint, where any are."""
        if self.store:
            self.store.save(int(self.runs.row[row]), run, self.seconds())

    def seconds(self) -> float:
        """Since the work began, with those before a resume."""
        return self.earlier_s + time.perf_counter() - self.began

    def serve(self, program: _Program) -> None:
        """Plays until nothing is left for this worker; stopped, it saves what waits."""
        block = None
        try:
            while block := self._next(program, block):
                block.play()
        except BaseException:
            self.failed.set()
            raise
        finally:
            while self._stopped() and (block := self._any()):
                block.save()

    def _stopped(self) -> bool:
        return self.failed.is_set() or self.engine.interrupted.is_set()

    def _any(self) -> _Block | None:
        with self.lock:
            return self.waiting.pop() if self.waiting else None

    def _next(self, program: _Program, played: _Block | None) -> _Block | None:
        """The next for a worker that gives back what it has played; None where there is none."""
        with self.lock:
            if played is not None and played.live:
                self.waiting.append(played)
                self._pack(program, played.done)
            if self._stopped():
                return None
            if all(block.program is not program for block in self.waiting):
                self._begin(program)
            if not self.waiting:
                return None
            block = min(self.waiting, key=lambda block: (block.program is not program, block.done))
            moved = block.program is not program  # from another device
            taken = _Block(self, program, block.kept(), block.saved_s) if moved else block
            self.waiting.remove(block)
            return taken

    def _pack(self, program: _Program, done: int) -> None:
        """Of those that wait on its device those at unit ``done`` into as few as can be."""
        same = [one for one in self.waiting if one.program is program and one.done == done]
        if -(-sum(len(block.live) for block in same) // self.size) == len(same):
            return
        kept = {row: run for block in same for row, run in block.kept().items()}
        saved_s = min(block.saved_s for block in same)
        fewer = [_Block(self, program, runs, saved_s) for runs in _blocks(kept, self.size)]
        self.waiting = [block for block in self.waiting if block not in same] + fewer

    def _begin(self, program: _Program) -> None:
        """One, or where they can be packed what memory affords; other devices get their share."""
        fit = 1
        if self.may_shrink:
            most = BEGUN * self.programs.count(program)
            fit = max(spare(used_by(program.calls["piece"]), most, program.place), 1)
        for _ in range(min(fit, -(-len(self.unbegun) // len({*self.programs})))):
            runs = self.unbegun.pop(0)
            self.waiting.append(_Block(self, program, runs, time.perf_counter()))


def _blocks(kept: Mapping[int, Kept], size: int) -> list[dict[int, Kept]]:
    """Runs at the same unit, so many of them together; the most advanced first."""
    units = sorted({run.done for run in kept.values()}, reverse=True)
    rows = ([row for row in sorted(kept) if kept[row].done == done] for done in units)
    parts = (some[first : first + size] for some in rows for first in range(0, len(some), size))
    return [{row: kept[row] for row in part} for part in parts]


class _Block:
    """Runs that are computed together, all of them at the same unit; filled up with copies.

    Attributes:
        live: the lane of each run that is not over.
        done: units played.
        before: the runs as they were kept, until they are on the device.
        saved_s: when they were saved the last time, or begun.
    """

    def __init__(self, pool: _Pool, program: _Program, kept: dict[int, Kept], saved_s: float):
        self.pool, self.program, self.work, self.before = pool, program, program.work, kept
        self.live = {row: lane for lane, row in enumerate(kept)}
        rows = [*kept]
        self.rows = np.array(rows + rows[:1] * (self.work.block - len(rows)))
        self.done, self.saved_s = kept[rows[0]].done, saved_s

    def kept(self) -> dict[int, Kept]:
        """Its runs that are not over, on the host."""
        if self.before:
            return self.before
        arrays = named_leaves(self.state), self.pieces
        return {
            row: Kept(self.done, *jax.tree.map(itemgetter(lane), arrays))
            for row, lane in self.live.items()
        }

    def save(self) -> None:
        """Writes a checkpoint of each of its runs."""
        if self.pool.store and self.done:
            for row, run in self.kept().items():
                self.pool.save(row, run)
        self.saved_s = time.perf_counter()

    def _begin(self) -> None:
        """Puts its runs on the device."""
        pool, program = self.pool, self.program
        self.hparams = self._put(jax.tree.map(itemgetter(self.rows), pool.runs.hparams))
        self.state = program.calls["start"](self._put(pool.keys[self.rows]), self.hparams)
        self.data, self.pieces = None, Curves()
        if making := program.calls.get("data"):
            self.data = making(self._put(pool.keys[self.rows]), self.hparams)
        if pool.collected is not None:
            self.data = self._put(jax.tree.map(itemgetter(self.rows), pool.collected))
        if self.done:
            kept = [self.before[row] for row in self.rows]
            self.state = stacked([run.state for run in kept], self.state, program.place)
            self.pieces = stack([run.metrics for run in kept])
        self.before = {}

    def play(self) -> None:
        """A piece, or up to the next unit that is a run's last."""
        if self.before:
            self._begin()
        end = min(int(self.pool.runs.units[row]) for row in self.live)
        count = min(self.work.piece - self.done % self.work.piece, end - self.done)
        first, number = self._put((np.int32(self.done), np.int32(count)))
        piece = self.program.calls["piece"]
        self.state, metrics = piece(self.state, self.data, first, number, self.hparams)
        new = {name: _said(values)[:, :count] for name, values in metrics.items()}
        self.pieces = {
            name: np.concatenate([self.pieces[name], values], axis=1) if self.done else values
            for name, values in new.items()
        }
        self.done += count
        self._log()
        played, ended = len(self.live), self._ended()
        for row in ended:
            curves = self._judged(row, self.live.pop(row))
            self.pool.save(row, Kept(self.done, metrics=curves, over=True))
            self.pool.curves[row] = curves
        self.pool.tell(count * played)
        if self.live and self.pool.store and self.pool.store.due(self.saved_s):
            self.save()

    def _log(self) -> None:
        """Tells of each run's last piece, where `_ended` looks."""
        whole, units = self.done % self.work.piece == 0, self.pool.runs.units
        first = (self.done - 1) // self.work.piece * self.work.piece
        for row, lane in self.live.items():
            if self.pool.log and (whole or units[row] == self.done):
                means = _means({name: each[lane, first:] for name, each in self.pieces.items()})
                with self.pool.telling:
                    self.pool.log[row].log(self.done, means)

    def _ended(self) -> list[int]:
        """Its runs that have just come to their ends. Looked at after whole pieces and after a
        run's own last unit only, so that it does not matter who else is in the block.
        """
        over = np.zeros(len(self.rows), bool)
        if self.done % self.work.piece == 0:
            if self.pool.over is not None:
                over = self.pool.over(self.pieces)
            if DIVERGED in self.pieces:
                over = over | self.pieces[DIVERGED].any(1)
        units = self.pool.runs.units
        return [row for row, lane in self.live.items() if over[lane] or units[row] == self.done]

    def _judged(self, row: int, lane: int) -> Curves:
        """The curves of a run up to now, and what is judged of it."""
        first = self.pool.runs.seed[row] == 0
        broken = self.pieces[DIVERGED][lane] if DIVERGED in self.pieces else np.zeros(1)
        end = broken.argmax() + 1 if broken.any() else self.done
        curves = {
            name: values[lane][:end]
            for name, values in self.pieces.items()
            if first or not name.startswith(SHOWN)
        }
        calls, whole = self.program.calls, not broken.any()
        kept = whole and self.pool.runs.seed[row] < self.pool.engine.keep
        asked = {"judge": True, "show": first and whole, "keep": kept}
        held, own = (self.state, self.data, self.hparams), self.pool.judging[row]
        for name in (name for name in HOOKS if asked[name] and name in calls):
            key = jax.random.fold_in(own, HOOKS.index(name))
            judged = calls[name](*self._put((key, np.int32(lane))), held)
            if name == "keep":
                hparams = jax.tree.map(itemgetter(row), self.pool.runs.hparams)
                judged = told_of(judged, calls["play"](judged, key, hparams))
            prefix = SHOWN if name == "show" else ""
            found = {f"{prefix}{name}": _said(values) for name, values in judged.items()}
            if not whole:  # whatever a broken run does is no result
                found = {name: np.full(values.shape, np.nan, np.float32)
                         for name, values in found.items()}  # fmt: skip
            curves |= found
        return curves

    def _put(self, tree: Any) -> Any:
        return jax.device_put(tree, self.program.place)


def _means(metrics: Curves) -> dict[str, float]:
    """Of a run's metrics that are numbers, over what is finite, up to where it breaks."""
    broken, means = metrics.get(DIVERGED, np.zeros(1)), {}
    whole = np.cumsum(broken) <= broken
    for name, values in metrics.items():
        if values.ndim == 1 and not name.startswith(SHOWN):
            counted = values[whole & np.isfinite(values)]
            if counted.size:
                means[name] = float(counted.mean(dtype=np.float64))
    return means


def _said(values: Any) -> np.ndarray:
    """On the host, NaN where work was skipped (`jaxdyna.dyna.conditional.nothing`)."""
    values = np.asarray(values)
    debugging = jax.config.jax_debug_nans and values.dtype.kind == "f"  # type: ignore[attr-defined]
    return np.where(values == -np.inf, np.nan, values) if debugging else values


def joined(curves: Sequence[Curves]) -> Curves:
    """Arrays ``[runs, ...]`` of several runs, each filled up with NaN after its own end; what is
    shown is the first's that has it; a number that a run has not is NaN.
    """
    arrays: Curves = {}
    for name in dict.fromkeys(name for run in curves for name in run):
        shown = name.startswith(SHOWN)
        values = [run.get(name, np.nan) for run in curves if name in run or not shown]
        arrays[name] = np.asarray(values[0]) if shown else _filled([*map(np.asarray, values)])
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
