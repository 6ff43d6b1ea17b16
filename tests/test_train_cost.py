"""Where the time of a real episode goes."""

import jax
import numpy as np
from parts import DYNA, MODEL_FREE, SMALL, hparams

from jaxdyna.dyna import make_init
from jaxdyna.experiments.run import Arm
from jaxdyna.experiments.train_cost import PARTS, cost_of_parts, cost_said, describe_cost


def measured(dyna, updates):
    state = make_init(dyna, SMALL)(jax.random.key(0), hparams())
    arm = Arm(dyna, SMALL, hparams())
    return cost_of_parts(arm, updates, state, jax.random.key(1))


def test_every_part_is_measured_and_what_an_arm_does_not_do_is_not():
    alone, dyna = measured(MODEL_FREE, (1, 0)), measured(DYNA, (1, 1))
    assert (dyna["cost_seconds"] > 0).all() and (dyna["cost_operations"] > 0).all()
    idle = [part in ("model updates", "dreams") for part in PARTS]
    np.testing.assert_array_equal(alone["cost_seconds"] == 0, idle)
    results = {"arms": {"model_free": describe_cost(alone), "dyna": describe_cost(dyna)}}
    assert set(results["arms"]["dyna"]["cost"]["floor_seconds"]) == set(PARTS)
    said, table = cost_said(results)
    assert "GFLOP/s" in said and "| dyna | dreams |" in table and "model_free | dreams" not in table
    assert not describe_cost({}) and not cost_said({"arms": {"model_free": {}}})


def test_loops_count_as_often_as_they_go_round():
    """XLA counts the operations in a loop once."""
    once, twice = measured(MODEL_FREE, (1, 0)), measured(MODEL_FREE, (2, 0))
    learning = PARTS.index("agent updates")
    ratio = twice["cost_operations"][learning] / once["cost_operations"][learning]
    np.testing.assert_allclose(ratio, 2)
