"""The two-phase loop of Fig. 3: real episodes first, then real and dreamed ones in turn.

It knows no particular agent, model or environment; arms of a comparison differ by the parts and
counts it is given. What a real episode draws from its key is the same in every arm.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from jaxdyna.actions import actions_of
from jaxdyna.dyna.conditional import mean_of_done, unknown
from jaxdyna.dyna.config import DynaConfig, DynaHParams
from jaxdyna.dyna.parts import Dyna, DynaState, Metrics, check_hparams, check_parts, check_shapes
from jaxdyna.replay import ring
from jaxdyna.rollout import rollout
from jaxdyna.trees import finite, where, where_needed
from jaxdyna.types import Key, Transition, check_key

DIVERGED = ("world", "agent", "model")
"""Whose numbers may stop being finite: the metric ``diverged`` counts them from 1, 0 is none."""

SAFE_IN_A_ROW = 2
"""Updates on dreams that must find all their fake episodes safe before dreaming stops: one may be
luck (``docs/development-log.md``).
"""


def make_init(dyna: Dyna, config: DynaConfig) -> Callable[[Key, DynaHParams], DynaState]:
    """A run before its first episode: ``init(key, hparams) -> state``. `ValueError` where the parts
    do not fit each other; of ``init`` also where hyper-parameters do not.

    Args:
        dyna: the parts.
        config: its counts.
    """
    check_parts(dyna, config)

    def init(key: Key, hparams: DynaHParams) -> DynaState:
        check_key(key)
        check_hparams(dyna, config, hparams)
        state = start(key, hparams)
        check_shapes(dyna, state, hparams)
        return state

    def start(key: Key, hparams: DynaHParams) -> DynaState:
        key, key_agent, key_model = jax.random.split(key, 3)
        agent = dyna.agent.init(key_agent, hparams.agent)
        model = dyna.model and dyna.model.init(key_model, hparams.model)
        state = DynaState(agent, model, None, None, jnp.bool_(False), key)
        if dyna.memory is None or not _remembers(dyna, config):
            return state
        check_shapes(dyna._replace(model=None, dream=None), state, hparams)
        episode = jax.eval_shape(lambda: play_real(dyna, config, agent, key, hparams))
        example, recorded = jax.tree.map(
            lambda leaf: jax.ShapeDtypeStruct(leaf.shape[2:], leaf.dtype), episode
        )
        capacity = config.replay_capacity or config.num_episodes * config.num_steps
        held = dyna.memory.init(capacity, config.num_episodes, example, recorded)
        starts = ring.init(config.num_episodes, example.obs)
        return replace(state, replay=held, starts=starts)

    return init


def make_step(
    dyna: Dyna, config: DynaConfig
) -> Callable[[DynaState, jax.Array, DynaHParams], tuple[DynaState, Metrics]]:
    """A real episode with its dreams: ``step(state, episode, hparams) -> (state, metrics)``, where
    ``episode`` is its number, int, from 0. Arguments as of `make_init`. Work that none of the runs
    vmapped together needs costs nothing.
    """

    def step(state: DynaState, episode: jax.Array, hparams: DynaHParams):
        keys = jax.random.split(state.key, 6)
        key, key_real, key_agent, key_model, key_dream, key_evaluate = keys
        state = replace(state, key=key)
        dreaming = episode + 1 >= config.num_real_first
        real, recorded = _play_episode(dyna, config, state, episode, key_real, hparams)
        agent, metrics = _learn_policy(dyna, config, state.agent, real, episode, key_agent, hparams)
        state = replace(state, agent=agent)
        if dyna.watch is not None:
            metrics |= dyna.watch(real, recorded, hparams.env)
        awake = _awake(dyna, config, state, real)
        if _remembers(dyna, config):
            state = _remember(dyna, state, real, recorded, episode)
        if dyna.model is not None:
            key_judge, key_sample, key_update = jax.random.split(key_model, 3)
            judgement = {}
            if dyna.diagnose is not None:  # before the model learns from it
                judgement = dyna.diagnose(state.model.params, real, key_judge)
            train = partial(train_model, dyna, config, state, key_sample, key_update, hparams)
            of_use = _model_is_of_use(dyna, config, episode)
            idle = state.model, unknown(jax.eval_shape(train)[1])
            model, training = where_needed(of_use & awake, train, idle)
            state = replace(state, model=model)
            metrics |= judgement | training
        if _dreams(dyna, config):
            dream = partial(_dream, dyna, config, state, episode, key_dream, hparams)
            before = (state.agent, state.dreams_safe)
            idle = before, unknown(jax.eval_shape(dream)[1])
            (agent, safe), dreamed = where_needed(dreaming & awake, dream, idle)
            state = replace(state, agent=agent, dreams_safe=safe)
            metrics |= dreamed
        if config.eval_every > 0 and (dyna.expert is None or dyna.expert.episodes is not None):
            due = (episode + 1) % config.eval_every == 0
            judge = partial(evaluate, dyna, config, state.agent, key_evaluate, hparams)
            metrics |= where_needed(due, judge, unknown(jax.eval_shape(judge)))
        metrics["diverged"] = _diverged(real, metrics["agent_loss"], state.model)
        return state, metrics

    return step


def _dreams(dyna: Dyna, config: DynaConfig) -> bool:
    """Whether the policy learns of dreams at all."""
    return dyna.dream is not None and config.dream_updates > 0


def _awake(dyna: Dyna, config: DynaConfig, state: DynaState, real: Transition) -> jax.Array | bool:
    """Whether there may be something to learn of dreams: not where both the real episode and the
    last dreams were safe, since a policy that falls now and then often has a real one that is.
    """
    if dyna.safe is None:
        return True
    return ~(dyna.safe(real) & (state.dreams_safe if _dreams(dyna, config) else True))


def _diverged(real: Transition, agent_loss: jax.Array, model: Any) -> jax.Array:
    """0, or 1 + the place in `DIVERGED` of the first whose numbers are not finite; the agent's are
    known by its loss, one episode late where the episode's last update broke them.
    """
    seen = real.blanked()
    sound = [finite((seen.obs, seen.reward)), finite(agent_loss), finite(model and model.params)]
    numbers = [jnp.float32(1 + number) for number in range(len(DIVERGED))]
    return jnp.select([~part for part in sound], numbers, jnp.float32(0))


def make_train(
    dyna: Dyna, config: DynaConfig
) -> Callable[[Key, DynaHParams], tuple[DynaState, Metrics]]:
    """A whole run as one pure function. Arguments as of `make_init`.

    Returns:
        ``train(key, hparams) -> (state, metrics)``; metrics are ``[config.num_episodes, ...]``.
        Its ``check(hparams)`` raises a `ValueError`: `jaxdyna.sweep` asks it before all is traced.
    """
    init, step = make_init(dyna, config), make_step(dyna, config)

    def train(key: Key, hparams: DynaHParams) -> tuple[DynaState, Metrics]:
        start, episodes = init(key, hparams), jnp.arange(config.num_episodes)
        return jax.lax.scan(lambda state, number: step(state, number, hparams), start, episodes)

    train.check = partial(check_hparams, dyna, config)  # type: ignore[attr-defined]
    return train


def play_real(
    dyna: Dyna, config: DynaConfig, agent: Any, key: Key, hparams: DynaHParams
) -> tuple[Transition, Any]:
    """One real episode ``[1, T]``, and what was recorded of it (`Dyna.record`). Arguments as of
    `make_init`; ``agent`` is the agent's state.
    """

    def act(obs: jax.Array, key: Key) -> jax.Array:
        return dyna.agent.act(agent, obs, key, hparams.agent)

    return _real(dyna, config, act, key, hparams)


def evaluate(dyna: Dyna, config: DynaConfig, agent: Any, key: Key, hparams: DynaHParams) -> Metrics:
    """``frozen_return``: the mean return of the agent as it is, greedy, in new episodes, as many as
    `DynaConfig.eval_episodes`; for the arguments see `play_real`.
    """
    greedy = dyna.agent.act_greedy or dyna.agent.act

    def act(obs: jax.Array, key: Key) -> jax.Array:
        return greedy(agent, obs, key, hparams.agent)

    played = rollout(
        dyna.env, act, key, hparams.env, config.eval_episodes, num_steps=config.num_steps
    )
    return {"frozen_return": jnp.where(played.mask, played.reward, 0).sum(-1).mean()}


def _real(dyna, config, act, key, hparams) -> tuple[Transition, Any]:
    record, steps = dyna.record or (lambda *step: ()), config.num_steps
    return rollout(dyna.env, act, key, hparams.env, 1, num_steps=steps, record=record)


def _play_episode(dyna, config, state, episode, key, hparams) -> tuple[Transition, Any]:
    """One real episode ``[1, T]`` of the agent, or of the expert where it is the expert's."""
    if dyna.expert is None:
        return play_real(dyna, config, state.agent, key, hparams)
    is_experts, kind = dyna.expert.plays(episode, config), actions_of(dyna.env).dtype

    def act(obs, key):
        return jax.lax.cond(
            is_experts,
            lambda: jnp.asarray(dyna.expert.act(state, obs, key, hparams), kind),
            lambda: dyna.agent.act(state.agent, obs, key, hparams.agent).astype(kind),
        )

    return _real(dyna, config, act, key, hparams)


