"""Files of a result: strict JSON, arrays, text; each written whole or not at all. And where it was
made.
"""

import hashlib
import json
import platform
import resource
import subprocess
import sys
import zipfile
import zlib
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxdyna
from jaxdyna.experiments.engine.work import cores

Curves = Mapping[str, np.ndarray]
Results = dict[str, Any]
PACKAGES = ("jax", "jaxlib", "flax", "optax", "numpy", "gymnasium")
PACKAGE = Path(jaxdyna.__file__).parent


def write_json(path: Path, results: Results) -> None:
    """Writes strict JSON; what is not finite becomes null."""
    write_text(path, json.dumps(_finite(results), indent=1, allow_nan=False) + "\n")


def read_json(path: Path) -> Any:
    """Reads it; None where there is no file.

    Raises:
        ValueError: where it is not whole.
    """
    try:
        return json.loads(path.read_text()) if path.exists() else None
    except json.JSONDecodeError as error:
        raise ValueError(f"{path} is not whole ({error}): run without --resume") from None


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _finite(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, np.generic):
        return _finite(value.item())
    return None if isinstance(value, float) and not np.isfinite(value) else value


def write_curves(path: Path, arms: Mapping[str, Curves]) -> None:
    """Writes every array as ``NAME/array``."""
    flat = {
        f"{arm}/{name}": values for arm, curves in arms.items() for name, values in curves.items()
    }
    part = path.with_suffix(".part.npz")
    np.savez_compressed(part, **flat)  # type: ignore[arg-type]
    part.replace(path)


def read_curves(path: Path) -> dict[str, dict[str, np.ndarray]]:
    """Reads what `write_curves` wrote; nothing where there is no file.

    Raises:
        ValueError: where the file is damaged.
    """
    arms: dict[str, dict[str, np.ndarray]] = {}
    if path.exists():
        try:
            with path.open("rb") as file, np.load(file) as stored:
                for name in stored.files:
                    arm, _, array = name.rpartition("/")
                    arms.setdefault(arm, {})[array] = stored[name]
        except (zipfile.BadZipFile, EOFError, OSError, zlib.error) as error:
            raise ValueError(f"{path} is damaged ({error}): play it again") from error
    return arms


def write_text(path: Path, text: str) -> None:
    """Writes a text file."""
    part = path.with_name(path.name + ".part")
    part.write_text(text, encoding="utf-8", errors="surrogateescape")
    part.replace(path)


def provenance(earlier: Results | None = None) -> Results:
    """``versions``, ``commit``, ``source`` (a hash of this package) and ``device``; of memory the
    most that this process or, where it goes on with an ``earlier`` one's, that one has taken.
    """
    device = jax.devices()[0]
    before = ((earlier or {}).get("device") or {}).get("peak_memory_gib")
    return {
        "versions": {"jaxdyna": jaxdyna.__version__, "python": platform.python_version()}
        | {name: version(name) for name in PACKAGES},
        "commit": commit(),
        "source": source(),
        "device": {
            "platform": device.platform,
            "kind": device.device_kind,
            "count": jax.device_count(),
            "cpu_cores": cores(),
            "peak_memory_gib": max(peak_memory_gib(), before or 0.0),
        },
    }


def commit() -> Results | None:
    """The checkout's commit and whether it was clean; None where this package is in none."""

    def ask(*words: str) -> str:
        command = ["git", "-C", str(PACKAGE), *words]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        if Path(ask("rev-parse", "--show-toplevel")) != PACKAGE.parent.resolve():
            return None
        return {"id": ask("rev-parse", "HEAD"), "clean": not ask("status", "--porcelain", ".")}
    except (OSError, subprocess.CalledProcessError):
        return None


def source() -> str:
    """A hash of this package's code: commits elsewhere do not change it."""
    digest = hashlib.sha256()
    for path in sorted(PACKAGE.rglob("*.py")):
        digest.update(str(path.relative_to(PACKAGE)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


def peak_memory_gib() -> float:
    """The most of the machine's own memory that this process has taken so far."""
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**30
