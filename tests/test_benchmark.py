"""The benchmark: sweeps by their number of runs, training steps in turns with PyTorch's."""

import json
import sys

import pytest

from jaxdyna.experiments.benchmark import PARTS, steps
from jaxdyna.experiments.engine import main

PROG = "python -m jaxdyna.experiments.benchmark"


def test_sweeps_are_timed(tmp_path):
    arguments = ["--sizes", "2", "--episodes", "4", "--out", str(tmp_path)]
    assert main(*PARTS, argv=arguments, prog=PROG) == 0
    rows = json.loads((tmp_path / "results.json").read_text())["sweeps"]
    assert [row["runs"] for row in rows] == [2]
    assert all(row["compile_s"] > 0 and row["run_s"] > 0 for row in rows)
    assert (tmp_path / "seconds.png").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [(["--sizes", "0"], "--sizes is (0,)"), (["--seeds", "3"], "decided"), (["--sizes"], "empty")],
)
def test_bad_input_is_one_line(arguments, words, capsys):
    with pytest.raises(SystemExit) as stop:
        main(*PARTS, argv=arguments, prog=PROG)
    said = capsys.readouterr().err
    assert stop.value.code == 2 and words in said and len(said.splitlines()) == 1


def test_without_pytorch_one_line_says_how_to_get_it(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "torch", None)
    arguments = ["--part", "steps", "--out", str(tmp_path)]
    with pytest.raises(SystemExit) as stop:
        main(*PARTS, argv=arguments, prog=PROG)
    said = capsys.readouterr().err
    assert stop.value.code == 2 and "pip install 'jaxdyna[bench]'" in said
    assert len(said.splitlines()) == 1


def test_contenders_take_turns_and_are_compared():
    header, rows = steps.compared({"ours": [1.0, 2.0, 3.0], "PyTorch": [4.0]}, "PyTorch")
    assert rows[0] == ["ours", "2.00", "1.50 to 2.50", "0.50"] and len(header) == 4
    called = []
    taken = steps.take_turns({name: lambda n=name: called.append(n) for name in "ab"}, 2)
    assert called == list("baabbaab") and [len(values) for values in taken.values()] == [2, 2]
