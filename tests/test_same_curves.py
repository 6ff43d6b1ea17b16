"""The comparison of two trees, on folders made by hand."""

import json

import numpy as np
import pytest
from tools.compared import compare
from tools.same_curves import COMMANDS, left, todays

EPISODES = 6


def arrays():
    generator = np.random.default_rng(0)
    loss = generator.normal(size=(2, EPISODES)).astype(np.float32)
    loss[:, 0] = np.nan
    films = generator.integers(0, 5, (1, EPISODES, 3)).astype(np.int8)
    return {
        "dyna (paper preset)": {
            "real_return": np.arange(2.0 * EPISODES).reshape(2, EPISODES),
            "agent_loss": loss,
            "film_move": films,
            "judged_error": np.array([0.5, 0.25]),
            "greedy_return": generator.normal(size=(2, 4)),
            "cost_rate": np.array(1.0),
        },
        "paper@30": {"frame_loss": np.ones((2, 3)), "seen": np.zeros((2, 4))},
    }


def todays_arrays():
    old = arrays()
    arm = old.pop("dyna (paper preset)")
    arm["show_move"] = arm.pop("film_move")[0].astype(float)
    arm["greedy_return"] = arm["greedy_return"] + 1
    del arm["cost_rate"], arm["judged_error"]
    old["paper@30"]["show_seen"] = old["paper@30"].pop("seen")
    return {"dyna (tuned preset)": arm} | old


def written(folder, curves):
    folder.mkdir()
    flat = {f"{arm}/{name}": one for arm, names in curves.items() for name, one in names.items()}
    np.savez(folder / "curves.npz", **flat)
    rows = [{"environment": "Maze", "who": "MPC", "world": "true", "steps": 8, "returns": [[1.0]]}]
    (folder / "results.json").write_text(json.dumps({"budgets": rows}))
    return left(folder)


@pytest.fixture
def both(tmp_path):
    return written(tmp_path / "old", arrays()), written(tmp_path / "new", todays_arrays())


def test_equal_under_new_names_and_what_is_judged_by_its_shape(both):
    verdict = compare(*both)
    assert (verdict.equal, verdict.total, verdict.first) == (4, 4, "")
    arm = ["dyna (tuned preset)"]
    assert verdict.notes == {
        "judged_error: only in the base": arm,
        "greedy_return: judged: shape equal": arm,
        "cost_rate: only in the base, judged": arm,
        "seen: judged: shape and values equal": ["paper@30"],
        "decisions: Maze, MPC, true, 8: judged: shape and values equal": ["budgets"],
    }


def test_the_first_entry_that_differs_is_named(both):
    old, new = both
    arm = new["dyna (tuned preset)"]
    arm["agent_loss"][1, 4] += 1e-6
    arm["agent_loss"][0, 5] += 1
    arm["show_move"][5, 1] += 1
    verdict = compare(old, new)
    assert (verdict.equal, verdict.total) == (2, 4)
    assert verdict.first.startswith("dyna (tuned preset)/agent_loss, run 1, episode 5: ")
    assert len(verdict.differences) == 2


def test_what_is_missing_is_a_difference_and_what_is_new_is_said(both):
    old, new = both
    del new["dyna (tuned preset)"]["agent_loss"], new["paper@30"]
    new["more"] = new["dyna (tuned preset)"]
    new["more"]["further"] = np.zeros(2)
    verdict = compare(old, new)
    assert {said for *_, said in verdict.differences} == {
        "dyna (tuned preset)/agent_loss: only in the base", "paper@30: only in the base"
    }  # fmt: skip
    assert verdict.notes["only new"] == ["more"]
    assert verdict.notes["further: only new"] == ["dyna (tuned preset)"]
    new["dyna (tuned preset)"]["greedy_return"] = np.zeros((2, 3))
    assert "greedy_return: judged: shape (2, 4) is now (2, 3)" in compare(old, new).notes


def test_a_study_of_one_unit_is_compared_and_what_is_judged_alone_is_no_comparison():
    old = {"study": {"r2": np.arange(6.0).reshape(2, 3)}}
    new = {"study": {"r2": old["study"]["r2"][:, None].copy()}}
    assert compare(old, new).first == ""
    new["study"]["r2"][1, 0, 2] += 1
    assert compare(old, new).first == "study/r2, run 1, episode 3: 5.0 is now 6.0"
    judged = {"arm": {"greedy_return": np.zeros((2, 3))}}
    assert compare(judged, judged).first == "nothing is compared by value"


def test_runs_are_compared_up_to_their_own_ends(both):
    old, new = both
    arm = new["dyna (tuned preset)"]
    for name in ("real_return", "agent_loss"):
        arm[name] = arm[name][:, :5]
        arm[name][1, 3:] = np.nan
    arm["show_move"] = arm["show_move"][:5]
    verdict = compare(old, new)
    assert verdict.first == ""
    assert "8 of 12 episodes, up to the runs' own ends" in verdict.notes
    arm["real_return"][1, 2] += 1
    assert "real_return, run 1, episode 3" in compare(old, new).first


def test_within_a_tolerance_up_to_where_a_run_goes_apart(both):
    old, new = both
    arm = new["dyna (tuned preset)"]
    arm["agent_loss"][1, 1:] += 1e-6
    arm["agent_loss"][1, 4] += 1
    assert "agent_loss, run 1, episode 2" in compare(old, new).first
    assert "agent_loss, run 1, episode 5" in compare(old, new, 1e-5).first
    arm["real_return"][1, 4] += 1
    verdict = compare(old, new, 1e-5)
    assert verdict.first == "" and "run 1 goes apart at 5" in verdict.notes
    arm["real_return"][1, 0] += 1
    assert "real_return, run 1, episode 1" in compare(old, new, 1e-5).first


def test_every_command_can_be_typed_today():
    assert all(todays(name)[-2] == "--block" for name in COMMANDS)
