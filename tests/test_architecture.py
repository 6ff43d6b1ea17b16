"""Imports point one way, inside the experiments too."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "jaxdyna"
FILES = sorted(PACKAGE.rglob("*.py"))
FLOORS = {
    **dict.fromkeys(["fields", "types", "trees"], 0),
    **dict.fromkeys(["optimizers", "networks", "losses", "envs", "replay"], 1),
    "rollout": 2,
    **dict.fromkeys(["agents", "models", "planners"], 3),
    **dict.fromkeys(["dyna", "testing"], 4),
    **dict.fromkeys(["sweep", "statistics"], 5),
    "experiments": 6,
}
EXPERIMENTS = PACKAGE / "experiments"
ROOMS = sorted(EXPERIMENTS.rglob("*.py"))
STOREYS = {
    "report": 0,
    "engine": 1,
    **dict.fromkeys(["study", "frames"], 2),
    **dict.fromkeys(["cartpole", "maze", "pong", "catch"], 3),
    **dict.fromkeys(["planning", "benchmark", "merge"], 4),
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
            assert path.name == "gymnasium.py"
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


def test_folders_stay_easy_to_see():
    for folder in {path.parent for path in ROOMS}:
        assert len(list(folder.glob("*.py"))) <= 15, folder
