"""The equations, unbatched: one episode or one transition at a time. Callers vmap them."""

from collections.abc import Callable
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import optax

from jaxdyna.actions import categorical

LogProb = Callable[[jax.Array, jax.Array], jax.Array]
"""``(outputs [T, ...], action [T, ...]) -> [T]``: log probabilities by a policy's outputs."""


def discounted_returns(reward: jax.Array, discount: jax.Array | float) -> jax.Array:
    """The return ``[T]`` from every step on: ``G_t = r_t + discount * G_{t+1}``. Nothing is
    bootstrapped at the end (Williams 1992, REINFORCE).

    Args:
        reward: ``[T]``, zero after the end of the episode.
        discount: scalar in [0, 1].
    """
    chex.assert_rank([reward, discount], [1, 0])

    def step(following, reward_t):
        following = reward_t + discount * following
        return following, following

    nothing = jnp.zeros((), jnp.result_type(reward, discount))
    _, returns = jax.lax.scan(step, nothing, reward, reverse=True, unroll=8)
    return returns


def standardise(values: jax.Array, mask: jax.Array) -> jax.Array:
    """Shifts and scales to mean 0 and standard deviation 1 where ``mask`` is true, 0 elsewhere; a
    lone value, or equal ones, become 0. ``values`` have any shape, the bool ``mask`` and the
    outcome the same.
    """
    chex.assert_type(mask, bool)
    chex.assert_equal_shape([values, mask])
    count = jnp.maximum(mask.sum(), 1)
    centred = jnp.where(mask, values - jnp.where(mask, values, 0).sum() / count, 0)
    std = jnp.sqrt(jnp.square(centred).sum() / count)
    rounding = 8 * jnp.finfo(std.dtype).eps * jnp.abs(jnp.where(mask, values, 0)).max()
    return jnp.where(std > rounding, centred / (std + 1e-6), 0.0)


def policy_gradient(
    logits: jax.Array, action: jax.Array, advantage: jax.Array, weight: jax.Array,
    log_prob: LogProb = categorical,
) -> jax.Array:  # fmt: skip
    """REINFORCE's surrogate loss ``-sum_t weight_t * advantage_t * log pi(a_t | s_t)``, a scalar
    (Williams 1992).

    Args:
        logits: a policy's outputs ``[T, outputs]``.
        action: ``[T, ...]``.
        advantage: ``[T]``, treated as a constant.
        weight: ``[T]``, 0 on padding.
        log_prob: of actions by the outputs, which are log odds by default.
    """
    chex.assert_rank([logits, advantage, weight], [2, 1, 1])
    chex.assert_equal_shape_prefix([logits, action, advantage, weight], 1)
    return -(weight * jax.lax.stop_gradient(advantage) * log_prob(logits, action)).sum()


MOST = 20.0  #: the logarithm of a ratio of densities: a larger one is infinite soon


def clipped_policy_gradient(
    logits: jax.Array, action: jax.Array, advantage: jax.Array, weight: jax.Array,
    before: jax.Array, clip: float = 0.2, log_prob: LogProb = categorical,
) -> jax.Array:  # fmt: skip
    """PPO's surrogate loss ``-sum_t weight_t * min(r_t A_t, clip(r_t, 1 - clip, 1 + clip) A_t)``, a
    scalar (Schulman et al. 2017, Eq. 7), with the ratio
    ``r_t = pi(a_t | s_t) / pi_before(a_t | s_t)``, for steps that an earlier policy has played; at
    that policy its gradient is that of `policy_gradient`, which says what the other arguments are.

    Args:
        before: the earlier policy's outputs, ``[T, outputs]``, a constant.
        clip: how far the ratio may go from 1 before it earns nothing more.
    """
    chex.assert_rank([logits, advantage, weight], [2, 1, 1])
    chex.assert_equal_shape([logits, before])
    new, old = (log_prob(one, action) for one in (logits, jax.lax.stop_gradient(before)))
    change = jnp.where(weight == 0, 0.0, new - old)  # where nothing was done densities may explode
    ratio, advantage = jnp.exp(jnp.clip(change, -MOST, MOST)), jax.lax.stop_gradient(advantage)
    least = jnp.minimum(ratio * advantage, jnp.clip(ratio, 1 - clip, 1 + clip) * advantage)
    return -(weight * least).sum()


