"""Imports point one way, inside the experiments too."""

import ast
import itertools
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "jaxdyna"
FILES = sorted(PACKAGE.rglob("*.py"))
FLOORS = {
    **dict.fromkeys(["fields", "types", "trees"], 0),
    "actions": 1,
    **dict.fromkeys(["optimizers", "networks", "losses", "envs", "replay"], 2),
    **dict.fromkeys(["rollout", "watched"], 3),
    **dict.fromkeys(["agents", "models", "planners"], 4),
    **dict.fromkeys(["dyna", "testing"], 5),
    **dict.fromkeys(["sweep", "statistics"], 6),
    "experiments": 7,
    "play": 8,
}
EXPERIMENTS = PACKAGE / "experiments"
ROOMS = sorted(EXPERIMENTS.rglob("*.py"))
STOREYS = {
    "report": 0,
    "engine": 1,
    **dict.fromkeys(["study", "frames"], 2),
    **dict.fromkeys(["cartpole", "maze", "pong", "catch"], 3),
    **dict.fromkeys(["planning", "benchmark", "merge", "record", "evaluate", "compare", "any"], 4),
}
"""The reports below the engine: it writes them, they read its records as they come."""


def part_of(module: str) -> str:
    return module.split(".")[1] if "." in module else "jaxdyna"


def imports(path: Path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            above = ("jaxdyna", "jaxdyna.experiments", "flax")
            yield from names if node.module in above else [node.module]
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_down(path):
    here = path.relative_to(PACKAGE).with_suffix("").parts[0]
    if here == "__init__":
        return
    for module in imports(path):
        if module.startswith("jaxdyna."):
            there = part_of(module)
            assert there == here or FLOORS[there] < FLOORS[here], f"{here} imports {module}"
        if module.split(".")[0] == "gymnasium":
            assert path.name in ("gymnasium.py", "hosted.py")
        if module.startswith("flax"):
            assert here == "networks" or module == "flax.struct", f"{here}: {module}"


@pytest.mark.parametrize("path", ROOMS, ids=lambda path: str(path.relative_to(EXPERIMENTS)))
def test_rooms_of_experiments_stand_on_each_other(path):
    """Worlds never import each other; the engine and the reports know no world."""
    here = path.relative_to(EXPERIMENTS).with_suffix("").parts[0]
    if here == "__init__":
        return
    for module in imports(path):
        there = module.split(".")[2:3] if module.startswith("jaxdyna.experiments.") else []
        for room in there:
            assert room == here or STOREYS[room] < STOREYS[here], f"{here} imports {module}"


def test_what_is_imported_is_declared():
    project = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text())["project"]
    declared = itertools.chain(project["dependencies"], *project["optional-dependencies"].values())
    names = {each.partition(">=")[0].replace("-", "_") for each in declared}
    modules = {module.split(".")[0] for path in FILES for module in imports(path)}
    own = {"jaxdyna", *sys.stdlib_module_names}
    called = {"PIL": "pillow", "markdown_it": "markdown_it_py"}
    assert {called.get(name, name) for name in modules - own} <= names


def test_folders_stay_easy_to_see():
    for folder in {path.parent for path in ROOMS}:
        assert len(list(folder.glob("*.py"))) <= 15, folder


TOUCHES = """
import logging, pkgutil, sys
from importlib import import_module
from pathlib import Path
import matplotlib, numpy, jax, optax, flax  # what these set is their own
from absl import logging as absl

def settings():
    loggers = [logging.getLogger(name) for name in (None, "absl", "jax", "jaxdyna")]
    levels = [(logger.level, list(logger.handlers)) for logger in loggers]
    return matplotlib.rcParams._get_backend_or_none(), absl.get_verbosity(), levels

before = settings()
import jaxdyna
for module in pkgutil.walk_packages(jaxdyna.__path__, "jaxdyna."):
    if not module.name.endswith("__main__"):
        import_module(module.name)
jaxdyna.experiments.report.plots.solve_bars(Path("a.png"), {"a": numpy.arange(3)}, 3, "episodes")
assert settings() == before, (settings(), before)
assert "matplotlib.pyplot" not in sys.modules
from jax._src.xla_bridge import backends_are_initialized
assert not backends_are_initialized()
"""


def test_imports_touch_nothing(tmp_path):
    """No device, no logging, no backend of matplotlib, which drawing does not choose either."""
    environment = {name: value for name, value in os.environ.items() if name != "MPLBACKEND"}
    environment["PYTHONPATH"] = str(PACKAGE.parent)
    subprocess.run([sys.executable, "-c", TOUCHES], cwd=tmp_path, env=environment, check=True)


def test_one_loop_over_pieces():
    """Whatever is played, any world of the user's included, the engine plays it."""
    calls = {"piece": set(), "make_step": set()}
    for path in ROOMS:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call):
                name = getattr(node.func, "attr", getattr(node.func, "id", ""))
                calls.get(name, set()).add(str(path.relative_to(EXPERIMENTS)))
    assert calls["piece"] == {"engine/work.py"}
    alone = "benchmark/frames.py"  # times one episode
    assert calls["make_step"] == {"study/arms.py", alone}
