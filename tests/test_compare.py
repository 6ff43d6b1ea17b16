"""Runs of several folders beside each other: what is said of them, and what is refused."""

import json

import numpy as np
import pytest
from pole import POLE

from jaxdyna.envs.named import named
from jaxdyna.experiments import any as any_world, compare
from jaxdyna.experiments.engine import storage
from jaxdyna.experiments.engine.experiment import entries
from jaxdyna.experiments.engine.record import results_of
from jaxdyna.fields import changed
from jaxdyna.statistics import brunner_munzel, holm, ratio_of_means, summarise

SEEDS, EPISODES = 12, 60


def left(out, arms, sweep=(), what=POLE, seeds=range(SEEDS), length=None, **overrides):
    """The folder of a run that solves at given episodes, by arm."""
    preset = next(iter(what.presets.values()))
    options = changed(preset, {"episodes": EPISODES, "seeds": SEEDS} | overrides).resolved()
    window = what.rule(options).window
    curves = {}
    for name, solved in arms.items():
        numbers = np.arange(1, EPISODES + 1)
        returns = np.where(numbers >= np.asarray(solved)[:, None] - window + 1, 20.0, 1.0)
        lengths = np.full_like(returns, length) if length else returns
        curves[name] = {"real_return": returns, "real_length": lengths}
    about = {
        "experiment": what.name, "part": what.name, "module": "pole", "command": "python -m pole",
        "runs": {"seeds": list(seeds), "of": SEEDS, "shard": [1, 1], "block": 1},
        "sweep": dict(sweep), "versions": {"jax": "0.8"}, "source": "abcd", "timing": {"arms": {}},
    }  # fmt: skip
    if what is not POLE:
        about["module"] = any_world.__name__
        about["command"] = f"python -m {any_world.__name__} --env {options.env}"
    results = results_of(what, options, entries(what, options, dict(sweep)), curves, about)
    out.mkdir(parents=True)
    storage.write_json(out / "results.json", results)
    storage.write_curves(out / "curves.npz", curves, storage.identity(results))
    return out


def around(middle, spread=8):
    return middle + np.random.default_rng(middle).integers(-spread, spread + 1, SEEDS)


@pytest.fixture
def two(tmp_path):
    """The second with another rate, and one run that never solves."""
    slow = around(40)
    slow[3] = 1000
    rate = {"hparams.agent.learning_rate": 0.25}
    one = left(tmp_path / "a" / "one", {"model_free": around(28), "dyna": around(20)})
    return one, left(tmp_path / "a" / "two", {"dyna": around(24), "placebo": slow}, **rate)


def compared(*words):
    return compare.main([str(word) for word in words])


def test_one_table_one_figure_and_tests(two, tmp_path, capsys):
    out = tmp_path / "out"
    assert compared(*two, "--out", out) == 0
    printed = capsys.readouterr().out
    results = storage.read_json(out / "results.json")
    assert list(results["arms"]) == ["model_free", "dyna, one", "dyna, two", "placebo"]
    assert "placebo" in printed and "11/12" in printed
    said = {tuple(one["arms"]): one for one in results["comparisons"]}
    assert list(said) == [("dyna, one", "model_free"), ("dyna, two", "dyna, one"),
                          ("placebo", "model_free")]  # fmt: skip
    assert [one["paired"] for one in said.values()] == [False, True, False]
    one, other = around(20).astype(float), around(28).astype(float)
    expected = ratio_of_means(one, other)
    found = said["dyna, one", "model_free"]
    assert {name: found[name] for name in expected} == expected
    assert found["sooner_p"] == brunner_munzel(one, other) < 1e-6
    pair = said["dyna, two", "dyna, one"]
    assert pair["ci95"] == ratio_of_means(around(24), around(20), paired=True)["ci95"]
    assert pair["sooner_p"] is None and "learning_rate 0.25, not" in pair["differs"]
    assert said["placebo", "model_free"]["ratio"] > 1.2  # the unsolved run counts as the budget
    adjusted = holm([one["p"] for one in said.values()])
    assert [one["holm_p"] for one in said.values()] == pytest.approx(list(adjusted))
    text = (out / "report.md").read_text()
    assert "| dyna, two : dyna, one (paired) | " in text and "told apart" in text
    assert (out / "returns.png").exists() and "](returns.png)" in text
    page = (out / "report.html").read_text()
    assert "dyna, two" in page and json.dumps("dyna, one") in page


