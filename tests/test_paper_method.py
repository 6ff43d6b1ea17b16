"""The page on the paper's method says what the presets are."""

import re
from pathlib import Path

import pytest

from jaxdyna import fields
from jaxdyna.experiments.cartpole import options as cartpole
from jaxdyna.experiments.maze import options as maze
from jaxdyna.experiments.pong import options as pong

PAGE = (Path(__file__).parents[1] / "docs" / "paper-method.md").read_text(encoding="utf-8")
SECTIONS = dict(re.findall(r"^## (.+?)\n(.*?)(?=^## |\Z)", PAGE, re.MULTILINE | re.DOTALL))
SAID = {
    world: dict(re.findall(r"`([\w.]+)` = `([^`]+)`", text)) for world, text in SECTIONS.items()
}
PRESETS = {"CartPole": cartpole, "The Maze": maze, "Pong": pong}
OTHERS = ("mpc.", "mcts", "cloning.", "shown_episodes", "dqn.", "dqn_hparams.")
"""Settings of arms that the paper does not have."""
UNUSED = {
    "CartPole": {"model.spread"},  # of a normalisation that is off
    "The Maze": {"model_widths"},  # of another model
    "Pong": set(),
}
OPEN = {
    "The Maze": {
        "size", "obstacles", "steps", "hparams.env.collision_reward", "hparams.env.goal_reward",
        "convolutions", "dense", "agent.optimizer", "hparams.agent.learning_rate", "agent.batch",
        "agent.capacity", "agent.updates", "hparams.agent.target_rate", "agent.target_period",
        "agent.n_step", "hparams.agent.epsilon_first", "hparams.agent.epsilon_last",
        "hparams.agent.discount", "model", "coder_widths", "coder_kernels", "coder_dense",
        "model_loss", "model_reward", "reward_hidden", "reward_weight",
    },
    "Pong": {
        "scale", "agent_dense", "widths", "dense", "adversarial_weight", "reward_weight",
        "paper_rate", "models", "agent.optimizer", "agent.capacity", "agent.target_period",
        "hparams.agent.fake_share", "hparams.env.serve_delay", "hparams.real_weight",
    },
}  # fmt: skip
"""What the paper fixes, or leaves open and its authors' code decides."""


def value(options, path):
    leaf = next(leaf for leaf in fields.leaves(options) if leaf.path == path)
    plain = fields._said(leaf.value, leaf.choices)
    return " ".join(map(str, plain)) if isinstance(plain, list) else str(plain)


@pytest.mark.parametrize(
    ("world", "path"), [(world, path) for world in SAID for path in SAID[world]]
)
def test_a_setting_is_what_the_page_says(world, path):
    assert value(PRESETS[world].PAPER.resolved(), path) == SAID[world][path]


@pytest.mark.parametrize("world", PRESETS)
def test_whatever_is_not_as_declared_or_as_in_tuned_is_on_the_page(world):
    counts = ("preset", "quick", "arms", "seeds", "seed", "episodes", "stop_after_solved", "block")
    paper, tuned = PRESETS[world].PAPER, PRESETS[world].TUNED
    own = {
        leaf.path
        for leaf in fields.leaves(paper)
        if leaf.path not in (*paper.decided, *counts)
        and not leaf.path.startswith(OTHERS)
        and (leaf.everyday or leaf.value != fields.value_at(tuned, leaf.path))
    }
    assert own - UNUSED[world] | OPEN.get(world, set()) <= SAID[world].keys() and len(own) > 10
