"""Behaviour cloning: an agent that another one shows what to do before it learns by itself.

The "Mb-Mf" of Nagabandi et al. 2018 (§V): a planner's episodes in the real environment are imitated
by supervised learning, and model-free learning goes on from there. Unlike there nothing is asked of
the planner about states that the imitator comes to (no DAgger).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import chex
import jax
import jax.numpy as jnp
import optax
from flax import struct

from jaxdyna.fields import Checked, setting
from jaxdyna.optimizers import Optimizer, optimizer_setting
from jaxdyna.replay import ring
from jaxdyna.replay.ring import Replay
from jaxdyna.trees import where
from jaxdyna.types import Agent, Key, Transition, check_part, check_transitions

Loss = Callable[[jax.Array, jax.Array], jax.Array]
"""``(outputs [A], action) -> loss`` of one imitated action, a scalar."""


def cross_entropy_loss(outputs: jax.Array, action: jax.Array) -> jax.Array:
    """``-log pi(action)``, a scalar in nats (Pomerleau 1991): ``outputs`` are a policy's log odds
    ``[A]``, ``action`` is the shown one, an int scalar.
    """
    chex.assert_rank([outputs, action], [1, 0])
    return -jax.nn.log_softmax(outputs)[action]


def margin_loss(outputs: jax.Array, action: jax.Array, margin: float = 0.8) -> jax.Array:
    """``max_a (Q(a) + margin [a is not the shown one]) - Q(shown)`` (DQfD, Hester et al. 2018,
    their J_E): the shown action has to be the best by a margin. ``outputs`` are values of actions
    ``[A]``, in whose unit the margin and the loss are, a scalar; ``action`` as in
    `cross_entropy_loss`.
    """
    chex.assert_rank([outputs, action], [1, 0])
    ahead = outputs + margin * (jnp.arange(outputs.shape[-1]) != action)
    return ahead.max() - outputs[action]


@dataclass(frozen=True)
class CloningConfig(Checked):
    """What decides the program."""

    updates: int = setting(
        200, "Gradient steps after each shown episode, on all that was shown so far.", at_least=1
    )
    batch: int = setting(64, "Shown transitions in each.", at_least=1, at_most=1_000_000)
    capacity: int = setting(4000, "Shown transitions kept.", at_least=1)
    learning_rate: float = setting(
        1e-2, "Learning rate of the optimiser, which starts anew after each shown episode.", above=0
    )
    loss: Loss = setting(
        cross_entropy_loss, "Loss of one imitated action.",
        choices=(cross_entropy_loss, margin_loss))  # fmt: skip
    learns_too: bool = setting(
        False,
        "Whether the agent's own update sees the shown episodes as well, as a learner that is "
        "off-policy can make use of them; imitation then starts from what it has learned, "
        "otherwise from the imitation of the episode before.",
    )
    optimizer: Optimizer = optimizer_setting(optax.adam)


@struct.dataclass
class CloningState:
    """What an imitator knows."""

    #: the agent's own; imitation leaves it alone while an expert plays, who may plan by its values
    agent: Any
    shown: Replay  #: the ``(obs, action)`` seen so far
    imitating: Any  #: parameters that imitate them
    #: whether the agent is to take these over when it next acts or learns by itself
    waiting: jax.Array


def cloning(
    agent: Agent,
    outputs: Callable[[Any, jax.Array], jax.Array],
    example: tuple[Any, Any],
    config: CloningConfig,
    install: Callable[[Any, Any], Any] = lambda state, params: replace(state, params=params),
) -> Agent:
    """An agent that imitates in ``update_expert`` and is ``agent``, with its hparams, in everything
    else.

    Args:
        agent: who learns; ``state.params`` is what its actions come from.
        outputs: ``(params, obs) -> [A]``, its log odds or values of one observation.
        example: one ``(obs, action)``: arrays, or anything with ``shape`` and ``dtype``.
        config: the program's settings.
        install: ``(state, params) -> state``: the agent with imitating parameters.
    """
    check_part("agent", agent, "init", "act", "update")

    def init(key: Key, hparams: Any) -> CloningState:
        own = agent.init(key, hparams)
        params = jax.tree.map(jnp.copy, own.params)
        return CloningState(own, ring.init(config.capacity, example), params, jnp.bool_(False))

    def imitate(params: Any, shown: Replay, key: Key) -> tuple[Any, jax.Array]:
        optimizer = config.optimizer(config.learning_rate)

        def loss_fn(params: Any, batch: tuple[jax.Array, jax.Array]) -> jax.Array:
            obs, action = batch
            return jax.vmap(config.loss)(jax.vmap(outputs, (None, 0))(params, obs), action).mean()

        def step(carry, key):
            params, opt_state = carry
            batch = ring.sample(shown, key, (config.batch,))
            loss, grads = jax.value_and_grad(loss_fn)(params, batch)
            updates, opt_state = optimizer.update(grads, opt_state, params)
            return (optax.apply_updates(params, updates), opt_state), loss

        keys = jax.random.split(key, config.updates)
        (params, _), losses = jax.lax.scan(step, (params, optimizer.init(params)), keys)
        return params, losses.mean()

    def update_expert(state: CloningState, transitions: Transition, key: Key, hparams: Any):
        check_transitions(transitions, 2)
        key_own, key_imitate = jax.random.split(key)
        seen = transitions.weights > 0
        items = (transitions.obs, transitions.action.astype(state.shown.data[1].dtype))
        shown = ring.add(state.shown, items, seen)
        own, params = state.agent, state.imitating
        if config.learns_too:
            own, _ = agent.update(own, transitions, key_own, hparams)
            params = own.params
        params, loss = imitate(params, shown, key_imitate)
        new = CloningState(own, shown, params, jnp.bool_(True))
        return where(seen.any(), new, state), {"loss": loss}

    return _lifted(agent, init, update_expert, install)


def _lifted(agent: Agent, init: Callable, update_expert: Callable, install: Callable) -> Agent:
    """The agent's own functions on a `CloningState`."""

    def imitating(state: CloningState) -> Any:
        """The agent's own state; with the parameters that wait."""
        return jax.tree.map(
            lambda new, old: old if new is old else jnp.where(state.waiting, new, old),
            install(state.agent, state.imitating),
            state.agent,
        )

    def lift_act(act: Callable) -> Callable:
        return lambda state, obs, key, hparams: act(imitating(state), obs, key, hparams)

    def lift_update(update: Callable) -> Callable:
        def lifted(state: CloningState, transitions: Transition, key: Key, hparams: Any):
            seen = (transitions.weights > 0).any()
            own = imitating(replace(state, waiting=state.waiting & seen))
            own, metrics = update(own, transitions, key, hparams)
            return replace(state, agent=own, waiting=state.waiting & ~seen), metrics

        return lifted

    return Agent(
        init,
        lift_act(agent.act),
        lift_update(agent.update),
        agent.act_fake and lift_act(agent.act_fake),
        agent.update_fake and lift_update(agent.update_fake),
        update_expert,
        agent.num_actions,
        agent.hparams,
        agent.act_greedy and lift_act(agent.act_greedy),
    )
