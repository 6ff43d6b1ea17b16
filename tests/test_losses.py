"""The equations against values worked out by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdyna.agents.cloning import cross_entropy_loss, margin_loss
from jaxdyna.agents.reinforce import over_batch, per_step, within_episode
from jaxdyna.losses import (
    discern,
    discounted_returns,
    policy_gradient,
    standardise,
    td_error,
    transition_loss,
)


def test_discounted_returns():
    np.testing.assert_allclose(discounted_returns(jnp.array([1.0, 2.0, 4.0]), 0.5), [3.0, 4.0, 4.0])
    np.testing.assert_allclose(discounted_returns(jnp.array([1.0, 2.0, 4.0]), 1.0), [7.0, 6.0, 4.0])


def test_standardise_ignores_padding_and_survives_equal_values():
    mask = jnp.array([True, True, True, False])
    ours = standardise(jnp.array([1.0, 2.0, 3.0, 99.0]), mask)
    np.testing.assert_allclose(ours, [-np.sqrt(1.5), 0, np.sqrt(1.5), 0], rtol=1e-5)
    np.testing.assert_array_equal(standardise(jnp.full(4, 7.0), mask), np.zeros(4))
    np.testing.assert_array_equal(
        standardise(jnp.full(37, 100.1), jnp.ones(37, bool)), np.zeros(37)
    )
    far = standardise(1e4 + jnp.array([1.0, 2.0, 3.0, 0.0]), mask)
    np.testing.assert_allclose(far, [-np.sqrt(1.5), 0, np.sqrt(1.5), 0], rtol=1e-4)


def test_policy_gradient():
    logits = jnp.log(jnp.array([[0.25, 0.75], [0.5, 0.5], [0.9, 0.1]]))
    loss = policy_gradient(
        logits, jnp.array([1, 0, 0]), jnp.array([2.0, -1.0, 5.0]), jnp.array([1.0, 0.5, 0.0])
    )
    np.testing.assert_allclose(loss, -(2 * np.log(0.75) - 0.5 * np.log(0.5)), rtol=1e-6)


def test_the_advantage_is_a_constant():
    """As where it comes from the network that is trained."""

    def loss(shift):
        return policy_gradient(jnp.zeros((1, 2)), jnp.array([0]), shift + jnp.ones(1), jnp.ones(1))

    assert jax.grad(loss)(1.0) == 0


def test_transition_loss_is_equation_1():
    p = 0.2
    loss = transition_loss(
        jnp.array([1.0, 2.0]), jnp.float32(0.5), jnp.log(p / (1 - p)),
        jnp.array([0.0, 4.0]), jnp.float32(1.0), jnp.bool_(True),
    )  # fmt: skip
    np.testing.assert_allclose(loss, (1 + 4) + 0.25 - np.log(p), rtol=1e-6)
    end = transition_loss(
        jnp.zeros(1), jnp.float32(0), jnp.float32(-200), jnp.zeros(1), jnp.float32(0), jnp.bool_(1)
    )
    np.testing.assert_allclose(end, 200)


def test_advantages():
    returns = jnp.array([[4.0, 2.0, 0.0], [8.0, 6.0, 4.0]])
    valid = jnp.array([[True, True, False], [True, True, True]])
    within = within_episode(returns, valid)
    np.testing.assert_allclose(within[0], [1, -1, 0], rtol=1e-5)
    np.testing.assert_allclose(within[1], np.array([1, 0, -1]) * np.sqrt(1.5), rtol=1e-5, atol=1e-6)
    pooled = np.array([4.0, 2.0, 8.0, 6.0, 4.0])
    over = over_batch(returns, valid)
    np.testing.assert_allclose(over[1, 0], (8 - pooled.mean()) / pooled.std(), rtol=1e-5)
    assert over[0, 2] == 0
    # Per step the mean is over those that got there: 6, 4 and 4.
    centred = np.array([-2.0, -2.0, 2.0, 2.0, 0.0])
    ours = per_step(returns, valid)
    np.testing.assert_allclose(ours[0], [-2 / centred.std(), -2 / centred.std(), 0], rtol=1e-5)
    np.testing.assert_allclose(ours[1, 2], 0, atol=1e-6)


def test_per_step_leaves_equal_episodes_alone_and_a_single_one_to_itself():
    returns = jnp.tile(jnp.array([3.0, 2.0, 1.0]), (4, 1))
    np.testing.assert_array_equal(per_step(returns, jnp.ones((4, 3), bool)), np.zeros((4, 3)))
    alone = (returns[:1], jnp.ones((1, 3), bool))
    np.testing.assert_array_equal(per_step(*alone), within_episode(*alone))


ROW, ROWS, ACTIONS, ONE = jnp.ones(3), jnp.ones((3, 2)), jnp.zeros(3, int), jnp.float32(1)
WRONG = {
    "returns of several episodes": lambda: discounted_returns(ROWS, 0.5),
    "a discount a step": lambda: discounted_returns(ROW, ROW),
    "a float mask": lambda: standardise(ROW, ROW),
    "a mask of other steps": lambda: standardise(ROW, jnp.ones(2, bool)),
    "logits without steps": lambda: policy_gradient(ROW, ACTIONS, ROW, ROW),
    "float actions": lambda: policy_gradient(ROWS, ROW, ROW, ROW),
    "weights of other steps": lambda: policy_gradient(ROWS, ACTIONS, ROW, ROW[:1]),
    "values of several states": lambda: td_error(ROWS, 0, 1.0, 0.5, ROW, ROW),
    "a float action": lambda: td_error(ROW, 0.0, 1.0, 0.5, ROW, ROW),
    "values of fewer actions": lambda: td_error(ROW, 0, 1.0, 0.5, ROW, ROW[:2]),
    "a reward with an axis": lambda: transition_loss(ROW, ROW[:1], ONE, ROW, ONE, ONE),
    "another observation": lambda: transition_loss(ROW, ONE, ONE, ROW[:1], ONE, ONE),
    "a true end with an axis": lambda: transition_loss(ROW, ONE, ONE, ROW, ONE, ROW[:1]),
    "fewer made pictures": lambda: discern(ROW, ROW[:1]),
    "log odds of several states": lambda: cross_entropy_loss(ROWS, 0),
    "actions at once": lambda: margin_loss(ROW, ACTIONS),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_would_only_be_broadcast_is_refused(name):
    with pytest.raises(AssertionError, match=r"rank|type|shape"):
        WRONG[name]()
