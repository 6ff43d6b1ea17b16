"""Model-predictive control over sequences of actions, numbered or in a Box (Nagabandi et al. 2018,
§IV-C): try sequences in the world, do the first action of the best one, plan anew after every step.

A reward is seen only within the horizon: it has to reach as far as the goal is, or
`jaxdyna.planners.Guide.value` has to say what comes after, as `jaxdyna.planners.rollout_value`
does. Planning starts from nothing at every step: there is no warm start.
"""

import math
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from jaxdyna.actions import Discrete, actions_of
from jaxdyna.fields import Checked, SettingError, setting
from jaxdyna.planners.decision import Decision, Guide, Planner, Value
from jaxdyna.trees import as_held, where
from jaxdyna.types import Environment, Key


@dataclass(frozen=True)
class ShootingConfig(Checked):
    """What decides the program."""

    horizon: int = setting(20, "Steps that are looked ahead.", at_least=1)
    candidates: int = setting(
        64, "Sequences that are tried; times horizon, the steps of the world.", at_least=1
    )
    discount: float = setting(1.0, "Discount of the return.", at_least=0, at_most=1)
    drift: float = setting(
        0.0,
        "Standard deviation of the log odds of a candidate's actions, drawn for each, or in a Box "
        "of what moves them, over half its width: it keeps a direction, as a random walk does not. "
        "0: every action is as likely at every step.",
        at_least=0,
    )
    temperature: float = setting(
        0.0,
        "Temperature of the returns by which random shooting chooses: an action is worth t log "
        "mean exp(return / t) of the sequences that begin with it. 0 goes by the best of them, "
        "infinity by their mean: what is safe whatever follows wins over what a single sequence "
        "gets away with. In a Box the best sequence wins.", at_least=0,
        infinite=True)  # fmt: skip
    particles: int = setting(
        1, "Episodes that a sequence is judged by, for a world that is random.", at_least=1
    )


@dataclass(frozen=True)
class CrossEntropyConfig(ShootingConfig):
    """What decides the program of the cross-entropy method."""

    iterations: int = setting(3, "Rounds of so many candidates each.", at_least=1)
    elites: int = setting(8, "Best candidates of a round, which the next is like.", at_least=1)
    floor: float = setting(
        0.1, "Least probability of an action in the next round, shared by all actions; in a Box "
        "least standard deviation, over half its width.", above=0, at_most=1)  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.elites > self.candidates:
            raise SettingError("elites", f"is {self.elites}: of only {self.candidates} candidates")


def score(
    env: Environment, env_params: Any, obs: jax.Array, state: Any, actions: jax.Array, key: Key,
    discount: float = 1.0, value: Value | None = None,
) -> jax.Array:  # fmt: skip
    """The return, a scalar, of a sequence of actions: the discounted rewards up to the end of the
    episode and ``value`` of where it is left, unless the world has ended there.

    Args:
        env: the world, true or learned.
        env_params: its parameters.
        obs: what is seen first, ``[*obs]``.
        state: the world's state that is seen so.
        actions: ``[H, ...]``.
        key: random key.
        discount: scalar in [0, 1].
        value: of where it is left; None: 0.
    """
    key_steps, key_value = jax.random.split(key)

    def step(carry, action):
        seen, state, alive, ended, weight, total, key = carry
        key, key_now = jax.random.split(key)
        next_obs, next_state, reward, terminated, truncated, _ = env.step(
            key_now, state, action, env_params
        )
        total = as_held(total + jnp.where(alive, weight * reward, 0.0), total)
        weight = where(alive, discount * weight, weight)
        ended = ended | (alive & terminated)
        seen, state = where(alive, (next_obs if value else (), next_state), (seen, state))
        return (seen, state, alive & ~(terminated | truncated), ended, weight, total, key), None

    flags, numbers = (jnp.bool_(True), jnp.bool_(False)), (jnp.float32(1), jnp.float32(0))
    start = (obs if value else (), state, *flags, *numbers, key_steps)
    (seen, state, _, ended, weight, total, _), _ = jax.lax.scan(step, start, actions)
    if value is None:
        return total
    rest = value(jnp.asarray(seen), state, key_value)
    return total + jnp.where(ended, 0.0, weight * rest)


