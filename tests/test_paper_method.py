"""The page on the paper's method says what the presets are."""

import re
from pathlib import Path

import pytest

from jaxdyna import fields
from jaxdyna.experiments.cartpole.options import PAPER, TUNED

PAGE = (Path(__file__).parents[1] / "docs" / "paper-method.md").read_text(encoding="utf-8")
SAID = dict(re.findall(r"`([\w.]+)` = `([^`]+)`", PAGE))
PLANNERS = ("mpc.", "mcts", "cloning.", "shown_episodes")
"""Settings of arms that the paper does not have."""


def value(options, path):
    plain = fields.plain(fields.value_at(options, path))
    return " ".join(map(str, plain)) if isinstance(plain, list) else str(plain)


@pytest.mark.parametrize("path", SAID)
def test_a_setting_is_what_the_page_says(path):
    assert value(PAPER.resolved(), path) == SAID[path]


def test_whatever_is_not_as_declared_or_as_in_tuned_is_on_the_page():
    counts = ("preset", "quick", "arms", "seeds", "seed", "episodes", "stop_after_solved", "block")
    own = [
        leaf.path
        for leaf in fields.leaves(PAPER)
        if leaf.path not in (*PAPER.decided, *counts)
        and not leaf.path.startswith(PLANNERS)
        and (leaf.everyday or leaf.value != fields.value_at(TUNED, leaf.path))
    ]
    unused = {"model.spread"}  # of a normalisation that is off
    assert set(own) - unused <= SAID.keys() and len(own) > 10
