"""Imports point one way, and files and functions stay small enough to read."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "jaxdyna"
FILES = sorted(PACKAGE.rglob("*.py"))
FLOORS = {
    **dict.fromkeys(["fields", "types", "conditional", "convolution"], 0),
    **dict.fromkeys(["settings", "networks", "losses", "envs", "replay"], 1),
    **dict.fromkeys(["rollout", "frame_replay"], 2),
    **dict.fromkeys(["memory", "windows"], 3),
    **dict.fromkeys(["agents", "models", "planners", "parts"], 4),
    "dyna": 5,
    "sweep": 6,
    "statistics": 6,
    "experiments": 7,
}


def part_of(module: str) -> str:
    return module.split(".")[1] if "." in module else "jaxdyna"


def imports(path: Path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            yield from names if node.module in ("jaxdyna", "flax") else [node.module]
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


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_readable_in_one_sitting(path):
    text = path.read_text()
    assert len(text.splitlines()) <= 260
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef):
            start = node.body[1] if ast.get_docstring(node) and len(node.body) > 1 else node.body[0]
            length = node.end_lineno - start.lineno + 1
            limit = (
                100 if node.name in ("supervised", "pixels", "reinforce", "dqn") else 50
            )  # bundles of functions
            assert length <= limit, f"{node.name} has {length} lines"
