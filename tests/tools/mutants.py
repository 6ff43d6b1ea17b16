"""Whether the tests notice when the package is wrong: plays each small wrong version of it, a
mutant of ``tests/mutants``, in a copy of the tree, and says which of them survives its tests.

``python tests/tools/mutants.py [NAME ...] [--jobs N]``, ``--table`` for the table of the docs
"""

import argparse
import contextlib
import io
import multiprocessing
import os
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[2]
MUTANTS = ROOT / "tests" / "mutants"
PARTS = ("jaxdyna", "tests", "pyproject.toml")
"""What a copy of the tree consists of."""
LIBRARIES = [
    "pytest", "jax", "flax.linen", "flax.struct", "optax", "chex", "gymnasium", "scipy.stats",
    "orbax.checkpoint", "tyro", "rich.progress", "matplotlib.pyplot", "mctx", "ale_py",
]  # fmt: skip
"""Imported once for all: a mutant's process begins with them."""


class Hunk(NamedTuple):
    """Lines of a file, and those that stand in their place."""

    path: str
    old: str
    new: str


class Mutant(NamedTuple):
    """A wrong version of the package.

    Attributes:
        name: of its patch.
        wrong: what is wrong, a sentence.
        tests: ids of the tests that have to fail.
        witness: Python that prints a number which is another one in the wrong version.
        hunks: what is changed.
    """

    name: str
    wrong: str
    tests: list[str]
    witness: str
    hunks: list[Hunk]

    @property
    def area(self) -> str:
        """The part of the package that is wrong."""
        return "/".join(Path(self.hunks[0].path).with_suffix("").parts[1:])


class Ended(NamedTuple):
    """What a process saw.

    Attributes:
        printed: by each witness, by the mutants' names.
        failed: the name of the exception of each test that did not pass, by its id; those whose
            name begins with "!" are no assertions.
        passed: ids.
        seconds: how long it took.
    """

    printed: dict[str, str]
    failed: dict[str, str]
    passed: list[str]
    seconds: float


def read(path: Path) -> Mutant:
    """A mutant from its patch: a sentence, lines ``killed by TEST``, the witness indented, and a
    unified diff.
    """
    head, *files = re.split(r"^--- a/", path.read_text(), flags=re.MULTILINE)
    lines = head.splitlines()
    tests = [line.removeprefix("killed by ") for line in lines if line.startswith("killed by ")]
    witness = [line[4:] for line in lines if line.startswith("    ")]
    hunks = [hunk for file in files for hunk in _hunks(file)]
    return Mutant(path.stem, lines[0], tests, "\n".join(witness), hunks)


def _hunks(file: str) -> Iterator[Hunk]:
    path, _, changes = file.partition("\n")
    for change in re.split(r"^@@.*\n", changes, flags=re.MULTILINE)[1:]:
        lines = [line or " " for line in change.splitlines()]
        sides = (
            "".join(f"{line[1:]}\n" for line in lines if line[0] in kept) for kept in (" -", " +")
        )
        yield Hunk(path, *sides)


def all_mutants() -> list[Mutant]:
    """In the order of the table: by what they change."""
    mutants = [read(path) for path in sorted(MUTANTS.glob("*.patch"))]
    return sorted(mutants, key=lambda mutant: (mutant.area, mutant.name))


def applied(mutant: Mutant, tree: Path) -> dict[str, str]:
    """The changed files of a tree, whatever lines they now are.

    Raises:
        ValueError: where the lines to be changed are not there, or more than once.
    """
    files: dict[str, str] = {}
    for path, old, new in mutant.hunks:
        text = files.get(path) or (tree / path).read_text()
        if text.count(old) != 1:
            raise ValueError(f"{path} has these lines {text.count(old)} times:\n{old}")
        files[path] = text.replace(old, new)
    return files


def table(mutants: Sequence[Mutant]) -> str:
    """In Markdown, a row a mutant."""
    rows = ["| part | what is wrong | test that fails |", "| --- | --- | --- |"]
    for mutant in mutants:
        tests = ", ".join(f"`{test.removeprefix('tests/')}`" for test in mutant.tests)
        wrong = mutant.wrong.replace("|", "\\|")
        rows.append(
            f"| [{mutant.area}](../tests/mutants/{mutant.name}.patch) | {wrong} | {tests} |"
        )
    return "\n".join(rows)


