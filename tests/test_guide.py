"""The guides: what a reader copies makes a command, learns, and finds what the page says."""

import json
import re
import shlex
from importlib import import_module
from pathlib import Path

import jax
import numpy as np
import pytest

from jaxdyna.experiments import merge
from jaxdyna.experiments.engine import main

DOCS = Path(__file__).parents[1] / "docs"


def blocks(page, language="python"):
    return re.findall(rf"```{language}\n(.*?)```", (DOCS / page).read_text(), re.DOTALL)


BLOCKS = blocks("your-own-problem.md")
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


def test_an_agent_of_ones_own_learns_in_dreams():
    names = {}
    exec("\n".join(blocks("your-own-agent.md")), names)
    late = np.asarray(names["late"])
    assert late.shape == (3,) and late.min() > 0 and late.mean() > 0.4  # at random -0.6
    assert list(names["arms"]) == ["model_free", "dyna", "placebo", "oracle"]
    assert names["arms"]["dyna"]().work == names["arms"]["dyna"]().work


def test_a_model_of_ones_own_dreams_as_its_world_plays():
    names = {}
    exec("\n".join(blocks("your-own-model.md")), names)
    explained = np.asarray(names["explained"])
    assert explained[:2].min() > 0.99 and explained[3] < 0.6  # which has the gusts
    assert names["believed"].mean() == pytest.approx(names["GUST"], rel=0.2)
    true, drawn, means = (float(names["returns"][name]) for name in ("true", "drawn", "means"))
    assert drawn == pytest.approx(true, rel=0.3)
    assert means > 2 * true


@pytest.mark.slow
def test_a_model_of_ones_own_takes_its_place_in_a_run():
    names = {}
    exec("\n".join(blocks("your-own-model.md")), names)
    _, metrics = jax.jit(names["train"])(jax.random.key(7), names["values"])
    assert metrics["real_return"][-50:].mean() > 1.5 * metrics["real_return"][:50].mean()


@pytest.mark.slow
def test_shards_by_the_guide_become_one_record(tmp_path, monkeypatch):
    """As they are typed there, of shorter runs."""
    monkeypatch.chdir(tmp_path)
    (block,) = (block for block in blocks("scale.md", "bash") if "experiments.merge" in block)
    short = ["--arms", "model_free", "--episodes", "3"]
    for line in block.splitlines():
        *_, module, words = re.match(r"(python -m jaxdyna.experiments.)(\w+) (.*)", line).groups()
        argv = shlex.split(words, comments=True)
        if module == "merge":
            assert merge.main(argv) == 0
        else:
            parts = import_module(f"jaxdyna.experiments.{module}").PARTS
            assert main(*parts, argv=[*argv, *short], prog=module) == 0
    runs = json.loads((tmp_path / "runs/both/results.json").read_text())["runs"]
    assert runs["seeds"] == list(range(8)) and runs["shard"] == [1, 1]
    played = np.load(tmp_path / "runs/both/curves.npz")["model_free/real_return"]
    assert played.shape == (8, 3)
    for number, name in enumerate(("one", "two")):
        shard = np.load(tmp_path / f"runs/{name}/curves.npz")["model_free/real_return"]
        np.testing.assert_array_equal(played[number::2], shard)
