"""An environment that shows its state, for a planner that takes the true one for its model."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna.envs.gymnasium import spaces
from jaxdyna.types import Environment, Key


@dataclass(frozen=True)
class Revealed:
    """The same environment; what is seen of it is its observation and its state, flattened into
    one float32 vector ``[n]``. `read` takes it apart again, so that a planner can act in the one
    `jaxdyna.rollout.rollout`.

    Attributes:
        env: what is revealed; its numbers must be exact in float32, as integers below 2^24 are.
    """

    env: Environment

    @property
    def default_params(self) -> Any:
        """The environment's."""
        return self.env.default_params

    @property
    def num_actions(self) -> int:
        """The environment's."""
        return self.env.num_actions

    def read(self, seen: jax.Array, params: Any) -> tuple[jax.Array, Any]:
        """``obs, state`` of the environment out of what is seen ``[n]``."""
        shapes = jax.eval_shape(lambda: self.env.reset(jax.random.key(0), params))
        leaves, structure = jax.tree.flatten(shapes)
        ends = np.cumsum([math.prod(leaf.shape) for leaf in leaves])
        parts = jnp.split(seen, ends[:-1])
        read = [
            part.reshape(leaf.shape).astype(leaf.dtype)
            for part, leaf in zip(parts, leaves, strict=True)
        ]
        return jax.tree.unflatten(structure, read)

    def reset(self, key: Key, params: Any) -> tuple[jax.Array, Any]:
        """Starts an episode."""
        obs, state = self.env.reset(key, params)
        return _flat(obs, state), state

    def step(
        self, key: Key, state: Any, action: jax.Array, params: Any
    ) -> tuple[jax.Array, Any, jax.Array, jax.Array, jax.Array, dict[str, Any]]:
        """One step of the environment."""
        obs, state, *rest = self.env.step(key, state, action, params)
        return _flat(obs, state), state, *rest

    def observation_space(self, params: Any) -> spaces.Box:
        """Unbounded."""
        shape = jax.eval_shape(lambda: self.reset(jax.random.key(0), params)[0]).shape
        return spaces.Box(-np.inf, np.inf, shape, np.float32)

    def action_space(self, params: Any) -> Any:
        """The environment's."""
        return self.env.action_space(params)


def _flat(obs: jax.Array, state: Any) -> jax.Array:
    leaves = jax.tree.leaves((obs, state))
    return jnp.concatenate([jnp.ravel(leaf).astype(jnp.float32) for leaf in leaves])
