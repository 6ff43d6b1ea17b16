"""What planners take and return, the same for each of them."""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp

from jaxdyna.actions import actions_of
from jaxdyna.fields import check_counts
from jaxdyna.trees import as_held, where
from jaxdyna.types import Environment, Key

Value = Callable[[jax.Array, Any, Key], jax.Array]
"""``(obs, state, key) -> return still to come``, a scalar."""


class Guide(NamedTuple):
    """What a planner may be told beside the world.

    Attributes:
        prior: ``obs -> log odds of the actions [A]``, for the planners that start from a policy;
            None: all alike.
        value: what comes after the last step that is looked at, in the planner's discounted return;
            None: nothing, in a tree search a random episode. Not asked for after the world has
            ended, but after a truncation.
    """

    prior: Callable[[jax.Array], jax.Array] | None = None
    value: Value | None = None


class Decision(NamedTuple):
    """What to do now."""

    action: jax.Array  #: int32 scalar, or in a Box float32 ``[n]``
    value: jax.Array  #: the discounted return that the planner expects, scalar


class Planner(Protocol):
    """Decides by looking ahead in an environment, true or learned alike; pure."""

    def __call__(
        self, env_params: Any, obs: jax.Array, state: Any, key: Key, guide: Guide = Guide()
    ) -> Decision:
        """Plans from one state.

        Args:
            env_params: the environment's parameters; a learned one's weights travel here.
            obs: what is seen ``[*obs]``.
            state: the environment's state that is seen so.
            key: random key.
            guide: a prior, a value, or neither.
        """


def rollout_value(
    env: Environment, env_params: Any, num_steps: int = 50, discount: float = 1.0
) -> Value:
    """The value of a state by one random episode from it, of ``num_steps`` (static) at the most, as
    in the first Monte Carlo tree searches (Kocsis and Szepesvári 2006).
    """
    check_counts(num_steps=num_steps)
    space = actions_of(env)

    def value(obs: jax.Array, state: Any, key: Key) -> jax.Array:
        def step(carry, _):
            state, alive, weight, total, key = carry
            key, key_action, key_step = jax.random.split(key, 3)
            action = space.uniform(key_action)
            _, new, reward, terminated, truncated, _ = env.step(key_step, state, action, env_params)
            total = as_held(total + jnp.where(alive, weight * reward, 0.0), total)
            # a learned world that goes on after its end may leave all numbers behind
            state = where(alive, new, state)
            weight = as_held(discount * weight, weight)
            return (state, alive & ~(terminated | truncated), weight, total, key), None

        start = (state, jnp.bool_(True), jnp.float32(1), jnp.float32(0), key)
        return jax.lax.scan(step, start, length=num_steps)[0][3]

    return value
