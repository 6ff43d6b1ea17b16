"""Rivals, which are no part of the package, and commands, each in a process of its own."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from functools import cache, partial
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple
from unittest.mock import patch

from jaxdyna.experiments.benchmark.timing import PYTORCH, Work
from jaxdyna.experiments.engine import Curves, InputError, Results, programs, storage

PACKAGE = "jaxdyna.experiments"
#: a cache of programs that is not ours: with it no start is cold
OTHERS = ("JAX_COMPILATION_CACHE_DIR",)
EXAMPLES = storage.PACKAGE.parent / "docs" / "examples"  #: where the rivals are, in a checkout
STAND_ON = ("torch", "ale_py")  #: and what this package needs
#: a small process that starts the one that is measured: on Linux a new process's peak of memory is
#: at least that of the one that started it
BETWEEN = """import json, resource, subprocess, sys, time
began = time.perf_counter()
ran = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
used = resource.getrusage(resource.RUSAGE_CHILDREN)
unit = 1 if sys.platform == "darwin" else 1024
print(json.dumps([time.perf_counter() - began, used.ru_maxrss * unit, ran.returncode, ran.stderr]))
"""


@cache
def rival(name: str) -> Any:
    """A module of `EXAMPLES`; None where it is not there, or what it stands on is not installed."""
    try:
        with patch.object(sys, "path", [str(EXAMPLES), *sys.path]):
            return import_module(name)
    except ModuleNotFoundError as error:
        if error.name in (name, *STAND_ON):
            return None
        raise


def versions() -> Results:
    """Of what rivals alone stand on, as far as it was used."""
    return {name: version(name) for name in STAND_ON if name in sys.modules}


def by_threads(theirs: Any, call: Callable[[], Any], units: float) -> dict[str, Work | None]:
    """A call of a `rival` in PyTorch as work of so many units, by one thread and by one a core:
    which is the faster depends on the work and on who else uses the machine. None without it.
    """
    if theirs is None:
        return {PYTORCH: None}

    def work(count: int) -> float:
        theirs.torch.set_num_threads(count)
        call()
        return units

    counts = sorted({1, storage.cores()})
    return {f"{PYTORCH}, threads: {count}": partial(work, count) for count in counts}


class Ran(NamedTuple):
    """A process that has ended: seconds by the clock on the wall, and the peak of its memory."""

    seconds: float
    peak_bytes: int


def command(*argv: Any, cache: Path | None = None) -> Ran:
    """Runs Python with these arguments, compiled programs in a folder of their own if anywhere.
    `InputError` where it fails, with the last line of what it says.
    """
    words = [sys.executable, "-c", BETWEEN, sys.executable, *map(str, argv)]
    kept = {name: value for name, value in os.environ.items() if name not in OTHERS}
    environment = kept | ({programs.FOLDER: str(cache)} if cache else {})
    told = subprocess.run(words, env=environment, text=True, stdout=subprocess.PIPE, check=True)
    seconds, peak, code, said = json.loads(told.stdout)
    if code:
        last = (said.strip().splitlines() or ["nothing said"])[-1]
        raise InputError(f"python {' '.join(words[4:6])} ended with code {code}: {last}")
    return Ran(seconds, peak)


def played(
    world: str, *flags: Any, cache: Path | None = None
) -> tuple[Ran, Results, dict[str, Curves]]:
    """A world's command, cold where there is no cache: its process, ``results.json`` and curves."""
    with TemporaryDirectory() as folder:
        out = Path(folder, "result")
        how = () if cache else ("--no-cache",)
        ran = command("-m", f"{PACKAGE}.{world}", *flags, *how, "--out", out, cache=cache)
        return ran, storage.read_json(out / "results.json"), storage.read_curves(out / "curves.npz")