def test_named_arms_and_another_measure(two, tmp_path):
    out = tmp_path / "out"
    words = ["--arms", "dyna", "--measure", "real_steps_to_solve", "--out", out]
    assert compared(*two, *words) == 0
    results = storage.read_json(out / "results.json")
    assert list(results["arms"]) == ["dyna, one", "dyna, two"]
    assert "real steps to solve: mean" in (out / "report.md").read_text()
    assert compared(*two[::-1], *words) == 0  # an earlier one is set aside
    assert (next((out / "previous").iterdir()) / "report.html").exists()


def test_a_setting_is_compared_with_the_same_setting_elsewhere(tmp_path):
    rates = {"hparams.agent.learning_rate": [0.25, 0.5]}
    arms = {f"dyna@hparams.agent.learning_rate={rate}": around(20) for rate in (0.25, 0.5)}
    sides = [left(tmp_path / name, arms, rates) for name in ("one", "two")]
    assert compared(*sides, "--out", tmp_path / "out") == 0
    said = storage.read_json(tmp_path / "out" / "results.json")["comparisons"]
    ends = [tuple(arm.rpartition("=")[2] for arm in one["arms"]) for one in said]
    assert ends == [("0.5, one", "0.25, one"), ("0.25, two", "0.25, one"), ("0.5, two", "0.5, one")]


@pytest.mark.parametrize("measure", ["real_steps_to_solve", "first_solved"])
def test_who_never_solves_does_not_look_better(measure, tmp_path):
    """Of steps each run has played its own number; of episodes there is a common budget."""
    never = np.full(SEEDS, 1000)
    solves = left(tmp_path / "one", {"dyna": around(28)}, length=40)
    short = left(tmp_path / "two", {"dyna": never}, length=10)
    for folders in ((solves, short), (short, solves)):
        assert compared(*folders, "--measure", measure, "--out", tmp_path / "out") == 0
        (said,) = storage.read_json(tmp_path / "out" / "results.json")["comparisons"]
        text = (tmp_path / "out" / "report.md").read_text()
        assert said["sooner"] == float(said["arms"][0].endswith("one"))
        if measure == "first_solved":
            assert (said["ratio"] > 1) == (said["sooner"] == 0) and said["holm_p"] < 0.01
            assert "unsolved runs stopped" not in text
        else:
            assert said["ratio"] is said["p"] is said["ci95"] is None and "holm_p" not in said
            row = next(line for line in text.splitlines() if line.startswith("| dyna, ") and
                       " : " in line)  # fmt: skip
            assert row.endswith("| unsolved runs stopped at different steps |")


def test_unsolved_runs_are_last_by_rank_and_alike():
    """Whatever they played."""

    def figure(needed, played):
        return summarise(np.array(needed), at_least=np.array(played, float))

    inf, six = float("inf"), [1.0, 2, 3, 4, 5, 6]
    mixed = figure([*six, inf, inf], [90.0] * 6 + [20, 30])
    other = figure([*six, inf, inf], [90.0] * 6 + [50, 60])
    said = compare._tested([mixed, other], False)
    assert said["sooner"] == 0.5 and said["sooner_p"] == pytest.approx(1)
    assert said["ratio"] is None and said["no_ratio"]  # else the first would look better
    known = compare._tested([figure([*six, inf], 90), figure([*six, 7], 90)], False)
    assert known["ratio"] > 1 and known["sooner"] < 0.5 and known["no_ratio"] is None
    never = compare._tested([figure([inf] * 6, 10 + np.arange(6)), figure([inf] * 6, 90)], False)
    assert never["sooner"] == 0.5 and never["ratio"] is never["sooner_p"] is None
    hardly = figure([*six[:2], *[inf] * 5], 90), figure([6.0, *[inf] * 6], 90)
    said = compare._tested(hardly, False)
    assert said["ratio"] is None and said["no_ratio"] == "fewer than half of either solved"
    assert said["sooner"] > 0.5 and 0 < said["sooner_p"] < 1


