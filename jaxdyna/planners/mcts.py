"""Monte Carlo tree search by mctx, an environment's ``step`` as its recurrent function: a learned
model is searched as MuZero searches its own (Schrittwieser et al. 2020).

A node that the search has just reached is worth `jaxdyna.planners.Guide.value`, and without one
what a random episode from there earns (`jaxdyna.planners.rollout_value`): the tree alone sees few
steps ahead, and where rewards come later, or at every step alike, all actions would look the same.

The ``planning`` extra brings mctx; nothing else needs it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxdyna.actions import actions_of, number_of
from jaxdyna.fields import Checked, setting
from jaxdyna.planners.decision import Decision, Guide, Planner, rollout_value
from jaxdyna.trees import where
from jaxdyna.types import Environment, Key


@dataclass(frozen=True)
class SearchConfig(Checked):
    """What decides the program."""

    simulations: int = setting(32, "Nodes that the tree grows by: steps of the world.", at_least=1)
    max_depth: int | None = setting(None, "Deepest node; None: as many as simulations.", at_least=1)
    discount: float = setting(0.99, "Discount of the return.", at_least=0, at_most=1)
    considered: int = setting(
        16, "Actions at the root that gumbel_muzero looks at, the likeliest by prior and noise.",
        at_least=1)  # fmt: skip
    gumbel_scale: float = setting(
        0.0, "Scale of that noise; 0 looks at the likeliest and decides for the best.", at_least=0
    )
    dirichlet_fraction: float = setting(
        0.0, "Share of noise in the prior at the root of muzero.", at_least=0, at_most=1
    )
    temperature: float = setting(
        0.0, "Temperature of the visits that muzero draws its action by; 0 takes the most visited.",
        at_least=0, infinite=True)  # fmt: skip


class Node(NamedTuple):
    """What the tree keeps of a step, each ``[B, ...]``: the last one of an episode that is over,
    by an end of the world where ``ended``.
    """

    obs: jax.Array
    state: Any
    alive: jax.Array
    ended: jax.Array


def gumbel_muzero(env: Environment, config: SearchConfig) -> Planner:
    """Search by sequential halving with Gumbel noise (Danihelka et al. 2022): a policy is improved
    whatever the number of simulations. ``env`` and errors as in `muzero`.
    """
    mctx = require_mctx()

    def search(key: Key, root: Any, recurrent: Callable) -> Any:
        return mctx.gumbel_muzero_policy(
            None, key, root, recurrent, config.simulations, max_depth=config.max_depth,
            max_num_considered_actions=config.considered, gumbel_scale=config.gumbel_scale,
        )  # fmt: skip

    return _planner(mctx, env, config, search)


def muzero(env: Environment, config: SearchConfig) -> Planner:
    """Search by upper confidence bounds under the prior (Schrittwieser et al. 2020) in ``env``, a
    true or a learned environment; `ImportError` without mctx, `ValueError` where actions are a Box.
    """
    mctx = require_mctx()

    def search(key: Key, root: Any, recurrent: Callable) -> Any:
        return mctx.muzero_policy(
            None, key, root, recurrent, config.simulations, max_depth=config.max_depth,
            dirichlet_fraction=config.dirichlet_fraction, temperature=config.temperature,
        )  # fmt: skip

    return _planner(mctx, env, config, search)


WORST = -1e6  #: what a reward or value that is not finite counts as


def _planner(mctx: Any, env: Environment, config: SearchConfig, search: Callable) -> Planner:
    """mctx searches batches: this one's is of 1, and ``vmap`` makes them larger."""
    count = number_of(actions_of(env), "tree search", "plan by cross_entropy or random_shooting")

    def plan(
        env_params: Any, obs: jax.Array, state: Any, key: Key, guide: Guide = Guide()
    ) -> Decision:
        def prior(obs: jax.Array) -> jax.Array:
            return guide.prior(obs) if guide.prior else jnp.zeros(count)

        ahead = guide.value or rollout_value(env, env_params, discount=config.discount)

        def value(node: Node, key: Key) -> jax.Array:
            return ahead(node.obs, node.state, key)

        def step(node: Node, action: jax.Array, key: Key):
            """One step of the world; an episode that is over stays where it is, at its value."""
            key_step, key_value = jax.random.split(key)
            obs, state, reward, terminated, truncated, _ = env.step(
                key_step, node.state, action, env_params
            )
            new = Node(obs, state, ~(terminated | truncated), terminated)
            new = where(node.alive, new, node)
            output = mctx.RecurrentFnOutput(
                reward=jnp.where(node.alive, reward, 0.0),
                discount=jnp.where(node.alive, config.discount * (1.0 - terminated), 1.0),
                prior_logits=prior(new.obs),
                value=jnp.where(new.ended, 0.0, value(new, key_value)),  # which need be no number
            )
            return _singles(output), new

        def recurrent(_: Any, key: Key, action: jax.Array, node: Node):
            keys = jax.random.split(jax.random.wrap_key_data(key), action.shape[0])
            return jax.vmap(step)(node, action, keys)

        key_value, key_search = jax.random.split(key)
        node = Node(obs, state, jnp.bool_(True), jnp.bool_(False))
        hoped, odds = _singles((value(node, key_value), prior(obs)))
        root = mctx.RootFnOutput(prior_logits=odds, value=hoped, embedding=node)
        raw = jax.random.key_data(key_search)  # mctx draws twice from one: a typed key refuses
        found = search(raw, jax.tree.map(lambda leaf: leaf[None], root), recurrent)
        tree = found.search_tree
        action = found.action[0].astype(jnp.int32)
        return Decision(action, tree.qvalues(jnp.zeros(1, jnp.int32))[0, action])

    return plan


def _singles(numbers: Any) -> Any:
    """In float32, whatever x64, a world and a guide say: mctx wants all nodes of the same type; and
    what is not finite is the worst, as it would win any comparison.
    """

    def single(number: Any) -> jax.Array:
        number = jnp.asarray(number, jnp.float32)
        return jnp.where(jnp.isfinite(number), number, WORST)

    return jax.tree.map(single, numbers)


def require_mctx() -> Any:
    """The module mctx; `ImportError` with what to install."""
    try:
        import mctx  # noqa: PLC0415 - only this module needs it, and only when it is used
    except ImportError as error:
        raise ImportError("tree search needs mctx: pip install 'jaxdyna[planning]'") from error
    return mctx
