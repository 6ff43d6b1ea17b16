"""The README's commands and code are what is there now."""

import re
from pathlib import Path

import gymnasium
import numpy as np

README = Path(__file__).parents[1] / "README.md"
SMALL = "num_episodes=4, num_real_first=2, model_updates=2"


def test_the_code_runs_and_hands_a_trained_model_to_gymnasium():
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    code, changes = re.subn(r"num_episodes=\d+, num_real_first=\d+", SMALL, "\n".join(blocks))
    assert changes == 1
    names = {}
    exec(code, names)
    assert names["metrics"]["real_return"].shape == (2, 10, 4)
    dreamed = gymnasium.make("Dreamed-v0")
    obs, _ = dreamed.reset(seed=0)
    assert dreamed.observation_space.contains(obs)
    obs, reward, *_ = dreamed.step(1)
    assert np.isfinite(obs).all() and np.isfinite(reward)
    gymnasium.registry.pop("Dreamed-v0")


def test_its_links_and_modules_exist():
    for page in (README, README.parent / "experiments" / "README.md"):
        for path in re.findall(r"\]\(([^)#:]+)\)", page.read_text()):
            assert (page.parent / path).exists(), path
    text = README.read_text()
    for module in re.findall(r"python -m jaxdyna\.(\S+)", text):
        path = README.parent / "jaxdyna" / module.replace(".", "/")
        assert path.with_suffix(".py").exists() or (path / "__main__.py").exists(), module
