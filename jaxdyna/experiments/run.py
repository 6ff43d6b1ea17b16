"""The host loop of an experiment: jitted pieces, progress, checkpoints, and an end once solved."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna.dyna import Dyna, DynaConfig, DynaHParams, DynaState, make_advance, make_init
from jaxdyna.experiments.checkpoint import Checkpoints
from jaxdyna.statistics import SolveRule, episodes_to_solve
from jaxdyna.sweep import AXES, make_pieces

CHECKPOINT_SECONDS = 20.0
CHECKPOINT_SHARE = 0.05
PIECE_EPISODES = 50


class Arm(NamedTuple):
    """One side of a comparison: its parts, its counts and its swept values."""

    dyna: Dyna
    config: DynaConfig
    hparams: DynaHParams


class ArmRun(NamedTuple):
    """What an arm produced.

    Attributes:
        metrics: every array ``[seeds, episodes, ...]``.
        state: the final `DynaState`, leading axis ``[seeds]``.
        compile_s: seconds spent compiling; 0 where an earlier arm has the same program.
        run_s: seconds spent running, those before a resume included.
    """

    metrics: dict[str, np.ndarray]
    state: DynaState
    compile_s: float
    run_s: float


@dataclass
class Runner:
    """Runs arms one after the other.

    Attributes:
        keys: random keys ``[seeds]``; every arm gets the same.
        rule: when a run counts as solved.
        stop_after_solved: real episodes that an arm plays on once all its seeds have solved;
            None plays all.
        directory: where checkpoints live; None keeps none.
        block: seeds vmapped together on a CPU, see `jaxdyna.sweep.sweep`.
        piece: about as many episodes are played between two looks at the clock; None for 50.
        report: called with ``(stage, done, total, solved)`` whenever one of them changes.
    """

    keys: jax.Array
    rule: SolveRule
    stop_after_solved: int | None = None
    directory: Path | None = None
    block: int | None = None
    piece: int | None = None
    report: Callable[[str, int, int, int], None] = lambda *_: None
    programs: dict[Any, tuple[Any, Any]] = field(default_factory=dict)

    def run(self, name: str, arm: Arm, resume: bool = False) -> ArmRun:
        """Plays the arm to its end, from its last checkpoint where ``resume`` says so.

        Raises:
            KeyboardInterrupt: on Ctrl-C, after the piece in progress is done and saved.
        """
        total = arm.config.num_episodes
        piece = piece_length(total, self.piece or PIECE_EPISODES)
        checkpoints = Checkpoints(self.directory / name) if self.directory else None
        self.report("compiling", 0, total, 0)
        began = time.perf_counter()
        state, proceed = self._compile(arm, piece)
        compile_s, run_s = time.perf_counter() - began, 0.0
        pieces: list[dict[str, np.ndarray]] = []
        if resume and checkpoints and checkpoints.exists():
            state, pieces, run_s = checkpoints.load(state)
        saved, pause = time.perf_counter(), CHECKPOINT_SECONDS
        with deferred_interrupt() as interrupted:
            while not self._over(pieces, total):
                done = _episodes(pieces)
                self.report("running", done, total, int(self._solved(pieces).sum()))
                began = time.perf_counter()
                episodes = jnp.arange(done, min(done + piece, total))
                state, metrics = proceed(state, episodes, arm.hparams)
                pieces.append(jax.tree.map(lambda leaf: np.asarray(leaf[0]), metrics))
                run_s += time.perf_counter() - began
                wait = CHECKPOINT_SECONDS if self._over(pieces, total) else pause
                due = time.perf_counter() - saved > wait
                if checkpoints and (due or interrupted):
                    began = time.perf_counter()
                    checkpoints.save(_episodes(pieces), state, join(pieces), run_s)
                    saved = time.perf_counter()
                    pause = max(CHECKPOINT_SECONDS, (saved - began) / CHECKPOINT_SHARE)
                if interrupted:
                    raise KeyboardInterrupt
        self.report("done", _episodes(pieces), total, int(self._solved(pieces).sum()))
        return ArmRun(join(pieces), _only_setting(state), compile_s, run_s)

    def _compile(self, arm: Arm, piece: int) -> tuple[DynaState, Callable]:
        """The runs before their first episode, and what plays a piece of them."""
        known = (arm.dyna, arm.config)
        compiled = known in self.programs
        if not compiled:
            init = make_init(arm.dyna, arm.config)
            advance = make_advance(arm.dyna, arm.config, AXES)
            block = self.block if jax.default_backend() == "cpu" else None
            self.programs[known] = make_pieces(init, advance, block)
        start, proceed = self.programs[known]
        state = start(jax.random.clone(self.keys), arm.hparams)
        if not compiled:
            whole = proceed.lower(state, jnp.arange(piece), arm.hparams).compile()

            def proceed_any(state, episodes, hparams):
                return (whole if len(episodes) == piece else proceed)(state, episodes, hparams)

            self.programs[known] = (start, proceed_any)
        return state, self.programs[known][1]

    def _solved(self, pieces: list[dict[str, np.ndarray]]) -> np.ndarray:
        if not pieces:
            return np.zeros(len(self.keys), bool)
        return np.isfinite(episodes_to_solve(self.rule.score(join(pieces)), self.rule))

    def _over(self, pieces: list[dict[str, np.ndarray]], total: int) -> bool:
        done = _episodes(pieces)
        if done >= total or not pieces or self.stop_after_solved is None:
            return done >= total
        last = episodes_to_solve(self.rule.score(join(pieces)), self.rule).max()
        return done >= last + self.stop_after_solved


@partial(jax.jit, donate_argnums=0)
def _only_setting(state: DynaState) -> DynaState:
    """Without the axis of settings, in the same memory: no two replays are held at a time."""
    return jax.tree.map(lambda leaf: leaf.reshape(leaf.shape[1:]), state)


@jax.jit
def first_run(state: Any) -> Any:
    """The first run's part of what has an axis of runs in front; one program for all its leaves."""
    return jax.tree.map(lambda leaf: leaf[0], state)


def piece_length(total: int, about: int) -> int:
    """Episodes in a jitted piece: a divisor of ``total`` up to ``about`` and not far below it where
    there is one, so that one program serves.
    """
    divisors = [size for size in range(max(about // 5, 1), about + 1) if total % size == 0]
    return max(divisors, default=min(total, about))


def join(pieces: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Concatenates the pieces' metrics along their episodes."""
    return {name: np.concatenate([piece[name] for piece in pieces], axis=1) for name in pieces[0]}


def _episodes(pieces: list[dict[str, np.ndarray]]) -> int:
    return sum(piece["real_return"].shape[1] for piece in pieces)


@contextmanager
def deferred_interrupt() -> Iterator[list[int]]:
    """Collects Ctrl-C in the list it yields, so that a jitted call in progress can end first; a
    second Ctrl-C interrupts at once. Outside the main thread it does nothing.
    """
    received: list[int] = []

    def receive(signum, frame):
        if received:
            raise KeyboardInterrupt
        received.append(signum)

    try:
        before = signal.signal(signal.SIGINT, receive)
    except ValueError:  # not the main thread
        yield received
        return
    try:
        yield received
    finally:
        signal.signal(signal.SIGINT, before)