def random_shooting(env: Environment, config: ShootingConfig) -> Planner:
    """The best of random sequences in ``env``, true or learned; the first of equally good ones."""
    judge, space = _judge(env, config), actions_of(env)

    def plan(
        env_params: Any, obs: jax.Array, state: Any, key: Key, guide: Guide = Guide()
    ) -> Decision:
        key_draw, key_score = jax.random.split(key)
        actions = space.sequences(key_draw, (config.candidates, config.horizon), config.drift)
        returns = judge(env_params, obs, state, actions, key_score, guide.value)
        choices = space.choices(actions[:, 0])
        worth = returns  # in a Box, where a choice is a sequence
        if isinstance(space, Discrete):
            worth = _worth(choices, actions[:, 0], returns, config.temperature)
        best = jnp.argmax(worth)
        return Decision(choices[best].astype(space.dtype), worth[best])

    return plan


def cross_entropy(env: Environment, config: CrossEntropyConfig) -> Planner:
    """The cross-entropy method (Rubinstein 1999; Botev et al. 2013): rounds of sequences, each
    round's actions drawn with the frequencies that they have, at each step, in the best sequences
    of the round before, or in a Box with their means and standard deviations. The first action of
    the best sequence of all rounds is done.
    """
    judge, space = _judge(env, config), actions_of(env)
    shape = (config.candidates, config.horizon)

    def plan(
        env_params: Any, obs: jax.Array, state: Any, key: Key, guide: Guide = Guide()
    ) -> Decision:
        def consider(best: Decision, actions: jax.Array, key: Key) -> tuple[Decision, jax.Array]:
            returns = judge(env_params, obs, state, actions, key, guide.value)
            values, rows = jax.lax.top_k(returns, config.elites)
            new = Decision(actions[rows[0], 0].astype(space.dtype), values[0])
            better = new.value > best.value
            return where(better, new, best), space.like(actions[rows], config.floor)

        def again(carry, _):
            best, outputs, key = carry
            key, key_draw, key_score = jax.random.split(key, 3)
            actions = space.clip(space.sample(key_draw, outputs, shape))
            return (*consider(best, actions, key_score), key), None

        key_draw, key_score, key_rounds = jax.random.split(key, 3)
        nothing = Decision(jnp.zeros(space.shape, space.dtype), -jnp.float32(jnp.inf))
        first = consider(nothing, space.sequences(key_draw, shape, config.drift), key_score)
        rounds = config.iterations - 1
        return jax.lax.scan(again, (*first, key_rounds), length=rounds)[0][0]

    return plan


def _worth(
    choices: jax.Array, first: jax.Array, returns: jax.Array, temperature: float
) -> jax.Array:
    """What each of the choices ``[A, ...]`` is worth ``[A]``, by the returns of sequences
    ``[candidates]`` and their first actions ``[candidates, ...]``; -inf for one that was not tried.
    Information-theoretic control (Williams et al. 2017), action by action.
    """
    own = (first == choices[:, None]).reshape(len(choices), len(first), -1).all(-1)
    tried = jnp.where(own, returns, -jnp.inf)
    if temperature == 0:
        return tried.max(-1)
    if math.isinf(temperature):
        mean = jnp.where(own, returns, 0).sum(-1) / jnp.maximum(own.sum(-1), 1)
        return jnp.where(own.any(-1), mean, -jnp.inf)
    count = jnp.maximum(own.sum(-1), 1)  # log 0 would make NaN of an action not tried
    return temperature * (jax.nn.logsumexp(tried / temperature, -1) - jnp.log(count))


def _judge(env: Environment, config: ShootingConfig):
    """Returns ``[candidates]`` of sequences ``[candidates, horizon, ...]``, means over particles;
    what is not finite is worst.
    """

    def judge(env_params, obs, state, actions, key, value):
        def one(actions, key):
            return score(env, env_params, obs, state, actions, key, config.discount, value)

        keys = jax.random.split(key, (actions.shape[0], config.particles))
        returns = jax.vmap(jax.vmap(one, (None, 0)))(actions, keys).mean(-1)
        return jnp.where(jnp.isfinite(returns), returns, -jnp.inf)  # argmax would choose a NaN

    return judge
