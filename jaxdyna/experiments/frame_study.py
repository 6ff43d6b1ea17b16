"""What an experiment on frame prediction is made of, for `jaxdyna.experiments.frame_session`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
from rich.console import Console

from jaxdyna.types import Key


class Run(NamedTuple):
    """A run between two pieces of its training.

    Attributes:
        data: all its episodes, which a key gives again; None in a checkpoint.
        key: random key.
        state: the model's.
        done: int32, updates so far.
    """

    data: Any
    key: Key
    state: Any
    done: jax.Array


class Study(NamedTuple):
    """An arm's training at a stage, for `jaxdyna.sweep.make_pieces`. The stage, a number, and
    numbers of updates are traced: all stages are one program.

    Attributes:
        init: ``(key, hparams) -> run``: before its first update.
        train: ``(run, (stage, updates, total), hparams) -> (run, losses)``: so many more of the
            stage's ``total`` of updates.
        judge: ``(run, stage, hparams) -> (run, judgement)``.
        data: ``() -> data [1, seeds, ...]``: what a host has collected for `Run.data`; None
            where ``init`` has made it.
    """

    init: Callable[[Key, Any], Run]
    train: Callable[[Run, Any, Any], tuple[Run, dict[str, jax.Array]]]
    judge: Callable[[Run, Any, Any], tuple[Run, dict[str, jax.Array]]]
    data: Callable[[], Any] | None = None


class FrameExperiment(NamedTuple):
    """What differs from one experiment on frames to another. Its options have ``arms``, ``out``,
    ``resume``, ``seed``, ``seeds`` and ``stages_of(arm)``, the names of an arm's stages.

    Attributes:
        name: in ``results.json``.
        prog: the command as the user types it.
        out: the folder for the results, by default.
        make_study: ``(options, arm) -> Study``.
        updates_at: ``(options, arm, stage) -> updates``.
        number: from a stage's name to the number that `Study` takes.
        note: from a stage's name to what the progress bar says.
        describe: see `jaxdyna.experiments.frame_record.Record`.
        figures: ``(out, curves, options)``.
        markdown: ``(results, options, curves, out) -> text``.
        summary: ``(console, results)``: the closing table in the terminal.
    """

    name: str
    prog: str
    out: Path
    make_study: Callable[[Any, str], Study]
    updates_at: Callable[[Any, str, Any], int]
    number: Callable[[Any], int]
    note: Callable[[Any], str]
    describe: Callable[[Any, Any], Any]
    figures: Callable[[Path, Any, Any], None]
    markdown: Callable[[Any, Any, Any, Path], str]
    summary: Callable[[Console, Any], None]
