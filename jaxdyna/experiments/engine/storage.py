"""Files of a result: strict JSON, arrays, text; each written whole or not at all, and checked when
it is read. And where it was made.
"""

import hashlib
import io
import json
import os
import platform
import resource
import subprocess
import sys
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxdyna

Curves = Mapping[str, np.ndarray]
Results = dict[str, Any]
PACKAGES = ("jax", "jaxlib", "flax", "optax", "numpy", "gymnasium")
WORLDS = ("gxm", "gymnax", "craftax")  #: that have worlds, where these are played
CHECKSUM = "checksum"
#: what reading a file of arrays can end in
DAMAGED = (
    KeyError, OSError, EOFError, ValueError, RuntimeError, zipfile.BadZipFile, zlib.error
)  # fmt: skip
PACKAGE = Path(jaxdyna.__file__).resolve().parent


class InputError(ValueError):
    """What a user can mend, found in mid-run; what was played is saved."""


def unwritten(path: Path, error: OSError) -> InputError:
    """What to say of a file that cannot be written."""
    why = os.strerror(error.errno) if error.errno else str(error)
    return InputError(
        f"cannot write {path} ({why}): mend that; the same command with --resume goes on"
    )


@contextmanager
def written(path: Path, before: Path | None = None) -> Iterator[Path]:
    """A file to write to, which takes the place of ``path`` once it is whole; what was there
    becomes the file ``before``, or goes. `InputError` where it cannot: what was there stays.
    """
    part = path.with_name(f"{path.stem}.part{path.suffix}")
    try:
        yield part
        if before and path.exists():
            path.replace(before)
        part.replace(path)
    except OSError as error:
        with suppress(OSError):
            part.unlink(missing_ok=True)
        raise unwritten(path, error) from None


def write_json(path: Path, results: Results) -> None:
    """Writes strict JSON with a checksum of it; what is not finite becomes null."""
    told = _finite({name: value for name, value in results.items() if name != CHECKSUM})
    write_text(path, _dumped(told | {CHECKSUM: _digest(told)}))


def read_json(path: Path) -> Any:
    """Reads it; None where there is no file. One without a checksum, of an earlier version, passes.
    `ValueError` where it is not what was written.
    """
    if not path.exists():
        return None
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(told, dict) or told.pop(CHECKSUM, None) not in (None, _digest(told)):
            raise ValueError("it is not what was written")
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(
            f"{path} is damaged or was changed ({error}): restore it, or where the change is your "
            f"own take its {CHECKSUM} out; or choose another folder"
        ) from None
    return told


def _dumped(told: Results) -> str:
    return json.dumps(told, indent=1, allow_nan=False) + "\n"


def _digest(told: Results) -> str:
    return hashlib.sha256(_dumped(told).encode()).hexdigest()


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _finite(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, np.generic):
        return _finite(value.item())
    return None if isinstance(value, float) and not np.isfinite(value) else value


def write_arrays(
    path: Path, arrays: Curves, compressed: bool = False, before: Path | None = None,
    whose: str = "",
) -> None:  # fmt: skip
    """Writes arrays by name into one NumPy file; ``before``: see `written`; ``whose``: owner."""
    save: Any = np.savez_compressed if compressed else np.savez
    with written(path, before) as part:
        with part.open("wb") as file:
            save(file, **arrays)
        with zipfile.ZipFile(part, "a") as whole:
            whole.comment = f"{_contents(whole)} {whose}".strip().encode()


def read_arrays(path: Path, only: Sequence[str] = (), whose: str = "") -> dict[str, np.ndarray]:
    """Reads what `write_arrays` wrote, or only some of it. Whole members: at their ends their own
    checksums are looked at. Files of an earlier version, without one of all, pass. `ValueError`
    where the file is damaged.
    """
    try:
        with zipfile.ZipFile(path) as file:
            contents, _, owner = file.comment.decode().partition(" ")
            if contents not in ("", _contents(file)):
                raise ValueError("its checksum differs")
            if owner and whose and owner != whose:
                raise ValueError("it is another run's than results.json")
            names = [f"{name}.npy" for name in only] or file.namelist()
            return {
                name.removesuffix(".npy"): np.lib.format.read_array(io.BytesIO(file.read(name)))
                for name in names
            }
    except DAMAGED as error:
        raise ValueError(f"{path} is damaged ({error})") from None


def _contents(file: zipfile.ZipFile) -> str:
    """A checksum of the names and the checksums of all members."""
    said = "\n".join(f"{member.filename} {member.CRC}" for member in file.infolist())
    return hashlib.sha256(said.encode()).hexdigest()


def identity(results: Results) -> str:
    """A hash of which runs a ``results.json`` is of: that of its curves says the same."""
    config = {name: value for name, value in results["config"].items() if name != "arms"}
    said = [results.get(name) for name in ("experiment", "part", "sweep")]
    return _digest(_finite({"runs": [*said, results["runs"]["seeds"], config]}))


