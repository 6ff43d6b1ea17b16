"""The guide's own worlds: what a reader copies makes a command."""

import json
import re
from pathlib import Path

import pytest

from jaxdyna.experiments.engine import main

PAGE = Path(__file__).parents[1] / "docs" / "your-own-problem.md"
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
TRAINS = "make_train(dyna"


@pytest.fixture(scope="module")
def copied():
    names = {}
    exec("\n".join(block for block in BLOCKS if TRAINS not in block), names)
    return names


@pytest.mark.slow
def test_the_trained_model_is_used_from_python(copied, capsys):
    (block,) = (block for block in BLOCKS if TRAINS in block)
    exec(block, copied)
    assert capsys.readouterr().out.splitlines()[-1] == "(8, 5)"
    assert copied["metrics"]["real_return"].shape == (6,)


def test_a_world_of_ones_own_has_a_command(copied, tmp_path):
    argv = ["--arms", "model_free", "--seeds", "2", "--episodes", "21", "--out", str(tmp_path)]
    assert main(copied["CHAIN"], copied["GRID"], argv=argv, prog="python my_chain.py") == 0
    arms = json.loads((tmp_path / "results.json").read_text())["arms"]
    assert len(arms["model_free"]["episodes_to_solve"]["per_seed"]) == 2
    assert "(returns.png)" in (tmp_path / "report.md").read_text()


def test_it_has_the_standard_arms(copied):
    for name in ("CHAIN", "GRID"):
        experiment = copied[name]
        arms = experiment.arms(experiment.presets["tuned"].resolved())
        assert {"dyna", "placebo", "oracle", "more_updates"} <= set(arms)
        assert arms["dyna"]().work == arms["dyna"]().work  # one program for the same settings


def test_bad_input_is_one_line(copied, capsys):
    with pytest.raises(SystemExit):
        main(copied["CHAIN"], argv=["--dyna.num-steps", "7"], prog="python my_chain.py")
    assert "decided by --hparams.env.max-steps" in capsys.readouterr().err
