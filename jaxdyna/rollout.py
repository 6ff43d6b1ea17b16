"""The one rollout: real, fake and evaluation episodes differ only in its arguments."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxdyna.actions import Discrete, actions_of
from jaxdyna.fields import check_counts, check_kind
from jaxdyna.trees import where
from jaxdyna.types import Environment, Key, Transition, check_key, check_part, check_transitions

Record = Callable[[Any, Any, dict[str, Any]], Any]
"""``(state, next_state, info) -> pytree``: what is kept of a step beside its `Transition`: of the
environment's state before it and after it, and of what the environment says of it."""


def rollout(
    env: Environment, act: Callable[..., jax.Array], key: Key, env_params: Any, num_episodes: int,
    *, num_steps: int | None = None, record: Record | None = None, sees_state: bool = False,
) -> Any:  # fmt: skip
    """Plays whole episodes side by side.

    Args:
        env: a true or a learned environment.
        act: ``(obs, key) -> action`` for one observation; close over the agent's state.
        key: random key.
        env_params: the environment's parameters; a learned environment's weights travel here.
        num_episodes: N, static.
        num_steps: T, static; by default ``env_params.max_steps``.
        record: what else is kept of every step; after the end of an episode of its last state.
        sees_state: whether ``act`` is a planner's, ``(obs, key, state) -> action``, which looks at
            the environment's state.

    Returns:
        A `Transition` ``[N, T, ...]``. After the end of an episode ``mask`` is False, the
        observations repeat the last one and the rest is zero. An episode that outlasts ``T`` is
        truncated at its last step: every episode ends in ``terminated`` or ``truncated``.
        With ``record`` a pair, the other being what was recorded, leaves ``[N, T, ...]``.

    Raises:
        AssertionError: where numbered actions are no integers.
        ValueError: where an argument cannot be, T is left open under a traced ``max_steps``, an
            action has another shape than the world's, a step's reward is no scalar, or, untraced,
            a numbered action is out of range.
    """
    check_part("env", env, "reset", "step", "default_params")
    space = actions_of(env)
    check_part("act", act, "__call__")
    check_key(key)
    check_kind("env_params", env_params, type(env.default_params))
    if num_steps is None:
        num_steps = _concrete_max_steps(env_params)
    check_counts(num_episodes=num_episodes, num_steps=num_steps)

    def step(carry, time):
        obs, state, alive, key = carry
        key, key_act, key_step = jax.random.split(key, 3)
        action = act(obs, key_act, state) if sees_state else act(obs, key_act)
        if jnp.shape(action) != space.shape:
            wanted = f"one {space.shape}" if space.shape else "a scalar"
            raise ValueError(f"act returns an array {jnp.shape(action)}: make it {wanted}")
        played = env.step(key_step, state, action, env_params)
        _check_step(env, obs, state, played)
        next_obs, next_state, reward, terminated, truncated, info = played
        reward = jnp.asarray(reward) * 1.0
        kept = record(state, next_state, info) if record else ()
        terminated, truncated = jnp.asarray(terminated, bool), jnp.asarray(truncated, bool)
        truncated = truncated | ((time == num_steps - 1) & ~terminated)
        transition = Transition(
            obs=obs,
            action=jnp.where(alive, action, 0),
            reward=jnp.where(alive, reward, 0),
            next_obs=where(alive, next_obs, obs),
            terminated=terminated & alive,
            truncated=truncated & alive,
            mask=alive,
        )
        # Frozen after the end: a learned model fed with its own output for ever may overflow.
        state = where(alive, next_state, state)
        alive = alive & ~(terminated | truncated)
        return (transition.next_obs, state, alive, key), (transition, kept)

    def episode(key: Key) -> tuple[Transition, Any]:
        key_reset, key_steps = jax.random.split(key)
        obs, state = env.reset(key_reset, env_params)
        start = (obs, state, jnp.bool_(True), key_steps)
        return jax.lax.scan(step, start, jnp.arange(num_steps))[1]

    played, recorded = jax.vmap(episode)(jax.random.split(key, num_episodes))
    check_transitions(played, 2)
    if isinstance(space, Discrete) and not isinstance(played.action, jax.core.Tracer):
        least, most, count = played.action.min(), played.action.max(), space.n
        if least < 0 or most >= count:
            raise ValueError(f"actions are {least} to {most}: keep them within 0 to {count - 1}")
    return (played, recorded) if record else played


def _check_step(env: Environment, obs: Any, state: Any, played: Any) -> None:
    """Raises ValueError where a step returns what no step does."""
    wrong = ""
    if not (isinstance(played, tuple) and len(played) == 6):
        wrong = "does not return obs, state, reward, terminated, truncated, info"
    elif played[2] is None or jnp.shape(played[2]):
        earned = "None" if played[2] is None else f"an array {jnp.shape(played[2])}"
        wrong = f"earns {earned}: make it a scalar"
    elif _kinds(played[0]) != _kinds(obs):
        wrong = f"observes {_kinds(played[0])} after {_kinds(obs)}: make the two alike"
    elif str(jax.tree.structure(played[1])) != str(jax.tree.structure(state)):
        wrong = "returns a state of another structure than the one before it: make the two alike"
    if wrong:
        found = "jaxdyna.testing.check_environment finds such faults"
        raise ValueError(f"a step of {type(env).__name__} {wrong}; {found}")


def _kinds(obs: Any) -> str:
    """Shapes of arrays and what is in them, whatever the precision."""
    names = {"f": "numbers", "i": "whole numbers", "u": "bytes", "b": "bools"}
    said = [(names.get(jnp.result_type(one).kind, "?"), jnp.shape(one))
            for one in jax.tree.leaves(obs)]  # fmt: skip
    return ", ".join(f"{what} {list(shape)}" for what, shape in said)


def _concrete_max_steps(env_params: Any) -> int:
    if isinstance(env_params.max_steps, jax.core.Tracer):
        raise ValueError(
            "env_params.max_steps is traced: give rollout num_steps, the longest episode, as a "
            "Python number"
        )
    return int(env_params.max_steps)
