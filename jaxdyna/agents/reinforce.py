"""REINFORCE (Williams 1992), §3.1.2 of the paper: a small network updated after every episode."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct

from jaxdyna.actions import Actions, as_actions
from jaxdyna.fields import Checked, check_shape, setting
from jaxdyna.losses import clipped_policy_gradient, discounted_returns, policy_gradient, standardise
from jaxdyna.networks import MLP
from jaxdyna.optimizers import Optimizer, Trained, optimizer_setting
from jaxdyna.trees import where
from jaxdyna.types import Agent, Key, Transition, check_transitions


def no_baseline(returns: jax.Array, valid: jax.Array) -> jax.Array:
    """The returns themselves, 0 where not valid: advantages ``[N, T]``. Right where a reward comes
    at the end alone: standardised within its episode, a lost game is as good as a won one. Adam
    forgets their scale.

    Args:
        returns: of each step on, ``[N, T]``.
        valid: bool ``[N, T]``, which steps there are.
    """
    return jnp.where(valid, returns, 0)


def within_episode(returns: jax.Array, valid: jax.Array) -> jax.Array:
    """Standardised within each episode, as the paper's authors do; shapes as in `no_baseline`."""
    return jax.vmap(standardise)(returns, valid)


def over_batch(returns: jax.Array, valid: jax.Array) -> jax.Array:
    """Returns standardised over all steps of all episodes: the better episodes stand out from the
    worse. With a single episode the same as `within_episode`. Shapes as in `no_baseline`.
    """
    return standardise(returns, valid)


def per_step(returns: jax.Array, valid: jax.Array) -> jax.Array:
    """Returns less the mean, at the same step, of the episodes that got there, then scaled to unit
    standard deviation: episodes that all last to the end leave the policy alone. A single episode
    has nothing to be compared with and falls back on `within_episode`. Shapes as in `no_baseline`.
    """
    if returns.shape[0] == 1:
        return within_episode(returns, valid)
    mean = jnp.where(valid, returns, 0).sum(0) / jnp.maximum(valid.sum(0), 1)
    return standardise(jnp.where(valid, returns - mean, 0), valid)


@struct.dataclass
class ReinforceHParams:
    """What can be swept."""

    learning_rate: float = setting(
        1e-2, "Learning rate of the policy's optimiser.", at_least=0, everyday=True
    )
    discount: float = setting(0.99, "Discount of returns.", at_least=0, at_most=1, everyday=True)


@dataclass(frozen=True)
class ReinforceConfig(Checked):
    """What decides the program."""

    hidden: tuple[int, ...] = setting(
        (8,), "Widths of the policy's hidden layers.", at_least=1, everyday=True
    )
    advantage: Callable[[jax.Array, jax.Array], jax.Array] = setting(
        no_baseline,
        "What is done against the returns' variance, (returns [N, T], valid [N, T]) -> [N, T]: "
        "nothing, or standardised within each episode, over the batch, or step by step.",
        choices=(no_baseline, within_episode, over_batch, per_step),
    )
    optimizer: Optimizer = optimizer_setting(optax.adam)
    epochs: int = setting(
        1, "Gradient steps on each batch of episodes; from the second on how far the policy may go "
        "from the one that played them is clipped (PPO).", at_least=1)  # fmt: skip
    output_variance: float = setting(
        1.0, "Variance of the policy's initial output weights, see jaxdyna.networks.MLP: a small "
        "one begins with all actions alike.", above=0)  # fmt: skip


def _network(actions: Actions, config: ReinforceConfig) -> MLP:
    seen, free = actions.outputs
    return MLP((*config.hidden, seen), output_variance=config.output_variance, free=free)


def policy_logits(
    num_actions: int | Actions, config: ReinforceConfig
) -> Callable[[Any, jax.Array], jax.Array]:
    """``(params, obs [*obs]) -> [A]``: the log odds that an agent of `reinforce` acts by, or in a
    Box what its Gaussian is, see `jaxdyna.actions`.
    """
    network = _network(as_actions(num_actions), config)

    def logits(params: Any, obs: jax.Array) -> jax.Array:
        return jnp.asarray(network.apply(params, obs.reshape(-1).astype(jnp.float32)))

    return logits


def reinforce(
    obs_shape: tuple[int, ...], num_actions: int | Actions, config: ReinforceConfig | None = None
) -> Agent:
    """An `Agent` whose hparams are `ReinforceHParams`; it flattens observations ``obs_shape``. Of
    numbered actions its policy is categorical, in a Box Gaussian, with standard deviations that do
    not depend on what is seen.
    """
    config = config or ReinforceConfig()
    check_shape(obs_shape=obs_shape)
    actions, logits = as_actions(num_actions), policy_logits(num_actions, config)
    network = _network(actions, config)
    surrogate = partial(policy_gradient, log_prob=actions.log_prob)
    clipped_surrogate = partial(clipped_policy_gradient, log_prob=actions.log_prob)

    def init(key: Key, hparams: ReinforceHParams) -> Trained:
        params = network.init(key, jnp.zeros(obs_shape, jnp.float32).reshape(-1))
        opt_state = config.optimizer(hparams.learning_rate).init(params)
        return Trained(params, opt_state)

    def act(state: Trained, obs: jax.Array, key: Key, hparams: Any) -> jax.Array:
        return actions.sample(key, logits(state.params, obs))

    def act_greedy(state: Trained, obs: jax.Array, *_: Any) -> jax.Array:
        return actions.mode(logits(state.params, obs))

    def update(
        state: Trained, transitions: Transition, key: Key, hparams: ReinforceHParams
    ) -> tuple[Trained, dict[str, jax.Array]]:
        """Adam forgets the loss's scale, so the mean weight of the batch scales the steps
        themselves: data of weight 0.5 moves the policy half as far. The loss is the first step's.
        """
        check_transitions(transitions, 2)
        transitions, weight = transitions.blanked(), transitions.weights
        valid = weight > 0
        returns = jax.vmap(discounted_returns, (0, None))(
            jnp.where(valid, transitions.reward, 0), hparams.discount
        )
        advantage = config.advantage(returns, valid)
        optimizer = config.optimizer(hparams.learning_rate)
        mean_weight = weight.sum() / jnp.maximum(valid.sum(), 1)

        def outputs(params):
            return jax.vmap(jax.vmap(logits, (None, 0)), (None, 0))(params, transitions.obs)

        def on_policy(params):
            now = outputs(params)
            return jax.vmap(surrogate)(now, transitions.action, advantage, weight).mean()

        def step(state: Trained, loss_fn: Callable) -> tuple[Trained, jax.Array]:
            loss, grads = jax.value_and_grad(loss_fn)(state.params)
            updates, opt_state = optimizer.update(grads, state.opt_state, state.params)
            updates = jax.tree.map(lambda update: update * mean_weight, updates)
            return Trained(optax.apply_updates(state.params, updates), opt_state), loss

        new, loss = step(state, on_policy)
        if config.epochs > 1:
            before = outputs(state.params)

            def clipped(params):
                batch = outputs(params), transitions.action, advantage, weight, before
                return jax.vmap(clipped_surrogate)(*batch).mean()

            new, _ = jax.lax.scan(
                lambda state, _: step(state, clipped), new, length=config.epochs - 1
            )
        return where(valid.any(), new, state), {"loss": loss}

    return Agent(
        init, act, update, act_greedy=act_greedy, num_actions=num_actions, hparams=ReinforceHParams
    )
