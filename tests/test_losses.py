"""The equations against values worked out by hand, and against plain loops."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings, strategies as st

from jaxdyna.agents.cloning import cross_entropy_loss, margin_loss
from jaxdyna.agents.reinforce import over_batch, per_step, within_episode
from jaxdyna.losses import (
    clipped_policy_gradient,
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


SHAPE = (3, 5)
NUMBERS = st.floats(-100, 100, width=32, allow_subnormal=False)
POISON = st.sampled_from([np.nan, np.inf, -np.inf, 1e30])
RETURNS = jax.jit(jax.vmap(discounted_returns, (0, None)))
ADVANTAGES = jax.jit(lambda *args: [of(*args) for of in (within_episode, over_batch, per_step)])
STANDARDISE, TD = jax.jit(standardise), jax.jit(td_error)
SLOPES = jax.jit(jax.grad(td_error, (0, 4)))


def standardised(values):
    """Of a list; nothing but zeros where all are alike."""
    values = np.array(values, np.float64)
    if len(values) == 0 or np.ptp(values) == 0:
        return np.zeros(len(values))
    return (values - values.mean()) / (values.std() + 1e-6)


@st.composite
def padded(draw):
    """Numbers ``[3, 5]`` of episodes that end at any step, anything after that, and a mask."""
    lengths = np.array(draw(st.tuples(*[st.integers(0, SHAPE[1])] * SHAPE[0])))
    mask = np.arange(SHAPE[1]) < lengths[:, None]
    numbers = draw(st.lists(NUMBERS, min_size=mask.size, max_size=mask.size))
    values = np.reshape(np.array(numbers, np.float32), SHAPE)
    return np.where(mask, values, np.float32(draw(POISON))), mask


@given(padded(), st.sampled_from([0.0, 0.5, 0.97, 1.0]))
@settings(max_examples=60)
def test_returns_are_the_sums_that_a_loop_makes(given_, discount):
    rewards, mask = given_
    rewards = np.where(mask, rewards, 0)
    ours = RETURNS(rewards, discount)
    theirs = [[sum(discount**n * reward for n, reward in enumerate(row[t:].tolist()))
               for t in range(len(row))] for row in rewards]  # fmt: skip
    np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-3)


@given(padded())
@settings(max_examples=60)
def test_advantages_are_those_of_a_loop_and_padding_never_counts(given_):
    returns, mask = given_
    exact = returns.astype(np.float64)
    within, over, step = ADVANTAGES(returns, mask)
    own = [np.concatenate([standardised(row[there]), np.zeros((~there).sum())])
           for row, there in zip(exact, mask, strict=True)]  # fmt: skip
    together = np.zeros(SHAPE)
    together[mask] = standardised(exact[mask])
    centred, apart = np.zeros(SHAPE), np.zeros(SHAPE)
    for time in range(SHAPE[1]):
        got_there = mask[:, time]
        if got_there.any():
            centred[got_there, time] = exact[got_there, time] - exact[got_there, time].mean()
    spread = centred[mask].std() if mask.any() else 0.0
    assume(spread == 0 or spread > 1e-3)  # else a difference is rounding's
    apart[mask] = standardised(centred[mask])
    for ours, theirs in ((within, own), (over, together), (step, apart)):
        np.testing.assert_allclose(ours, theirs, rtol=1e-3, atol=2e-3)
        assert not np.asarray(ours)[~mask].any()


@given(padded(), st.sampled_from([0.01, 3.0, 1000.0]), st.sampled_from([0.0, -7.5, 1e4]))
@settings(max_examples=60)
def test_standardised_values_know_no_scale_and_no_place(given_, scale, shift):
    values, mask = given_
    assume(mask.any() and values[mask].std() * min(scale, 1) > 0.1)
    first = STANDARDISE(values, mask)
    moved = STANDARDISE(np.float32(scale) * values + np.float32(shift), mask)
    np.testing.assert_allclose(first, moved, rtol=1e-2, atol=2e-2)
    there = np.asarray(first)[mask]
    np.testing.assert_allclose([there.mean(), there.std()], [0, 1], atol=1e-3)
    np.testing.assert_allclose(STANDARDISE(-values, mask), -first, atol=1e-5)


@given(
    values=st.lists(st.tuples(NUMBERS, NUMBERS, NUMBERS), min_size=4, max_size=4),
    action=st.integers(0, 3), reward=NUMBERS, discount=st.sampled_from([0.0, 0.9, 1.0]),
)  # fmt: skip
@settings(max_examples=60)
def test_td_errors_are_those_of_a_loop(values, action, reward, discount):
    now, then, choice = np.array(values, np.float32).T
    best = max(range(4), key=lambda other: (choice[other], -other))
    ours = TD(now, action, reward, discount, then, choice)
    expected = reward + discount * float(then[best]) - float(now[action])
    np.testing.assert_allclose(ours, expected, rtol=1e-5, atol=1e-4)
    slopes = SLOPES(now, action, reward, discount, then, choice)
    np.testing.assert_array_equal(slopes[0], -np.eye(4)[action])  # the target is a constant
    assert not slopes[1].any()


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


def test_clipped_policy_gradient():
    """By hand: the odds of the first of two actions have gone from 1/2 to 3/4, ratio 1.5."""
    before, now = jnp.zeros((2, 2)), jnp.log(jnp.array([[3.0, 1.0], [3.0, 1.0]]))
    actions, weight = jnp.array([0, 0]), jnp.array([1.0, 1.0])

    def loss(logits, advantage, weight=weight):
        return clipped_policy_gradient(logits, actions, jnp.array(advantage), weight, before)

    assert loss(now, [2.0, 0.0]) == pytest.approx(-2 * 1.2)  # more than that is not believed
    assert loss(now, [-2.0, 0.0]) == pytest.approx(2 * 1.5)  # what went wrong is, all of it
    assert loss(now, [2.0, -2.0], jnp.array([0.0, 0.5])) == pytest.approx(1.5)
    np.testing.assert_array_equal(jax.grad(loss)(now, [2.0, 2.0]), 0)
    at_first = jax.grad(loss)(before, [2.0, -3.0])
    plain = jax.grad(policy_gradient)(before, actions, jnp.array([2.0, -3.0]), weight)
    np.testing.assert_allclose(at_first, plain, rtol=1e-6)
