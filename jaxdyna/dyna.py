"""The two-phase loop of Fig. 3: real episodes first, then real and dreamed ones in turn.

It knows no particular agent, model or environment; arms of a comparison differ by the parts and
counts it is given. What a real episode draws from its key is the same in every arm.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from jaxdyna import replay
from jaxdyna.rollout import rollout
from jaxdyna.settings import DynaConfig, DynaHParams
from jaxdyna.types import Agent, DynamicsModel, Environment, Key, Transition

Metrics = dict[str, jax.Array]


class Dream(NamedTuple):
    """The world that fake episodes are played in.

    Attributes:
        env: a learned environment, or for the oracle the true one.
        params: ``(state, hparams) -> env_params`` from the run's `DynaState`.
    """

    env: Environment
    params: Callable[[DynaState, DynaHParams], Any]


class Dyna(NamedTuple):
    """The parts. Without ``model`` nothing is learned of the world; without ``dream`` the arm is
    model-free.

    Attributes:
        env: the real environment.
        agent: who acts.
        model: learns from every real transition so far.
        dream: where fake episodes are played.
        diagnose: ``(model_params, transitions, key) -> metrics``: judges the model on real
            episodes ``[N, T]`` that it has not been trained on yet.
    """

    env: Environment
    agent: Agent
    model: DynamicsModel | None = None
    dream: Dream | None = None
    diagnose: Callable[[Any, Transition, Key], Metrics] | None = None


@struct.dataclass
class DynaState:
    """A run between two real episodes; arrays only.

    Attributes:
        agent: the agent's state.
        model: the model's state, None without one.
        replay: real transitions so far, None without a model.
        starts: first observations of the real episodes so far, None without a model.
        key: the random key of all that follows.
    """

    agent: Any
    model: Any
    replay: Any
    starts: Any
    key: Key


def make_init(dyna: Dyna, config: DynaConfig) -> Callable[[Key, DynaHParams], DynaState]:
    """``init(key, hparams) -> state``: a run before its first episode."""

    def init(key: Key, hparams: DynaHParams) -> DynaState:
        key, key_agent, key_model = jax.random.split(key, 3)
        agent = dyna.agent.init(key_agent, hparams.agent)
        if dyna.model is None:
            return DynaState(agent, None, None, None, key)
        episode = jax.eval_shape(lambda: _play_real(dyna, config, agent, key, hparams))
        example = jax.tree.map(
            lambda leaf: jax.ShapeDtypeStruct(leaf.shape[2:], leaf.dtype), episode
        )
        capacity = config.replay_capacity or config.num_episodes * config.num_steps
        return DynaState(
            agent=agent,
            model=dyna.model.init(key_model, hparams.model),
            replay=replay.init(capacity, example),
            starts=replay.init(config.num_episodes, example.obs),
            key=key,
        )

    return init


def make_advance(
    dyna: Dyna, config: DynaConfig
) -> Callable[[DynaState, jax.Array, DynaHParams], tuple[DynaState, Metrics]]:
    """``advance(state, episodes, hparams) -> (state, metrics)``: plays the real episodes numbered
    ``episodes`` (int ``[K]``, counted from 0) with their dreams; metrics are ``[K, ...]``.

    A run cut into pieces is the same run. Keep ``episodes`` unbatched under ``vmap``: then dreams
    of the first phase cost nothing.
    """

    def step(state: DynaState, episode: jax.Array, hparams: DynaHParams):
        key, key_real, key_agent, key_model, key_dream = jax.random.split(state.key, 5)
        state = replace(state, key=key)
        real = _play_real(dyna, config, state.agent, key_real, hparams)
        agent, agent_metrics = dyna.agent.update(state.agent, real, key_agent, hparams.agent)
        state = replace(state, agent=agent)
        metrics = {"agent_loss": agent_metrics["loss"], **_summary("real", real)}
        if dyna.model is not None:
            state, model_metrics = _learn_model(
                dyna, config, state, real, episode, key_model, hparams
            )
            metrics |= model_metrics
        if dyna.dream is not None and config.dream_updates > 0:
            agent, dream_metrics = jax.lax.cond(
                episode >= config.num_real_first,
                lambda: _dream(dyna, config, state, episode, key_dream, hparams),
                lambda: (
                    state.agent,
                    {name: jnp.float32(jnp.nan) for name in ("fake_return", "fake_length")},
                ),
            )
            state = replace(state, agent=agent)
            metrics |= dream_metrics
        return state, metrics

    def advance(state: DynaState, episodes: jax.Array, hparams: DynaHParams):
        return jax.lax.scan(lambda state, episode: step(state, episode, hparams), state, episodes)

    return advance


def make_train(
    dyna: Dyna, config: DynaConfig
) -> Callable[[Key, DynaHParams], tuple[DynaState, Metrics]]:
    """``train(key, hparams) -> (state, metrics)``: a whole run as one pure function; metrics have
    a leading axis of ``config.num_episodes``.
    """
    init, advance = make_init(dyna, config), make_advance(dyna, config)

    def train(key: Key, hparams: DynaHParams) -> tuple[DynaState, Metrics]:
        return advance(init(key, hparams), jnp.arange(config.num_episodes), hparams)

    return train


def _play_real(dyna, config, agent, key, hparams) -> Transition:
    def act(obs, key):
        return dyna.agent.act(agent, obs, key, hparams.agent)

    return rollout(dyna.env, act, key, hparams.env, 1, num_steps=config.num_steps)


def _learn_model(dyna, config, state, real, episode, key, hparams) -> tuple[DynaState, Metrics]:
    """Judges the model on the new episode, then stores it and trains on all that is stored."""
    key_diagnose, key_sample, key_update = jax.random.split(key, 3)
    metrics = {}
    if dyna.diagnose is not None:
        metrics = dyna.diagnose(state.model.params, real, key_diagnose)
    held = state.replay
    if config.forget_every:
        start_of_block = episode % config.forget_every == 0
        held = replace(held, added=jnp.where(start_of_block, 0, held.added))
    held = replay.add(held, real, real.mask)
    starts = replay.add(state.starts, real.obs[:, 0], real.mask[:, 0])
    batches = replay.sample(held, key_sample, (config.model_updates, config.model_batch))

    def update(carry, batch):
        model, key = carry
        key, key_now = jax.random.split(key)
        model, losses = dyna.model.update(model, batch, key_now, hparams.model)
        return (model, key), losses

    (model, _), losses = jax.lax.scan(update, (state.model, key_update), batches)
    metrics["model_loss"] = losses["loss"].mean() if config.model_updates else jnp.float32(0)
    return replace(state, model=model, replay=held, starts=starts), metrics


def _dream(dyna, config, state, episode, key, hparams) -> tuple[Any, Metrics]:
    """Policy updates on fake episodes; returns the agent's new state."""
    env_params = dyna.dream.params(state, hparams)
    weight = jnp.where(episode >= hparams.num_real_first, hparams.fake_weight, 0.0)

    def update(carry, _):
        agent, key = carry
        key, key_play, key_update = jax.random.split(key, 3)

        def act(obs, key):
            return dyna.agent.act(agent, obs, key, hparams.agent)

        fake = rollout(
            dyna.dream.env,
            act,
            key_play,
            env_params,
            config.dream_episodes,
            num_steps=config.num_steps,
        )
        weighted = fake._replace(mask=fake.mask * weight)
        agent, _ = dyna.agent.update(agent, weighted, key_update, hparams.agent)
        return (agent, key), _summary("fake", fake)

    (agent, _), metrics = jax.lax.scan(update, (state.agent, key), length=config.dream_updates)
    return agent, jax.tree.map(jnp.mean, metrics)


def _summary(name: str, transitions: Transition) -> Metrics:
    """Mean undiscounted return and length of the episodes."""
    return {
        f"{name}_return": (transitions.reward * transitions.mask).sum(-1).mean(),
        f"{name}_length": transitions.mask.sum(-1).astype(jnp.float32).mean(),
    }