class Watch:
    """A plugin of pytest: runs witnesses once tests are collected, and keeps how the tests end.

    Attributes:
        witnesses: code by the mutants' names.
        known: what the sound tree printed; with the same nothing is tested.
    """

    def __init__(self, witnesses: dict[str, str], known: dict[str, str]) -> None:
        self.witnesses, self.known = witnesses, known
        self.printed: dict[str, str] = {}
        self.failed: dict[str, str] = {}
        self.passed: list[str] = []

    def pytest_collection_finish(self, session: Any) -> None:
        """Before the first test."""
        self.printed = {name: printed(code) for name, code in self.witnesses.items()}
        if self.printed == self.known:
            session.items.clear()

    def pytest_exception_interact(self, node: Any, call: Any, report: Any) -> None:
        """Of a test, or of the collection."""
        import pytest  # noqa: PLC0415 - the parent, which needs none, stays quick

        kinds = (AssertionError, pytest.fail.Exception)
        mark = "" if report.when == "call" and isinstance(call.excinfo.value, kinds) else "!"
        self.failed[node.nodeid] = f"{mark}{call.excinfo.typename}"

    def pytest_runtest_logreport(self, report: Any) -> None:
        """After each test."""
        if report.when == "call" and report.passed:
            self.passed.append(report.nodeid)


def printed(code: str) -> str:
    """What a witness prints, or the error that stops it."""
    out = io.StringIO()
    try:
        with contextlib.redirect_stdout(out):
            exec(code, {})
    except Exception as error:
        return f"!{type(error).__name__}: {error}"
    return out.getvalue().strip() or "!it prints nothing"


def play(
    tree: Path, witnesses: dict[str, str], tests: Iterable[str], known: dict[str, str]
) -> Ended:
    """In a process of its own: the witnesses and then the tests, with a tree's package."""
    import pytest  # noqa: PLC0415

    began, watch = time.monotonic(), Watch(witnesses, known)
    os.chdir(tree)
    os.environ["PYTHONPATH"] = str(tree)
    sys.path.insert(0, str(tree))
    quiet = ["-p", "no:cacheprovider", "--rootdir", str(tree), "-o", "addopts=", "-q"]
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
        pytest.main([*quiet, *dict.fromkeys(tests)], plugins=[watch])
    whose = Path(sys.modules["jaxdyna"].__file__ or "").parents[1]
    assert whose == tree, f"{whose} was tested instead of {tree}"
    return Ended(watch.printed, watch.failed, watch.passed, time.monotonic() - began)


def _of(test: str, ids: Iterable[str]) -> list[str]:
    """Those ids that are the test's, with any parameters."""
    return [one for one in ids if one == test or one.startswith(f"{test}[")]


def complaints(mutant: Mutant, sound: Ended, ended: Ended) -> list[str]:
    """What is wrong with a mutant, or with its tests; nothing of one that they notice."""
    before, after = sound.printed[mutant.name], ended.printed.get(mutant.name, "!nothing ran")
    for number in (before, after):
        if number.startswith("!"):
            return [f"its witness fails: {number[1:]}"]
    if before == after:
        return [f"its witness sees no difference: {before}"]
    said = []
    for test in mutant.tests:
        failed = [ended.failed[one] for one in _of(test, ended.failed)]
        if _of(test, sound.failed) or not _of(test, sound.passed):
            said.append(f"{test} does not pass in the sound tree")
        elif not failed and _of(test, ended.passed):
            said.append(f"SURVIVES {test}")
        elif not failed:
            said.append(f"{test} did not run: {', '.join(ended.failed.values())}")
        elif all(name.startswith("!") for name in failed):
            said.append(f"{test} fails by {failed[0][1:]}, which is no assertion")
    return said


def copied(source: Path, target: Path) -> Path:
    """A copy of a tree."""
    for part in PARTS:
        if (source / part).is_dir():
            shutil.copytree(source / part, target / part)
        else:
            target.mkdir(exist_ok=True)
            shutil.copy2(source / part, target)
    return target


