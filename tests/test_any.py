"""Any world from the command line: what is chosen for it, and what is said of bad ones."""

import json
import sys

import numpy as np
import pytest

from jaxdyna.agents import DQNConfig, ReinforceConfig
from jaxdyna.envs import CartPole, Hosted, Maze
from jaxdyna.envs.named import named
from jaxdyna.experiments import any as any_world, record
from jaxdyna.experiments.engine.record import recorded
from jaxdyna.fields import changed
from jaxdyna.models import PixelConfig, SupervisedConfig
from jaxdyna.statistics import SolveRule

MODULE = """
from jaxdyna.envs import Catch
import gymnasium

class Small(Catch):
    pass

def lake():
    return gymnasium.wrappers.FlattenObservation(gymnasium.make("FrozenLake-v1"))

def number():
    return 3

class Board(Catch):
    def observation_space(self, params):
        return gymnasium.spaces.Box(0, 1, (self.rows, self.columns))

class Unbounded(Catch):
    num_actions = property()
    def action_space(self, params):
        return gymnasium.spaces.Box(-float("inf"), float("inf"), (1,))

class Endless(Catch):
    default_params = ()

class Both(Catch):
    def step(self, *args):
        obs, state, reward, terminated, _, info = super().step(*args)
        return obs, state, reward, terminated, terminated, info
"""


