"""Stable-Baselines3 is at home in the worlds and dreams: its calls are imitated here, and the slow
tests make an environment of their own with it, which neither it nor PyTorch is in otherwise.
"""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import ClassVar

import gymnasium
import numpy as np
import pytest

from jaxdyna.envs import Catch, FrameStack, HostEnv, Maze

ROOT = Path(__file__).parents[1]
EXAMPLE = ROOT / "docs" / "examples" / "stable_baselines.py"
KEPT = ROOT / "tests" / "data" / "kept"
CHECKED = """
import gymnasium, jaxdyna, sys
from stable_baselines3.common.env_checker import check_env
jaxdyna.load(sys.argv[1]).register("Dream-v0")
for name in [name for name in gymnasium.registry if name.startswith("jaxdyna/")] + ["Dream-v0"]:
    check_env(gymnasium.make(name, render_mode="rgb_array"), skip_render_check=False)
    print(name)
"""


def numbers(line):
    """What the example says of a seed."""
    words = [one.rpartition(" ") for one in line.partition(": ")[2].split(", ")]
    return {name: float(value) for name, _, value in words}


@pytest.mark.parametrize("world", [Catch(), FrameStack(Maze(size=4, num_obstacles=1), 2)])
def test_steps_are_of_the_types_that_it_takes(world):
    """It refuses rewards and ends of other types, puts observations into arrays of the space, and
    PyTorch warns of those that it cannot write to.
    """
    env = HostEnv(world)
    seen = np.zeros((3, *env.observation_space.shape), env.observation_space.dtype)
    seen[0], info = env.reset(seed=np.random.default_rng(0).integers(9).item(), options=None)
    assert type(info) is dict
    for step in (1, 2):
        obs, reward, *ends, info = env.step(np.zeros(1, np.int64)[0])
        seen[step] = obs
        assert type(obs) is np.ndarray and obs.flags.writeable and obs.dtype == seen.dtype
        assert type(reward) is float and [type(end) for end in ends] == [bool, bool]
        obs[:] = 0  # moves nothing
    assert seen[2].any()


class Imitation:
    """Calls an environment as an algorithm of Stable-Baselines3 does, and learns nothing: in any
    number of states at a time its action is number 0.
    """

    learned_in: ClassVar[list[str]] = []

    def __init__(self, policy, env, **settings):
        assert policy == "MlpPolicy" and settings["device"] == "cpu"
        self.env, self.seed = env, settings["seed"]

    def learn(self, steps):
        self.learned_in.append(self.env.spec.id)
        self.env.reset(seed=self.seed)
        for _ in range(steps):
            _, _, terminated, truncated, _ = self.env.step(self.env.action_space.sample())
            if terminated or truncated:
                self.env.reset()
        return self

    def predict(self, obs, deterministic):
        assert deterministic and obs.shape[1:] == self.env.observation_space.shape
        return np.zeros(len(obs), np.int64), None


def evaluate(model, env, episodes, warn):
    """The first action's mean return, as ``evaluate_policy``."""
    returns = np.zeros(episodes)
    for number in range(episodes):
        (obs, _), over = env.reset(), False
        while not over:
            obs, reward, terminated, truncated, _ = env.step(model.predict(obs[None], True)[0][0])
            returns[number] += reward
            over = terminated or truncated
    return returns.mean(), returns.std()


@pytest.fixture
def example(monkeypatch):
    """The example, beside an imitation."""
    modules = {
        "stable_baselines3": {"DQN": Imitation, "PPO": Imitation},
        "stable_baselines3.common": {},
        "stable_baselines3.common.evaluation": {"evaluate_policy": evaluate},
    }
    for name, parts in modules.items():
        module = ModuleType(name)
        vars(module).update(parts)
        monkeypatch.setitem(sys.modules, name, module)
    spec = importlib.util.spec_from_file_location("example", EXAMPLE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "EPISODES", 20)
    monkeypatch.setattr(Imitation, "learned_in", [])
    yield module
    gymnasium.registry.pop("Dream0-v0", None)


def test_the_maze_is_judged_by_its_optimum(example, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["", "maze", "--steps", "65", "--seed", "3"])
    example.main()
    told = numbers(capsys.readouterr().out)
    assert Imitation.learned_in == ["jaxdyna/Maze-v0"]
    assert told["untrained"] == told["learned"] <= 0  # it stays at the left edge
    assert told["learned"] < told["optimum"] and 0 < told["straight on"] <= told["optimum"] <= 23


def test_dreams_are_learned_in_and_the_truth_judges(example):
    told = example.dream(steps=45, seed=0, run=KEPT)
    assert Imitation.learned_in == ["Dream0-v0", "CartPole-v1"]
    always_left = 9.3  # steps that the pole stands
    assert told["untrained"] == pytest.approx(always_left, abs=0.5)
    assert told["learned in the dream"] == told["learned in CartPole"] == told["untrained"]
    assert told["real steps behind the dream"] > 6


@pytest.fixture(scope="module")
def python():
    """An interpreter that has Stable-Baselines3."""
    with TemporaryDirectory(prefix="jaxdyna-sb3-") as folder:
        subprocess.run([sys.executable, "-m", "venv", folder], check=True)
        inside = Path(folder) / "bin" / "python"
        pip = [inside, "-m", "pip", "install", "--quiet"]
        # PyTorch's build for CPUs where pip has been told of a folder with it, else gigabytes.
        subprocess.run([*pip, "--no-index", "--no-deps", "torch"], capture_output=True, check=False)
        line = [*pip, "torch", "stable-baselines3", ROOT]
        done = subprocess.run(line, capture_output=True, text=True, check=False)
        if done.returncode:
            pytest.skip(f"Stable-Baselines3 cannot be installed: {done.stderr.splitlines()[-1]}")
        yield inside


def said(python, *words):
    """What a command prints."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run([python, *words], env=environment, capture_output=True, text=True,
                          check=False)  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_its_dqn_learns_in_the_maze(python):
    told = numbers(said(python, EXAMPLE, "maze", "--steps", "15000", "--seed", "0"))
    assert told["untrained"] < 0 < 0.5 * told["optimum"] < told["learned"] < told["optimum"]


@pytest.mark.slow
def test_its_ppo_learns_in_a_dream(python, tmp_path):
    out = tmp_path / "run"
    run = ["--preset", "lean", "--arms", "dyna", "--episodes", "10", "--seeds", "2", "--out", out]
    said(python, "-m", "jaxdyna.experiments.cartpole", *run)
    assert "Dream-v0" in said(python, "-c", CHECKED, out)
    words = ["--steps", "15000", "--seed", "1", "--run", out]
    told = numbers(said(python, EXAMPLE, "dream", *words))
    assert told["learned in the dream"] > 100 and told["real steps behind the dream"] < 2000