def write_curves(path: Path, arms: Mapping[str, Curves], whose: str = "") -> None:
    """Writes every array as ``NAME/array``; ``whose``: the `identity` of their results."""
    flat = {f"{arm}/{name}": one for arm, own in arms.items() for name, one in own.items()}
    write_arrays(path, flat, compressed=True, whose=whose)


def read_curves(path: Path, whose: str = "") -> dict[str, dict[str, np.ndarray]]:
    """Reads what `write_curves` wrote; nothing where there is no file. `ValueError` where the file
    is damaged, or of another `identity` than ``whose``.
    """
    arms: dict[str, dict[str, np.ndarray]] = {}
    try:
        arrays = read_arrays(path, whose=whose) if path.exists() else {}
        for name, values in arrays.items():
            arm, _, array = name.rpartition("/")
            arms.setdefault(arm, {})[array] = values
    except ValueError as error:
        raise ValueError(f"{error}: restore it, or remove it to play all of it again") from None
    return arms


def write_text(path: Path, text: str) -> None:
    """Writes a text file."""
    with written(path) as part:
        part.write_text(text, encoding="utf-8", errors="surrogateescape")


def made_with(modules: Iterable[str]) -> Results:
    """What a run's numbers depend on beside its settings: ``versions``, ``source``, a hash of the
    code, and of the ``device`` the platform, x64 and ``threads``, into which XLA divides sums on a
    CPU: as many as there are cores, or as ``NPROC`` says.

    Args:
        modules: those that define the experiment.
    """
    played = [name for name in WORLDS if name in sys.modules]
    packages = {name: version(name) for name in (*PACKAGES, *played)}
    python = {"jaxdyna": jaxdyna.__version__, "python": platform.python_version()}
    device = {"platform": jax.default_backend(), "x64": jax.config.jax_enable_x64}  # type: ignore[attr-defined]
    if device["platform"] == "cpu":
        device["threads"] = threads()
    return {"versions": python | packages, "source": source(modules), "device": device}


def changes(before: Results, now: Results) -> str:
    """What of `made_with` has changed, in words."""
    then, versions = before["versions"] or {}, now["versions"]
    said = [f"{name} {then[name]} (now {new})" for name, new in versions.items()
            if then.get(name, new) != new]  # fmt: skip
    if before["source"] != now["source"]:
        said.append("other code of jaxdyna or of the experiment")
    then = before["device"] or {}
    mend = {"threads": f"; NPROC={then.get('threads')} makes it so"}
    said += [f"{name} {then.get(name)} (now {value}){mend.get(name, '')}"
             for name, value in now["device"].items() if then.get(name) != value]  # fmt: skip
    return ", ".join(said)


def provenance(made: Results, earlier: Results | None) -> Results:
    """`made_with` with the ``commit`` and all of ``device``; of memory the most that this process
    or, where it goes on with an ``earlier`` one's, that one has taken.
    """
    before = ((earlier or {}).get("device") or {}).get("peak_memory_gib")
    device = {
        "kind": processor() if jax.default_backend() == "cpu" else jax.devices()[0].device_kind,
        "count": jax.device_count(),
        "cpu_cores": cores(),
        "peak_memory_gib": max(peak_memory_gib(), before or 0.0),
    }
    return made | {"commit": commit(), "device": made["device"] | device}


def git(folder: Path, *words: str) -> str | None:
    """What git says of a folder; None where it fails, or there is none."""
    command = ["git", "-C", str(folder), *words]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def commit() -> Results | None:
    """The checkout's commit and whether it was clean; None where this package is in none."""
    top = git(PACKAGE, "rev-parse", "--show-toplevel")
    if top is None or Path(top) != PACKAGE.parent.resolve():
        return None
    head, others = git(PACKAGE, "rev-parse", "HEAD"), git(PACKAGE, "status", "--porcelain", ".")
    return None if head is None or others is None else {"id": head, "clean": not others}


def source(modules: Iterable[str] = ()) -> str:
    """A hash of this package's code, and where these modules are not its own of all that are loaded
    from their folders: commits elsewhere do not change it.
    """
    files = {path: path.relative_to(PACKAGE) for path in PACKAGE.rglob("*.py")}
    loaded = [Path(file).resolve() for module in list(sys.modules.values())
              if (file := getattr(module, "__file__", None))]  # fmt: skip
    for name in modules:
        own = getattr(sys.modules.get(name), "__file__", None)
        home = Path(own).resolve().parent if own else PACKAGE
        if not home.is_relative_to(PACKAGE):
            files |= {
                path: path.relative_to(home) for path in loaded
                if path.is_relative_to(home) and path.suffix == ".py"
                and not path.is_relative_to(PACKAGE) and "site-packages" not in path.parts
            }  # fmt: skip
    digest = hashlib.sha256()
    for path, known in sorted(files.items(), key=lambda file: str(file[1])):
        digest.update(str(known).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


def cores() -> int:
    """CPU cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def processor() -> str:
    """The CPU's name, as far as the machine tells it."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def threads() -> int:
    """Among which XLA divides sums on a CPU."""
    return int(os.environ.get("NPROC") or cores())


def peak_memory_gib() -> float:
    """The most of the machine's own memory that this process has taken so far."""
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**30
