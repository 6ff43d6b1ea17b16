"""Compiled programs, kept by JAX's own compilation cache from one start to the next.

JAX writes an entry in place and never writes it again: one that a killed process left half written
stays, and two processes may write the same one at a time. So each process caches in a folder of its
own, which begins with links to all entries that there are; what it has added, it puts beside them,
each by one link, once it is whole. JAX's key does not hold what a program for a CPU depends on
besides: the processor and the number of threads. So these name the folder.
"""

import fcntl
import hashlib
import os
import platform
import shutil
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from importlib import import_module
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import jax
from jax.experimental.compilation_cache.compilation_cache import reset_cache

from jaxdyna.experiments.engine.storage import threads

#: the environment variable that names another folder than the user's cache folder
FOLDER = "JAXDYNA_CACHE"
MOST_BYTES = 2**29
DIRECTORY = "jax_compilation_cache_dir"
HOW = {
    "jax_persistent_cache_min_compile_time_secs": 0.1,
    "jax_persistent_cache_enable_xla_caches": "none",  # their folder would be part of the key
}
ZSTANDARD = bytes.fromhex("28b52ffd")
ENTRIES, LOCK, PROCESS = "*-cache", "lock", "process-"


def home() -> Path:
    """The folder of all programs of this user."""
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(os.environ.get(FOLDER) or Path(cache) / "jaxdyna")


def machine() -> str:
    """A hash of this processor and of the threads into which programs are divided."""
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().split("\n\n")[0].splitlines()
        about = [line for line in lines if line.startswith(("model name", "flags", "Features"))]
        return hashlib.sha256("\n".join([*about, str(threads())]).encode()).hexdigest()[:16]
    return f"{platform.machine()}-{platform.processor()}-{threads()}".replace("/", "-")


@contextmanager
def kept() -> Iterator[Callable[[], None]]:
    """What is compiled meanwhile is kept, and what was kept is not compiled again; nothing of it
    where JAX has been told of a cache of its own, or the folder cannot be written to. Gives what
    shares the new entries with processes that start later, to be called while nothing is being
    compiled; it is called in the end, too.
    """
    before, share = {name: getattr(jax.config, name) for name in (DIRECTORY, *HOW)}, lambda: None
    with ExitStack() as stack:
        if not before[DIRECTORY]:
            with suppress(OSError):
                own = _begun(home() / machine(), stack)
                share = partial(_share, own)
                stack.callback(shutil.rmtree, own, ignore_errors=True)
                stack.callback(share)
                stack.callback(_configure, before)
                _configure({DIRECTORY: str(own), **HOW})
        yield share


def _configure(values: Mapping[str, Any]) -> None:
    for name, value in values.items():
        jax.config.update(name, value)
    reset_cache()  # it looks at its folder once


def _begun(folder: Path, stack: ExitStack) -> Path:
    """A folder for this process, linked to all entries of ``folder``, in which a lock tells others
    until the stack is closed that the process lives; before that `_tidy`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / LOCK).open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        _tidy(folder)
        own = Path(mkdtemp(prefix=PROCESS, dir=folder))
        held = stack.enter_context((own / LOCK).open("a"))
        fcntl.flock(held, fcntl.LOCK_EX)
        for entry in folder.glob(ENTRIES):
            (own / entry.name).hardlink_to(entry)
    return own


def _tidy(folder: Path) -> None:
    """Removes what killed processes left, and beyond `MOST_BYTES` what was not used for the longest
    time, on this kind of machine or another.
    """
    for left in folder.glob(f"{PROCESS}*"):
        with suppress(OSError), (left / LOCK).open("a") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(left, ignore_errors=True)
    room, others = MOST_BYTES, folder.parent.glob(f"*/{ENTRIES}")
    found = [(entry.stat(), entry) for entry in others]
    for about, entry in sorted(found, key=lambda one: -one[0].st_atime_ns):
        room -= about.st_size
        if room < 0:
            entry.unlink(missing_ok=True)


def _share(own: Path) -> None:
    for entry in own.glob(ENTRIES):
        shared = own.parent / entry.name
        with suppress(OSError):  # another process has put it there
            if not shared.exists() and _is_whole(entry.read_bytes()):
                shared.hardlink_to(entry)


def _is_whole(entry: bytes) -> bool:
    """Whether JAX could write all of it: on a full disk it warns, and leaves what it wrote."""
    with suppress(Exception):
        if not entry.startswith(ZSTANDARD):
            return bool(zlib.decompress(entry))
        for name in ("compression.zstd", "zstandard"):
            with suppress(ImportError):
                return bool(import_module(name).decompress(entry))
    return False


def optimised(level: int, place: jax.Device) -> dict[str, Any]:
    """To what level XLA optimises on a CPU: 1 takes less than half the time of 3."""
    option = "xla_backend_optimization_level"
    told = option in os.environ.get("XLA_FLAGS", "")
    return {} if told or level == 3 or place.platform != "cpu" else {option: level}