@pytest.fixture
def module(tmp_path, monkeypatch):
    """A module of the user's, in the working directory."""
    (tmp_path / "worlds_of_mine.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    yield "worlds_of_mine"
    sys.modules.pop("worlds_of_mine", None)
    named.cache_clear()


def test_worlds_have_names(module):
    assert named("jaxdyna:Maze(size=6, num_obstacles=1)") == Maze(size=6, num_obstacles=1)
    assert named("jaxdyna:CartPole") == CartPole()
    assert isinstance(named("gymnasium:CartPole-v1"), Hosted)
    assert named(f"{module}:Small(rows=4)").rows == 4
    assert named(f"{module}:lake").observation_space(None).shape == (16,)


@pytest.mark.parametrize(("said", "answer"), [
    ("jaxdyna:Maz", "has no Maz: did you mean Maze?"),
    ("jaxdyna:Maze(side=3)", "side"),
    ("jaxdyna:Maze(size=0)", "size"),
    ("jaxdyna:Maze(", "is no world: give gymnasium:ID"),
    ("CartPole-v1", "is no world: did you mean gymnasium:CartPole-v1? Give gymnasium:ID"),
    ("no_such_module:Maze", "there is no module no_such_module"),
    ("gymnasium:CartPol-v1", "Did you mean: `CartPole`"),
    ("worlds_of_mine:Unbounded", "actions are Box(-inf, inf, (1,), float32): give Discrete ones"),
    ("gymnasium:FrozenLake-v1", "FlattenObservation"),
    ("worlds_of_mine:Board", "Board is seen as Box(0.0, 1.0, (10, 5)"),
    ("worlds_of_mine:number", "makes a int, no environment"),
    ("jaxdyna:Maze(6)", "is no world: give gymnasium:ID"),
    ("os:system(command='exit 1')", "system makes no environment"),
    ("worlds_of_mine:Endless", "default_params have no max_steps"),
    ("worlds_of_mine:Both", "terminated and truncated are true at once"),
])  # fmt: skip
def test_bad_worlds_are_one_line(module, said, answer, capsys):
    with pytest.raises(SystemExit, match="2"):
        any_world.main(["--env", said])
    (line,) = capsys.readouterr().err.splitlines()
    assert answer in line


def test_help_with_and_without_a_world(capsys):
    for flags in (["--help"], ["--help", "--env", "gymnasium:Acrobot-v1"]):
        with pytest.raises(SystemExit, match="0"):
            any_world.main(flags)
        said = capsys.readouterr().out
        assert "--hparams.agent.learning-rate" in said and "--agent dqn or reinforce" in said
    with pytest.raises(SystemExit, match="2"):
        any_world.main([])
    assert "--env is missing" in capsys.readouterr().err


@pytest.mark.parametrize(("said", "learner", "agent", "model", "oracle"), [
    ("jaxdyna:CartPole", "dqn", DQNConfig, SupervisedConfig, True),
    ("jaxdyna:CartPole", "reinforce", ReinforceConfig, SupervisedConfig, True),
    ("jaxdyna:Maze(size=6)", "dqn", DQNConfig, PixelConfig, True),
    ("gymnasium:Acrobot-v1", "dqn", DQNConfig, SupervisedConfig, False),
    ("jaxdyna:Pendulum", None, ReinforceConfig, SupervisedConfig, True),
    ("gymnasium:Pendulum-v1", None, ReinforceConfig, SupervisedConfig, False),
])  # fmt: skip
def test_spaces_choose(said, learner, agent, model, oracle):
    options = any_world.defaults(said, learner)
    assert (type(options.agent), type(options.model)) == (agent, model)
    made = any_world.arms(options.resolved())
    assert ("oracle" in made) == oracle
    assert ("more_updates" in made and "max_updates" in made) == (learner == "dqn")
    assert made["dyna"]().work == any_world.arms(options.resolved())["dyna"]().work


@pytest.mark.parametrize("flags", [("--from", "nowhere"), ("--from", ".")])
def test_settings_of_no_run(flags, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match="2"):
        any_world.main([*flags, "--env", "jaxdyna:CartPole"])
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{' '.join(flags)}: there is no result: name a results.json, or a folder" in line


def test_frames_have_no_reinforce(capsys):
    with pytest.raises(SystemExit, match="2"):
        any_world.main(["--env", "jaxdyna:Maze", "--agent", "reinforce"])
    assert "--agent reinforce sees vectors" in capsys.readouterr().err


def test_a_box_has_no_dqn(capsys):
    with pytest.raises(SystemExit, match="2"):
        any_world.main(["--env", "jaxdyna:Pendulum", "--agent", "dqn"])
    (line,) = capsys.readouterr().err.splitlines()
    assert "--agent dqn takes numbered actions, not a Box" in line


def test_worlds_say_when_they_are_solved():
    options = any_world.defaults("gymnasium:Acrobot-v1", "dqn")
    assert any_world.rule(options) == SolveRule(100, -100.0)
    assert any_world.rule(changed(options, {"solve_at": -90.0})) == SolveRule(100, -90.0)
    assert any_world.rule(any_world.defaults("jaxdyna:Maze", "dqn")) is None


SMALL = ["--seeds", "1", "--episodes", "24", "--dyna.model-updates", "3", "--agent.fake-updates",
         "2", "--dyna.dream-episodes", "4", "--agent.batch", "8"]  # fmt: skip


@pytest.mark.slow
def test_without_a_rule_a_report_has_what_needs_none(module, tmp_path, capsys):
    argv = ["--env", f"{module}:Small(rows=4)", *SMALL, "--arms", "dyna", "--out", "out"]
    assert any_world.main(argv) == 0
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    assert results["config"]["env"] == f"{module}:Small(rows=4)"
    assert "episodes_to_solve" not in results["arms"]["dyna"]
    report = (tmp_path / "out" / "report.md").read_text()
    assert "returns.png" in report and "after so many real steps" in report
    assert "to solve" not in report
    experiment, options, every = recorded(results)  # as merge and redraw find it
    assert experiment.title == options.env and len(every) == 6
    before = np.load(tmp_path / "out" / "curves.npz")["dyna/real_return"]
    assert any_world.main([*argv, "--resume"]) == 0
    assert any_world.main(["--from", "out", "--out", "again"]) == 0
    after = np.load(tmp_path / "again" / "curves.npz")["dyna/real_return"]
    np.testing.assert_array_equal(before, after)
    plan = record.Plan("mine", "?", f"any --env '{module}:Small(rows=4)' --seeds 3")
    assert plan.session.options.seeds == 3


@pytest.mark.slow
def test_gymnasiums_worlds_are_played_by_the_engine(tmp_path, monkeypatch):
    """And in shards that are the same runs."""
    monkeypatch.chdir(tmp_path)
    argv = ["--env", "gymnasium:CartPole-v1", "--hparams.env.max-steps", "30", *SMALL,
            "--arms", "dyna", "--solve-at", "12"]  # fmt: skip
    assert any_world.main([*argv, "--seeds", "2", "--out", "both"]) == 0
    assert any_world.main([*argv, "--seeds", "2", "--shard", "2/2", "--out", "second"]) == 0
    both, second = (np.load(tmp_path / name / "curves.npz") for name in ("both", "second"))
    np.testing.assert_array_equal(both["dyna/real_return"][1:], second["dyna/real_return"])
    assert np.nanmax(both["dyna/real_length"]) <= 30
    assert "gymnasium:CartPole-v1" in (tmp_path / "both" / "report.md").read_text()
