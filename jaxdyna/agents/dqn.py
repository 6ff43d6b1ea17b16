"""Deep Q-learning, §4.2 (Mnih et al. 2015; van Hasselt et al. 2016), from frames or vectors."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import optax
from flax import struct

from jaxdyna.agents import exploration
from jaxdyna.agents.dqn_settings import DQNConfig, DQNHParams
from jaxdyna.agents.exploration import Exploration
from jaxdyna.fields import SettingError, check_counts, check_shape
from jaxdyna.losses import td_error
from jaxdyna.networks import GlimpseQ, PerceptronQ
from jaxdyna.replay import frames as frame_replay, prioritized
from jaxdyna.replay.frames import FrameReplay
from jaxdyna.replay.n_step import Window, take_window
from jaxdyna.replay.prioritized import Prioritized
from jaxdyna.trees import as_held, where_needed
from jaxdyna.types import Agent, Key, Transition, check_transitions

Values = Callable[[Any, jax.Array], jax.Array]
Learned = tuple["DQNState", dict[str, jax.Array]]


@struct.dataclass
class DQNState:
    """Arrays of a learner."""

    params: Any  #: the online network's
    target: Any  #: the target network's
    opt_state: Any  #: the optimiser's
    steps: jax.Array  #: int32, gradient steps since the networks began
    exploration: Exploration  #: how much it explores, and in which direction
    real: Prioritized  #: real transitions
    fake: Prioritized  #: dreamed ones


BEGUN = ("params", "target", "opt_state", "steps")


def dqn(
    frame_shape: tuple[int, ...],
    num_actions: int,
    config: DQNConfig | None = None,
    num_frames: int | None = None,
) -> Agent:
    """An `Agent` whose hparams are `DQNHParams`: a deep Q-network with a target network and a
    replay for real and one for fake transitions. `ValueError` where an observation is neither
    frames nor a vector, or the network does not take it to the values.

    Args:
        frame_shape: ``(height, width, channels)`` of one frame; an observation is uint8 ``[H, W,
            channels * num_frames]``, as `jaxdyna.envs.FrameStack` makes it. Or ``(n,)``: an
            observation is a vector, float32.
        num_actions: number of discrete actions.
        config: the program's settings.
        num_frames: frames in an observation, by default 4; vectors in it, by default 1.
    """
    check_shape(3, 1, frame_shape=frame_shape)
    config, pictures = config or DQNConfig(), len(frame_shape) == 3
    num_frames = (4 if pictures else 1) if num_frames is None else num_frames
    check_counts(num_actions=num_actions, num_frames=num_frames)
    network = config.network or (GlimpseQ if pictures else PerceptronQ)(num_actions)
    values, kind = partial(q_values, network), jnp.uint8 if pictures else jnp.float32
    obs_shape = (*frame_shape[:-1], frame_shape[-1] * num_frames)
    _check_network(network, jnp.zeros((1, *obs_shape)), num_actions)
    begun = partial(_begun, network, config, obs_shape)

    def init(key: Key, hparams: DQNHParams) -> DQNState:
        obs, number, flag = jnp.zeros(obs_shape, kind), jnp.float32(0), jnp.bool_(False)
        example = Transition(obs, jnp.int32(0), number, obs, flag, flag, flag, number)

        def empty(capacity: int, episodes: int) -> Prioritized:
            return prioritized.init(frame_replay.init(capacity, episodes, example, num_frames))

        return DQNState(
            **begun(key, hparams),
            exploration=exploration.init(num_actions),
            real=empty(config.capacity, config.episodes),
            fake=empty(config.fake_capacity, config.fake_episodes),
        )

    def act_greedy(state: DQNState, obs: jax.Array, *_: Any) -> jax.Array:
        chex.assert_rank(obs, len(obs_shape))
        params = state.target if config.act_by_target else state.params
        return jnp.argmax(values(params, obs[None])[0])

    def explore(state: DQNState, obs: jax.Array, key: Key, epsilon: Any, odds: Any) -> jax.Array:
        key_which, key_action = jax.random.split(key)
        exploratory = jax.random.categorical(key_action, odds)
        greedy = jax.random.uniform(key_which) >= epsilon
        return jnp.where(greedy, act_greedy(state, obs), exploratory)

    def act(state: DQNState, obs: jax.Array, key: Key, hparams: DQNHParams) -> jax.Array:
        how = state.exploration
        return explore(state, obs, key, exploration.epsilon(how, hparams), how.drift)

    def act_fake(state: DQNState, obs: jax.Array, key: Key, hparams: DQNHParams) -> jax.Array:
        # short dreams from anywhere need no direction: exploratory actions are all alike
        share = exploration.epsilon_fake(state.exploration, hparams)
        return explore(state, obs, key, share, jnp.zeros(num_actions))

    def learn(state: DQNState, key: Key, hparams: DQNHParams, updates: int, more: Any = None):
        """``updates`` and ``more`` (an int scalar or None) gradient steps, and a new direction."""
        key_drift, key_steps, key_begin = jax.random.split(key, 3)
        if config.reset_every:
            state = _begin_anew(state, partial(begun, key_begin, hparams), config.reset_every)
        state, loss = _descend_often(values, config, state, key_steps, hparams, updates, more)
        drift = config.drift * jax.random.normal(key_drift, (num_actions,))
        return replace(state, exploration=replace(state.exploration, drift=drift)), {"loss": loss}

    def update(state: DQNState, transitions: Transition, key: Key, hparams: DQNHParams):
        """Stores the episodes, then the gradient steps that `DQNConfig` says."""
        check_transitions(transitions, 2)

        def work():
            real = prioritized.add(state.real, _weighted(transitions))
            explored = exploration.count(
                state.exploration, transitions, hparams, config.explore_until_rewarded
            )
            new = replace(state, real=real, exploration=explored)
            weighs = (transitions.weights > 0).any()
            more = _by_ratio(config.updates_per_step, transitions)
            return _where(weighs, lambda: learn(new, key, hparams, config.updates, more), new)

        return _where(transitions.mask.any(), work, state)

    def update_fake(state: DQNState, transitions: Transition, key: Key, hparams: DQNHParams):
        """The same with dreams."""
        check_transitions(transitions, 2)

        def work():
            fake = prioritized.add(state.fake, _weighted(transitions))
            return learn(replace(state, fake=fake), key, hparams, config.fake_updates)

        return _where((transitions.weights > 0).any(), work, state)

    return Agent(
        init, act, update, act_fake, update_fake,
        num_actions=num_actions, hparams=DQNHParams, act_greedy=act_greedy)  # fmt: skip


def _check_network(network: Any, obs: jax.Array, num_actions: int) -> None:
    def made(key: Key) -> jax.Array:
        return network.apply(network.init(key, obs), obs)

    try:
        chex.assert_shape(jax.eval_shape(made, jax.random.key(0)), (1, num_actions))
    except Exception as error:
        said = f"does not take observations {list(obs.shape)} to {num_actions} values: mend it"
        raise SettingError("network", f"{said} ({str(error).partition(chr(10))[0]})") from error


def real_memory(state: DQNState) -> FrameReplay:
    """The real transitions that an agent of `dqn` keeps, for who wants them as well."""
    return state.real.memory


def q_values(network: Any, params: Any, obs: jax.Array) -> jax.Array:
    """The values ``[N, A]`` of observations ``[N, *obs]`` by which an agent of `dqn` acts."""
    seen = obs.astype(jnp.float32) / 255 if obs.dtype == jnp.uint8 else obs
    return jnp.asarray(network.apply(params, seen))


def _begun(
    network: Any, config: DQNConfig, obs_shape: tuple[int, ...], key: Key, hparams: DQNHParams
) -> dict[str, Any]:
    """What there is of `BEGUN` before the first gradient step."""
    params = network.init(key, jnp.zeros((1, *obs_shape)))
    opt_state = config.optimizer(hparams.learning_rate).init(params)
    return dict(zip(BEGUN, (params, params, opt_state, jnp.int32(0)), strict=True))


def _by_ratio(ratio: float, real: Transition) -> jax.Array | None:
    """Gradient steps that so many real steps call for, an int scalar; None where none do."""
    return jnp.round(ratio * real.mask.sum()).astype(jnp.int32) if ratio else None


def _begin_anew(state: DQNState, begun: Callable[[], dict], every: int) -> DQNState:
    """With networks and optimiser as at the start, once they have made so many gradient steps."""
    due = state.steps >= every
    held = {name: getattr(state, name) for name in BEGUN}
    return replace(state, **where_needed(due, begun, held))


def _descend_often(
    values: Values, config: DQNConfig, state: DQNState, key: Key, hparams: DQNHParams,
    updates: int, more: jax.Array | None,
) -> tuple[DQNState, jax.Array]:  # fmt: skip
    """So many gradient steps, and the mean loss."""

    def step(carry: tuple[DQNState, Key], _: None):
        state, key = carry
        key, key_now = jax.random.split(key)
        state, loss = _descend(values, config, state, key_now, hparams)
        return (state, key), loss

    def counted(_: jax.Array, carry: tuple):
        carry, total = carry
        carry, loss = step(carry, None)
        return carry, (total + loss).astype(total.dtype)

    if more is None:
        (state, _), losses = jax.lax.scan(step, (state, key), length=updates)
        return state, losses.mean() if updates else jnp.float32(0)
    count = updates + more
    (state, _), total = jax.lax.fori_loop(0, count, counted, ((state, key), jnp.float32(0)))
    return state, total / jnp.maximum(count, 1)


def _descend(
    values: Values, config: DQNConfig, state: DQNState, key: Key, hparams: DQNHParams
) -> tuple[DQNState, jax.Array]:
    """One gradient step, and the loss."""
    batch, draws = _mixed(state, key, hparams, config)
    next_target = values(state.target, batch.last_obs)
    choice = values(state.params, batch.last_obs) if config.double else next_target

    def loss_fn(params: Any) -> tuple[jax.Array, jax.Array]:
        errors = jax.vmap(td_error)(
            values(params, batch.first.obs), batch.first.action,
            hparams.reward_scale * batch.reward, batch.discount, next_target, choice)  # fmt: skip
        weight = draws.often**-hparams.importance_exponent
        weight = batch.first.weights * weight / weight.max()
        return (weight * config.loss(errors)).mean(), errors

    (loss, errors), grads = jax.value_and_grad(loss_fn, has_aux=True)(state.params)
    # `often` is never 0; but of this `where` XLA makes an array of its own, so that priorities are
    # written in place, not into a copy of all (docs/development-log.md, Maze's `paper` on a CPU).
    errors = jnp.where(draws.often > 0, errors, 0.0)
    optimizer = config.optimizer(hparams.learning_rate)
    updates, opt_state = optimizer.update(grads, state.opt_state, state.params)
    params = optax.apply_updates(state.params, updates)
    steps = state.steps + 1
    rate = jnp.where(steps % config.target_period == 0, hparams.target_rate, 0.0)
    target = optax.incremental_update(params, state.target, rate)
    exponent = hparams.priority_exponent
    real, fake = (
        prioritized.reprioritise(held, numbers, errors, which, exponent)
        for held, numbers, which in (
            (state.real, draws.real, ~draws.is_fake),
            (state.fake, draws.fake, draws.is_fake),
        )
    )
    new = DQNState(params, target, opt_state, steps, state.exploration, real, fake)
    return as_held(new, state), loss


class Draws(NamedTuple):
    """Where a batch comes from, each ``[batch]``."""

    is_fake: jax.Array  #: bool, whether from the fake transitions
    real: jax.Array  #: numbers that were drawn of real transitions
    fake: jax.Array  #: likewise of fake ones
    often: jax.Array  #: how often each is drawn compared with a uniform draw


def _mixed(state: DQNState, key: Key, hparams: DQNHParams, config) -> tuple[Window, Draws]:
    """A batch of windows, a share of them fake."""
    key_source, key_real, key_fake = jax.random.split(key, 3)
    shape = (config.batch,)

    def drawn(held: Prioritized, key: Key) -> tuple[Window, jax.Array, jax.Array]:
        numbers, often = prioritized.draw_numbers(held, key, shape)
        window = take_window(held.memory, numbers, config.n_step, hparams.discount)
        return window, numbers, often

    real, real_numbers, real_often = drawn(state.real, key_real)
    fake, fake_numbers, fake_often = drawn(state.fake, key_fake)
    is_fake = jax.random.uniform(key_source, shape) < _fake_share(state, hparams)
    window = jax.tree.map(lambda new, old: jax.vmap(jnp.where)(is_fake, new, old), fake, real)
    often = jnp.where(is_fake, fake_often, real_often)
    return window, Draws(is_fake, real_numbers, fake_numbers, often)


def _fake_share(state: DQNState, hparams: DQNHParams) -> jax.Array:
    """The share of a batch that is drawn from fake transitions, a scalar."""
    kept = state.fake.size / jnp.maximum(state.real.size + state.fake.size, 1)
    share = kept if hparams.fake_share is None else hparams.fake_share
    share = jnp.where(state.fake.size > 0, share, 0.0)
    return jnp.where(state.real.size > 0, share, 1.0)


def _weighted(transitions: Transition) -> Transition:
    return transitions._replace(weight=transitions.weights)


def _where(needed: jax.Array, work: Callable[[], Learned], state: DQNState) -> Learned:
    """What ``work`` returns, or the state as it is."""
    return where_needed(needed, work, (state, {"loss": jnp.float32(0)}))
