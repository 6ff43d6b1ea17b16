"""The benchmark: sweeps by their number of runs."""

import json

import pytest

from jaxdyna.experiments.benchmark import PARTS
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
