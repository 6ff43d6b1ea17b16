"""Files of an experiment: strict JSON, arrays, text; each written whole or not at all."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

Curves = Mapping[str, np.ndarray]
MANY_SEEDS = 50
SUMS = (
    "count", "state_error", "state_sum", "state_square", "change_sum", "change_square",
    "reward_error", "end_true", "end_error",
)  # fmt: skip


def slim(curves: Curves, above: int = MANY_SEEDS) -> dict[str, np.ndarray]:
    """What is kept of more than ``above`` runs, so that 1,000 of them fit a repository: the sums
    of `jaxdyna.models.evaluation.one_step_sums` become one ``model_error`` an episode: the squared
    error over the mean square of a step's change, averaged over the state's variables. Of what
    only films need (``film_...``) the first run is enough in any case.
    """
    curves = {
        name: values[:1] if name.startswith("film_") else values for name, values in curves.items()
    }
    if len(curves["real_return"]) <= above:
        return curves
    kept = {name: values for name, values in curves.items() if name not in (*SUMS, "agent_loss")}
    if "state_error" in curves:
        with np.errstate(invalid="ignore", over="ignore"):
            error = (curves["state_error"] / curves["change_square"]).mean(-1)
        kept["model_error"] = error.astype(np.float16)
    return kept


def plain(value: Any) -> Any:
    """Configuration as JSON: dataclasses become objects, functions their names."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {item.name: plain(getattr(value, item.name)) for item in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {name: plain(item) for name, item in value.items()}
    if isinstance(value, tuple | list):
        return [plain(item) for item in value]
    if isinstance(value, Path) or (isinstance(value, float) and not np.isfinite(value)):
        return str(value)
    if callable(value):
        return getattr(value, "__name__", type(value).__name__)
    return value


def write_json(path: Path, results: dict[str, Any]) -> None:
    """Writes strict JSON, whole or not at all; what is not finite becomes null."""
    text = json.dumps(_finite(results), indent=1, allow_nan=False) + "\n"
    _replace(path, text.encode())


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _finite(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def write_curves(path: Path, arms: Mapping[str, Curves]) -> None:
    """Writes every array as ``ARM/NAME``, whole or not at all."""
    flat = {
        f"{arm}/{name}": values for arm, curves in arms.items() for name, values in curves.items()
    }
    temporary = path.with_suffix(".part.npz")
    np.savez_compressed(temporary, allow_pickle=False, **flat)
    temporary.replace(path)


def read_curves(path: Path) -> dict[str, dict[str, np.ndarray]]:
    """Reads what `write_curves` wrote; nothing where there is no file."""
    arms: dict[str, dict[str, np.ndarray]] = {}
    if path.exists():
        with np.load(path) as stored:
            for name in stored.files:
                arm, _, metric = name.partition("/")
                arms.setdefault(arm, {})[metric] = stored[name]
    return arms


def set_aside(out: Path) -> None:
    """Moves an earlier run's results into the folder ``previous`` and drops its checkpoints."""
    shutil.rmtree(out / "checkpoints", ignore_errors=True)
    if not (out / "results.json").exists():
        return
    shutil.rmtree(out / "previous", ignore_errors=True)
    (out / "previous").mkdir()
    for pattern in ("results.json", "curves.npz", "report.md", "*.png", "*.gif"):
        for file in out.glob(pattern):
            file.rename(out / "previous" / file.name)


def write_text(path: Path, text: str) -> None:
    """Writes a text file, whole or not at all."""
    _replace(path, text.encode())


def _replace(path: Path, content: bytes) -> None:
    temporary = path.with_name(path.name + ".part")
    temporary.write_bytes(content)
    temporary.replace(path)
