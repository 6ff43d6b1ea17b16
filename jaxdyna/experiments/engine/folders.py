"""The folder of a run: whose it is, who works in it, and what becomes of an earlier result.

Nothing is moved or removed but what a run of jaxdyna has written: `files` of a record, and the
checkpoints that lie beside their ``settings.json``.
"""

import fcntl
import os
import re
import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import Any

from jaxdyna.experiments.engine import progress, storage
from jaxdyna.experiments.engine.checkpoint import checkpoints_below
from jaxdyna.experiments.engine.trained import FOLDER

LOCK, PREVIOUS, PARTS, CHECKPOINTS = ".lock", "previous", "parts", "checkpoints"
PAGE = "report.html"
UNKEPT = PAGE, progress.LOG  #: in the lab book
FIGURE = re.compile(r"!\[[^\]]*\]\(([^()/]+)\)")
MOVING = ".moving"


@contextmanager
def held(folder: Path, alone: bool = True) -> Iterator[Any]:
    """The folder, made where there is none, for this process alone, or with others of its run, once
    the first of them may `share` the lock; the system lets go of it however the process ends.
    `ValueError` where it cannot be written to, or another run works in it.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = _locked(folder, fcntl.LOCK_EX if alone else fcntl.LOCK_SH)
    except OSError as error:
        raise ValueError(
            f"cannot write to --out {folder} ({error.strerror}): choose another folder"
        ) from None
    try:
        yield file
    finally:
        with suppress(BlockingIOError):  # others of its run still hold it
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            (folder / LOCK).unlink(missing_ok=True)
        file.close()


def share(lock: Any) -> None:
    """Lets other processes of a run hold its folder, too, but no other run."""
    fcntl.flock(lock, fcntl.LOCK_SH)


def _locked(folder: Path, how: int) -> Any:
    while True:
        file = (folder / LOCK).open("a+")
        try:
            fcntl.flock(file, how | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            holder = file.read().strip() or "another process"
            file.close()
            raise ValueError(
                f"--out {folder} is in use by {holder}: wait for it, or choose another folder"
            ) from None
        path = folder / LOCK
        if path.exists() and path.stat().st_ino == os.fstat(file.fileno()).st_ino:
            break
        file.close()  # its holder removed it in between
    if how == fcntl.LOCK_SH:
        return file
    file.truncate(0)
    file.write(f"process {os.getpid()} on {socket.gethostname()}")
    file.flush()
    return file


def claim(folder: Path, whose: Mapping[str, str], fresh: bool) -> None:
    """Makes the folder ready for a run that begins: an earlier result goes into a folder of
    ``previous``, or where version control has all of it, goes. `ValueError` where there is what no
    such run has written, or unfinished work; nothing has been touched then.

    Args:
        folder: held by this process.
        whose: ``experiment`` and ``part`` of the run.
        fresh: whether unfinished work may be dropped.
    """
    begun = storage.read_json(folder / CHECKPOINTS / "settings.json")
    results = storage.read_json(folder / "results.json")
    moving = folder / PREVIOUS / MOVING
    known = [about for about in (begun, results) if about is not None]
    others = _names(folder) - {LOCK, PREVIOUS, PARTS, CHECKPOINTS}
    strange = begun is None and _names(folder / CHECKPOINTS) - {"settings.part.json"}
    unknown = others and not known and not moving.exists()
    if strange or unknown or not all(is_of(about, whose) for about in known):
        raise ValueError(f"--out {folder} has files of no such run: choose an empty folder")
    played = _names(folder / CHECKPOINTS) - {"settings.json"} or results is not None
    if begun is not None and played and not fresh:
        raise ValueError(
            f"--out {folder} has the unfinished work of a run: --resume goes on with it, --fresh "
            "drops it"
        )
    if begun is not None:
        clear(folder / CHECKPOINTS)
    if files(folder) or moving.exists():
        _set_aside(folder)


def clear(checkpoints: Path) -> None:
    """Removes what a run has written there, and folders that are empty then."""
    told = [path for of in ("settings", "measured") for path in checkpoints.glob(f"{of}*.json")]
    for file in (*told, *checkpoints_below(checkpoints)):
        file.unlink(missing_ok=True)
    for emptied in (*checkpoints.glob("*/"), checkpoints):
        with suppress(OSError):
            emptied.rmdir()


def files(folder: Path) -> list[Path]:
    """What a record in this folder consists of: the figures are those that its report shows; what
    is kept, and who was told of it, are folders; ``results.json``, which tells whose it is, last.
    """
    report = folder / "report.md"
    shown = FIGURE.findall(report.read_text(encoding="utf-8")) if report.is_file() else []
    told = PAGE, "report.md", FOLDER, *progress.LEFT
    names = dict.fromkeys([*shown, *told, "curves.npz", "results.json"])
    return [folder / name for name in names if (folder / name).exists()]


def _set_aside(folder: Path) -> None:
    """Moves a record's files, each by a rename, and names their new folder once all are there: a
    kill in between leaves what the next run moves on.
    """
    record = files(folder)
    if _in_version_control(folder, [file for file in record if file.name not in UNKEPT]):
        for file in record:
            file.unlink()
        return
    moving = folder / PREVIOUS / MOVING
    moving.mkdir(parents=True, exist_ok=True)
    for file in record:
        file.rename(moving / file.name)
    stamp = name = datetime.now().strftime("%Y-%m-%d-%H%M%S")
    number = 1
    while (folder / PREVIOUS / name).exists():
        number += 1
        name = f"{stamp}-{number}"
    moving.rename(folder / PREVIOUS / name)


def _names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()} if folder.is_dir() else set()


def _in_version_control(folder: Path, record: list[Path]) -> bool:
    """Whether git has all of these files as they are."""
    names = [file.name for file in record if file.is_file()]
    asked = ("ls-files", "--error-unmatch"), ("diff", "--quiet", "HEAD")
    whole = 0 < len(names) == len(record)  # what is kept is never removed
    return whole and None not in [storage.git(folder, *each, "--", *names) for each in asked]


def is_of(about: Any, whose: Mapping[str, str]) -> bool:
    """Whether a ``results.json`` or ``settings.json`` is of such a run; before there were parts an
    experiment's name began with its family's.
    """
    if not isinstance(about, dict) or "config" not in about:
        return False
    if "part" not in about:
        return str(about.get("experiment")).startswith(whose["experiment"])
    return all(about.get(name) == value for name, value in whose.items())
