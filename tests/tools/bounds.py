"""Installs this tree with the lowest versions that pyproject.toml allows, then with the newest,
each in a fresh virtual environment, and runs tests in both.

    python tests/tools/bounds.py                      # both, a few quick tests of every part
    python tests/tools/bounds.py lowest --all         # the whole suite
    python tests/tools/bounds.py newest -- tests/test_dqn.py -x
"""

from __future__ import annotations

import argparse
import itertools
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from tempfile import TemporaryDirectory

TREE = Path(__file__).parents[2]
EXTRAS = "logging,test"
UNTESTED = ("bench", "box2d", "docs", "gxm", "wandb")
"""The planning and atari extras' packages are in that of the tests."""
QUICK = [
    f"tests/test_{name}.py"
    for name in (
        "architecture", "x64", "gymnasium", "contract", "rollout", "losses", "replay", "sweep",
        "fields", "cli", "report", "catch", "engine", "sweep_command",
    )
]  # fmt: skip
SAID = """
from importlib.metadata import version
print(*(f"{name} {version(name)}" for name in %r), sep=", ")
"""


def lowest(tree: Path) -> list[str]:
    """``name==version`` of every ``name>=version`` that the tree declares.

    Raises:
        ValueError: where a dependency has no lower bound, or one is declared twice.
    """
    project = tomllib.loads((tree / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]  # of bench PyTorch is gigabytes, of the rest no test
    tested = (packages for name, packages in extras.items() if name not in UNTESTED)
    declared = itertools.chain(project["dependencies"], *tested)
    pins = {}
    for each in declared:
        found = re.fullmatch(r"([\w.-]+)>=([\w.]+)", each)
        if not found:
            raise ValueError(f"pyproject.toml: {each} has no lower bound")
        name, version = found.groups()
        if pins.setdefault(name, version) != version:
            raise ValueError(f"pyproject.toml: {name} has the bounds {pins[name]} and {version}")
    return [f"{name}=={version}" for name, version in pins.items()]


def tested(kind: str, python: str, arguments: list[str]) -> bool:
    """Whether the tests pass with these versions, which are printed."""
    with TemporaryDirectory(prefix=f"jaxdyna-{kind}-") as folder:
        subprocess.run([python, "-m", "venv", folder], check=True)
        inside, pins = Path(folder) / "bin" / "python", Path(folder) / "pins.txt"
        pins.write_text("\n".join(lowest(TREE)) if kind == "lowest" else "")
        install = [inside, "-m", "pip", "install", "--constraint", pins, f"{TREE}[{EXTRAS}]"]
        installed = subprocess.run(install, capture_output=True, text=True, check=False)
        if installed.returncode:
            print(installed.stdout[-2000:], f"{kind}: could not be installed", sep="\n", flush=True)
            return False
        names = [pin.partition("==")[0] for pin in lowest(TREE)]
        subprocess.run([inside, "-VV"], check=True)
        subprocess.run([inside, "-c", SAID % names], check=True)
        environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        tests = [inside, "-m", "pytest", "-p", "no:cacheprovider", *arguments]
        passed = subprocess.run(tests, cwd=TREE, env=environment, check=False).returncode == 0
        print(f"{kind}: {'passed' if passed else 'FAILED'}", flush=True)
        return passed


def main() -> int:
    """Prints versions and results; 1 where a test failed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("kind", nargs="?", choices=["lowest", "newest", "both"], default="both")
    parser.add_argument("--all", action="store_true", help="the whole suite")
    parser.add_argument("--python", default=sys.executable, help="the interpreter")
    parser.add_argument("tests", nargs="*", default=[], help="after --: pytest's own arguments")
    options = parser.parse_args()
    arguments = options.tests or ([] if options.all else QUICK)
    kinds = ["lowest", "newest"] if options.kind == "both" else [options.kind]
    return int(not all([tested(kind, options.python, arguments) for kind in kinds]))


if __name__ == "__main__":
    sys.exit(main())