def mutated(mutant: Mutant, sound: Path) -> Path:
    """The copy of a tree with a mutant in it."""
    tree = copied(sound, sound.parent / mutant.name)
    for path, text in applied(mutant, sound).items():
        for stale in (tree / path).parent.glob(f"__pycache__/{Path(path).stem}.*"):
            stale.unlink()
        (tree / path).write_text(text)
    return tree


def judge_sound(tree: Path, mutants: Sequence[Mutant]) -> Ended:
    """All witnesses and tests of some mutants, in the sound tree."""
    witnesses = {mutant.name: mutant.witness for mutant in mutants}
    return play(tree, witnesses, [test for mutant in mutants for test in mutant.tests], {})


def judge(sound: Path, given: tuple[Mutant, Ended]) -> tuple[Mutant, list[str], float]:
    """A mutant: what is wrong with it, and how long that took."""
    mutant, known = given
    try:
        tree = mutated(mutant, sound)
    except ValueError as error:
        return mutant, [f"does not apply: {error}"], 0.0
    before = {mutant.name: known.printed[mutant.name]}
    ended = play(tree, {mutant.name: mutant.witness}, mutant.tests, before)
    shutil.rmtree(tree)
    return mutant, complaints(mutant, known, ended), ended.seconds


def judged(mutants: Sequence[Mutant], jobs: int, folder: Path) -> Iterator[tuple]:
    """Mutants with what is wrong with them, and the seconds of each. The sound tree is played
    first, file by file of tests.
    """
    sound, context = copied(ROOT, folder / "sound"), multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(LIBRARIES)
    by_file: dict[str, list[Mutant]] = {}
    for mutant in mutants:
        by_file.setdefault(mutant.tests[0].partition("::")[0], []).append(mutant)
    began, groups = time.monotonic(), list(by_file.values())
    with context.Pool(jobs, maxtasksperchild=1) as pool:
        played = pool.map(partial(judge_sound, sound), groups, chunksize=1)
        print(f"the sound tree: {time.monotonic() - began:.0f} s", flush=True)
        known = [(one, ended) for group, ended in zip(groups, played, strict=True) for one in group]
        yield from pool.imap_unordered(partial(judge, sound), known)


def prepare(folder: Path) -> None:
    """What processes that this one starts find set: the tests' flags, and one store of programs."""
    os.environ.setdefault("XLA_FLAGS", (ROOT / "tests" / "xla_flags").read_text().strip())
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(folder / "programs"))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")
    os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
    os.environ.setdefault("MPLBACKEND", "agg")


def arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    """What is asked for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="of patches; all by default")
    parser.add_argument("--jobs", type=int, default=1, help="mutants at once (default 1)")
    parser.add_argument("--table", action="store_true", help="print the table of the docs")
    asked = parser.parse_args(argv)
    known = {mutant.name: mutant for mutant in all_mutants()}
    names = [Path(name).stem for name in asked.names]
    if unknown := [name for name in names if name not in known]:
        parser.error(f"there is no mutant {unknown[0]}")
    asked.mutants = [known[name] for name in names or known]
    return asked


def main(argv: Sequence[str] | None = None) -> int:
    """The exit code: 1 where a mutant survives, or cannot be judged."""
    asked, began = arguments(argv), time.monotonic()
    if asked.table:
        print(table(asked.mutants))
        return 0
    wrong = []
    with tempfile.TemporaryDirectory(prefix="mutants-") as name:
        folder = Path(name).resolve()
        prepare(folder)
        for mutant, said, seconds in judged(asked.mutants, asked.jobs, folder):
            wrong += [mutant.name] if said else []
            print(f"{mutant.name:48} {seconds:5.1f} s  {'; '.join(said) or 'killed'}", flush=True)
    killed = len(asked.mutants) - len(wrong)
    print(f"{killed} of {len(asked.mutants)} mutants killed in {time.monotonic() - began:.0f} s")
    if wrong:
        print(f"not killed: {', '.join(sorted(wrong))}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