def td_error(
    values: jax.Array, action: jax.Array, reward: jax.Array, discount: jax.Array,
    next_values: jax.Array, next_choice: jax.Array,
) -> jax.Array:  # fmt: skip
    """Q-learning's error, a scalar:
    ``reward + discount * Q'(s', argmax_a choice(s', a)) - Q(s, a)``.

    Args:
        values: Q of the state, ``[actions]``.
        action: what was done, int scalar.
        reward: of the step, or the discounted sum of n.
        discount: of what comes after; 0 where the episode terminated.
        next_values: the target network's Q of the state after, ``[actions]``, a constant.
        next_choice: what the next action is chosen by: the online network's Q for Double DQN (van
            Hasselt et al. 2016), ``next_values`` itself for DQN (Mnih et al. 2015).
    """
    chex.assert_rank([values, action, reward, discount], [1, 0, 0, 0])
    chex.assert_type(action, int)
    chex.assert_equal_shape([values, next_values, next_choice])
    target = reward + discount * next_values[jnp.argmax(next_choice)]
    return jax.lax.stop_gradient(target) - values[action]


def transition_loss(
    next_obs: jax.Array, reward: jax.Array, terminated_logit: jax.Array, true_next_obs: jax.Array,
    true_reward: jax.Array, true_terminated: jax.Array,
) -> jax.Array:  # fmt: skip
    """One term of Eq. 1: squared errors of state and reward plus the cross-entropy of the end.

    Args:
        next_obs: prediction ``[obs]`` (or of what is put in its place: a scaled change).
        reward: prediction, scalar.
        terminated_logit: log odds of the end, scalar.
        true_next_obs: ``[obs]``.
        true_reward: scalar.
        true_terminated: 0 or 1, scalar.

    Returns:
        A scalar. The paper prints the cross-entropy's two terms with ``p`` and ``1 - p``; from the
        logit they cannot overflow.
    """
    chex.assert_equal_shape([next_obs, true_next_obs])
    chex.assert_rank([next_obs, reward, terminated_logit], [1, 0, 0])
    chex.assert_rank([true_reward, true_terminated], 0)
    state_error = jnp.square(next_obs - true_next_obs).sum()
    reward_error = jnp.square(reward - true_reward)
    end_error = optax.sigmoid_binary_cross_entropy(
        terminated_logit, true_terminated.astype(terminated_logit.dtype)
    )
    return state_error + reward_error + end_error


class PixelLoss(NamedTuple):
    """A loss of a predicted picture (§3.2), and how its raw output is to be read."""

    #: ``(raw, truth) -> [...]``, the loss of each pixel; the truth lies in [0, 1]
    error: Callable[[jax.Array, jax.Array], jax.Array]
    #: ``raw -> [...]`` in [0, 1]: how much the pixel is believed to be lit
    probability: Callable[[jax.Array], jax.Array]
    #: ``raw -> [...]``: what another network that judges pictures is shown; the probability where
    #: that has a gradient everywhere, else ``raw`` itself
    picture: Callable[[jax.Array], jax.Array] = lambda raw: raw


def _clipped(raw: jax.Array) -> jax.Array:
    return jnp.clip(raw, 0, 1)


l1 = PixelLoss(lambda raw, truth: jnp.abs(raw - truth), _clipped)  #: ``|x - y|``
l2 = PixelLoss(lambda raw, truth: 0.5 * jnp.square(raw - truth), _clipped)  #: ``(x - y)² / 2``

bce = PixelLoss(optax.sigmoid_binary_cross_entropy, jax.nn.sigmoid, jax.nn.sigmoid)
"""The multi-label binary cross-entropy: every pixel is a label of its own."""


def deceive(fake_logit: jax.Array) -> jax.Array:
    """The generator's loss ``-log D(G(z))``, the non-saturating one (Goodfellow et al. 2014), by
    the discriminator's log odds that a made picture is a true one, and in their shape.
    """
    return jax.nn.softplus(-fake_logit)


def discern(real_logit: jax.Array, fake_logit: jax.Array) -> jax.Array:
    """The discriminator's loss ``-log D(x) - log(1 - D(G(z)))`` (§4.3) by its log odds that a true
    picture is one, and that a made picture is one; all three have the same shape.
    """
    chex.assert_equal_shape([real_logit, fake_logit])
    return jax.nn.softplus(-real_logit) + jax.nn.softplus(fake_logit)
