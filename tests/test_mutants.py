"""Every mutant is a wrong version of today's package, and the tests that kill it are there."""

import ast
import re
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
sys.path.append(str(ROOT / "tests" / "tools"))

import mutants  # noqa: E402

MUTANTS = mutants.all_mutants()
PAGE = ROOT / "docs" / "reliability.md"


@cache
def functions(path):
    """A file's functions by name: what decorates them."""
    tree = ast.parse((ROOT / path).read_text())
    functions = [node for node in tree.body if isinstance(node, ast.FunctionDef)]
    return {node.name: " ".join(map(ast.unparse, node.decorator_list)) for node in functions}


def test_there_are_many():
    assert len({mutant.name for mutant in MUTANTS}) == len(MUTANTS) >= 60
    assert len({mutant.area for mutant in MUTANTS}) >= 20


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_a_mutant_can_be_judged(mutant):
    """It applies and is Python, says what is wrong, has a witness that prints, and its tests exist.
    A patch that no longer applies is mended by writing today's lines into it.
    """
    for path, text in mutants.applied(mutant, ROOT).items():
        assert text != (ROOT / path).read_text()
        ast.parse(text)
    assert re.fullmatch(r"[A-Z`].+\.", mutant.wrong)
    assert "print(" in mutant.witness and ast.parse(mutant.witness)
    assert mutant.tests
    for test in mutant.tests:
        path, _, name = test.partition("::")
        name, parameter, _ = name.partition("[")
        assert name in functions(path), test
        assert not parameter or "parametrize" in functions(path)[name], test


def test_a_patch_is_read_and_applied_wherever_its_lines_are(tmp_path):
    patch = tmp_path / "two-is-three.patch"
    patch.write_text(
        "Two is three.\n\nkilled by tests/test_numbers.py::test_two\n\n"
        "    from numbers import two\n    print(two)\n\n"
        "--- a/numbers.py\n+++ b/numbers.py\n@@ -1,2 +1,2 @@\n one = 1\n-two = 2\n+two = 3\n"
    )
    mutant = mutants.read(patch)
    assert mutant.name == "two-is-three" and mutant.wrong == "Two is three."
    assert mutant.tests == ["tests/test_numbers.py::test_two"]
    assert mutant.witness == "from numbers import two\nprint(two)"
    (tmp_path / "numbers.py").write_text("zero = 0\none = 1\ntwo = 2\nthree = 3\n")
    changed = mutants.applied(mutant, tmp_path)
    assert changed == {"numbers.py": "zero = 0\none = 1\ntwo = 3\nthree = 3\n"}
    for text in ("one = 1\n", "one = 1\ntwo = 2\n" * 2):
        (tmp_path / "numbers.py").write_text(text)
        with pytest.raises(ValueError, match="times"):
            mutants.applied(mutant, tmp_path)


KNOWN = mutants.Ended({"one": "1"}, {}, ["t.py::test_a[x]", "t.py::test_b"], 0.0)
ENDINGS = {
    "": ({"one": "2"}, {"t.py::test_a[x]": "AssertionError"}, []),
    "SURVIVES": ({"one": "2"}, {}, ["t.py::test_a[x]"]),
    "sees no difference": ({"one": "1"}, {}, []),
    "witness fails: NameError": ({"one": "!NameError: x"}, {}, []),
    "no assertion": ({"one": "2"}, {"t.py::test_a[x]": "!TypeError"}, []),
    "did not run": ({"one": "2"}, {"t.py": "!ImportError"}, []),
}


@pytest.mark.parametrize("said", ENDINGS)
def test_only_a_failed_assertion_kills(said):
    mutant = mutants.Mutant("one", "It is wrong.", ["t.py::test_a"], "print(1)", [])
    complaints = mutants.complaints(mutant, KNOWN, mutants.Ended(*ENDINGS[said], 0.0))
    assert len(complaints) == bool(said) and said in "".join(complaints)


def test_a_test_that_fails_anyway_kills_nothing():
    mutant = mutants.Mutant("one", "It is wrong.", ["t.py::test_c"], "print(1)", [])
    ended = mutants.Ended({"one": "2"}, {"t.py::test_c": "AssertionError"}, [], 0.0)
    [complaint] = mutants.complaints(mutant, KNOWN, ended)
    assert "does not pass in the sound tree" in complaint


def test_the_page_has_todays_table():
    """As ``python tests/tools/mutants.py --table`` prints it."""
    assert mutants.table(MUTANTS) in PAGE.read_text()


@pytest.mark.slow
def test_no_mutant_survives():
    assert mutants.main([]) == 0