def test_runs_of_other_seeds_are_numbered(tmp_path):
    sides = [left(tmp_path / str(first), {"dyna": around(20)}, seeds=range(first, first + SEEDS))
             for first in (0, 50)]  # fmt: skip
    same = left(tmp_path / "same", {"dyna": around(24)})
    for folders, runs in (
        (sides, {"seeds": list(range(1, SEEDS + 1)), "by": "number"}),
        ([sides[0], same], {"seeds": list(range(SEEDS))}),
    ):  # fmt: skip
        assert compared(*folders, "--out", tmp_path / "out") == 0
        results = storage.read_json(tmp_path / "out" / "results.json")
        assert results["runs"] == runs
        page = (tmp_path / "out" / "report.html").read_text()
        assert json.dumps({"runs": runs["seeds"], "by": runs.get("by", "seed")})[1:-1] in page


def test_worlds_of_one_name_but_for_its_letters_are_two(tmp_path, capsys, monkeypatch):
    module = "from jaxdyna.envs import CartPole\nclass Pole(CartPole): pass\nclass pole(Pole): pass"
    (tmp_path / "worlds_alike.py").write_text(module)
    monkeypatch.syspath_prepend(tmp_path)
    folders = []
    for name in ("Pole", "pole"):
        what = any_world.experiment(f"worlds_alike:{name}", None)
        folders.append(left(tmp_path / f"of_{name}", {"dyna": around(20)}, what=what, solve_at=5.0))
    said = "of_pole has another world than of_Pole: env worlds_alike:pole, not worlds_alike:Pole"
    refused(folders, said, tmp_path, capsys)
    named.cache_clear()


def test_what_only_the_first_has_is_a_difference_too():
    one, other = (compare.Side("", None, None, {}, {}, [], told)
                  for told in ({"a": 1, "b": 2}, {"a": 1}))  # fmt: skip
    assert other.differs(one, "") == "b None, not 2"
    assert one.differs(other, "b") == "b 2, not None" and one.differs(other, "a") == ""


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        ({"hparams.env.gravity": 3.0}, "two has another world than one: hparams.env.gravity 3.0"),
        ({"episodes": 90}, "two has another budget than one: episodes 90, not 60"),
        ({"threshold": 14.0}, "two has another solve rule than one"),
    ],
)
def test_what_cannot_be_compared_is_refused(overrides, said, tmp_path, capsys):
    folders = (
        left(tmp_path / "one", {"dyna": around(20)}),
        left(tmp_path / "two", {"dyna": around(20)}, **overrides),
    )
    refused(folders, said, tmp_path, capsys)


def refused(words, said, tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        compared(*words, "--out", tmp_path / "out")
    captured = capsys.readouterr()
    assert stop.value.code == 2 and captured.out == ""
    assert said in captured.err and len(captured.err.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_folders_are_refused_by_name(two, tmp_path, capsys):
    one, other = two
    refused([one], "give two folders or more", tmp_path, capsys)
    refused([one, one.parent / "." / "one"], "each of them once", tmp_path, capsys)
    refused([one, tmp_path / "none"], f"{tmp_path / 'none'} has no result", tmp_path, capsys)
    refused([*two, "--arms", "dina"], "--arms dina: there are", tmp_path, capsys)
    refused([*two, "--arms", "placebo"], "--arms placebo: only two has that", tmp_path, capsys)
    frozen = [*two, "--measure", "frozen.real_steps_to_solve"]
    refused(frozen, "one has evaluated no policies", tmp_path, capsys)
    refused([*two, "--measure", "solve_rule"], "--measure", tmp_path, capsys)
    results = storage.read_json(other / "results.json")
    results["runs"]["shard"] = [1, 2]
    storage.write_json(other / "results.json", results)
    refused(two, "is a shard: merge it", tmp_path, capsys)


def test_what_is_not_a_comparison_is_left_alone(two, tmp_path, capsys):
    with pytest.raises(SystemExit):
        compared(*two, "--out", two[0])
    assert "has files of no such run" in capsys.readouterr().err