def _model_is_of_use(dyna, config, episode) -> jax.Array | bool:
    """Whether dreams or an expert may still look at the model after this episode."""
    if dyna.expert is None or dyna.dream is not None or dyna.expert.episodes is None:
        return True
    return episode + 1 < config.num_real_first + dyna.expert.episodes


def _learn_policy(dyna, config, agent, real, episode, key, hparams) -> tuple[Any, Metrics]:
    weighted = real
    if dyna.dream is not None:
        first = jnp.maximum(max(config.num_real_first, 1), hparams.num_real_first)
        weight = jnp.where(episode >= first, hparams.real_weight, 1.0)
        weighted = real._replace(weight=jnp.full(real.mask.shape, weight))

    def learn(update):
        new, losses = update(agent, weighted, key, hparams.agent)
        return new, jnp.asarray(losses["loss"], jnp.float32)

    if dyna.expert is None or dyna.agent.update_expert is None:
        agent, loss = learn(dyna.agent.update)
    else:
        by_expert = partial(learn, dyna.agent.update_expert)
        is_experts = dyna.expert.plays(episode, config)
        agent, loss = jax.lax.cond(is_experts, by_expert, partial(learn, dyna.agent.update))
    return agent, {"agent_loss": loss} | _summary("real", real)


def _remembers(dyna: Dyna, config: DynaConfig) -> bool:
    """Whether the run keeps its own transitions: asked for, and the agent's do not serve."""
    asked = dyna.model is not None or dyna.dream is not None
    own = config.replay_capacity is not None
    return asked and dyna.memory is not None and (own or dyna.memory.shared is None)


def _remember(dyna, state, real, recorded, episode) -> DynaState:
    """With the new episode."""
    held = dyna.memory.add(state.replay, real, recorded, episode)
    starts = ring.add(state.starts, real.obs[:, 0], real.mask[:, 0])
    return replace(state, replay=held, starts=starts)


def train_model(
    dyna: Dyna, config: DynaConfig, state: DynaState, key_sample: Key, key_update: Key,
    hparams: DynaHParams,
) -> tuple[Any, Metrics]:  # fmt: skip
    """Gradient steps of the model on all that is remembered, each batch (of frames a large one)
    taken in its turn: its new state, and ``model_loss``, the mean of all steps. Arguments as of
    `make_init`, with a model and a memory; of the run's ``state`` these two count.
    """
    memory: Any = dyna.memory
    shape, held = (config.model_updates, config.model_batch), memory.of(state)

    def update(carry, numbers):
        model, key = carry
        key, key_now = jax.random.split(key)
        batch = memory.take(held, numbers)
        model, losses = dyna.model.update(model, batch, key_now, hparams.model)
        return (model, key), losses

    drawn = memory.draw(held, key_sample, shape, config.rare_share)
    (model, _), losses = jax.lax.scan(update, (state.model, key_update), drawn)
    loss = losses["loss"].mean() if config.model_updates else jnp.float32(0)
    return where(hparams.model_trains, model, state.model), {"model_loss": loss}


def play_dreams(
    dyna: Dyna, config: DynaConfig, agent: Any, env_params: Any, key: Key, hparams: DynaHParams
) -> Transition:
    """Fake episodes ``[N, T, ...]`` to learn from once. Arguments as of `make_init`, a dream among
    the parts; ``agent`` is the agent's state, ``env_params`` as of `Dream.params`.
    """
    fake_act = dyna.agent.act_fake or dyna.agent.act

    def act(obs: jax.Array, key: Key) -> jax.Array:
        return fake_act(agent, obs, key, hparams.agent)

    steps = config.dream_steps or config.num_steps
    assert dyna.dream is not None
    return rollout(dyna.dream.env, act, key, env_params, config.dream_episodes, num_steps=steps)


def _dream(dyna, config, state, episode, key, hparams) -> tuple[Any, Metrics]:
    """Updates on fake episodes: the agent's new state, and whether these were safe in the end."""
    env_params = dyna.dream.params(state, hparams)
    weight = jnp.where(episode + 1 >= hparams.num_real_first, hparams.fake_weight, 0.0)

    learn = dyna.agent.update_fake or dyna.agent.update

    def update(agent, row, key_play, key_update):
        fake = play_dreams(dyna, config, agent, env_params, key_play, hparams)
        weighted = fake._replace(weight=jnp.full(fake.mask.shape, weight))
        agent, _ = learn(agent, weighted, key_update, hparams.agent)
        safe = jnp.bool_(False) if dyna.safe is None else dyna.safe(fake)
        return (agent, jnp.where(safe, row + 1, 0)), _summary("fake", fake)

    def update_unless_safe(carry, _):
        agent, row, key = carry  # row: how many safe ones there were in a row
        key, key_play, key_update = jax.random.split(key, 3)
        work = partial(update, agent, row, key_play, key_update)
        needed = True if dyna.safe is None else row < SAFE_IN_A_ROW
        idle = (agent, row), unknown(jax.eval_shape(work)[1])
        (agent, row), metrics = where_needed(needed, work, idle)
        return (agent, row, key), metrics

    start = (state.agent, jnp.int32(0), key)
    (agent, row, _), metrics = jax.lax.scan(update_unless_safe, start, length=config.dream_updates)
    return (agent, row >= SAFE_IN_A_ROW), jax.tree.map(mean_of_done, metrics)


def _summary(name: str, transitions: Transition) -> Metrics:
    """Mean undiscounted return and length of the episodes."""
    return {
        f"{name}_return": jnp.where(transitions.mask, transitions.reward, 0).sum(-1).mean(),
        f"{name}_length": transitions.mask.sum(-1).astype(jnp.float32).mean(),
    }
