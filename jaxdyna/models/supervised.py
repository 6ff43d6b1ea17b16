"""The dynamics model of Eq. 1: an MLP that predicts next state, reward and end of the episode."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import chex
import jax
import jax.numpy as jnp
import optax
from flax import struct

from jaxdyna.actions import Actions, as_actions
from jaxdyna.fields import Checked, check_counts, setting
from jaxdyna.losses import transition_loss
from jaxdyna.networks import MLP
from jaxdyna.optimizers import Optimizer, Trained, optimizer_setting
from jaxdyna.trees import as_held, where
from jaxdyna.types import DynamicsModel, Key, Prediction, Transition, check_transitions


@struct.dataclass
class SupervisedHParams:
    """What can be swept."""

    learning_rate: float = setting(
        1e-2, "Learning rate of the model's optimiser.", at_least=0, everyday=True
    )


@dataclass(frozen=True)
class SupervisedConfig(Checked):
    """What decides the program. The defaults are the paper's (§3.1)."""

    hidden: tuple[int, ...] = setting(
        (256, 256), "Widths of the model's hidden layers.", at_least=1, everyday=True
    )
    sum_loss: bool = setting(
        True,
        "Eq. 1 sums over the batch; False takes the mean, which divides the step by the batch "
        "size.",
    )
    delta: bool = setting(False, "Predict the change of the state instead of the next state.")
    normalise: bool = setting(
        False, "Scale inputs and state targets by their running mean and standard deviation."
    )
    scale_reward: bool = setting(
        False, "Scale rewards, too: where they are far from 1, their errors else hide the state's, "
        "or are hidden by them.")  # fmt: skip
    spread: float = setting(
        1.0,
        "How many standard deviations normalise maps to 1. More makes the state's errors smaller "
        "beside the cross-entropy of the end, and a summed loss stable at larger steps.", above=0,
    )  # fmt: skip
    one_hot: bool = setting(
        False, "Encode a numbered action one-hot, not as one number; vectors by their bounds."
    )  # fmt: skip
    ensemble: int = setting(
        1, "Members of the ensemble, each with its own initial weights and its own resampling of "
        "every batch; a prediction is their mean.", at_least=1, everyday=True)  # fmt: skip
    one_member: bool = setting(
        False, "Every prediction is that of a member drawn at random (TS1 of Chua et al. 2018), "
        "not their mean: a policy has to do well whichever of them is right.")  # fmt: skip
    weight_variance: float = setting(
        1.0, "Variance of the initial weights, see jaxdyna.networks.MLP.", above=0
    )
    optimizer: Optimizer = optimizer_setting(optax.sgd)


@struct.dataclass
class Moments:
    """Running mean and standard deviation of a vector."""

    mean: jax.Array  #: ``[n]``
    variance: jax.Array  #: running variance, ``[n]``
    batches: jax.Array  #: how many batches went in

    @property
    def std(self) -> jax.Array:
        """Standard deviation, 1 of what has none: nothing is known of its scale."""
        std = jnp.sqrt(self.variance)
        constant = std <= 8 * jnp.finfo(std.dtype).eps * jnp.abs(self.mean)
        return jnp.where(constant, 1.0, std)


@struct.dataclass
class SupervisedParams:
    """What ``predict`` takes: network weights with a leading axis for the ensemble, and scales."""

    network: Any
    inputs: Moments
    targets: Moments
    rewards: Moments | None


def supervised(
    obs_size: int, num_actions: int | Actions, config: SupervisedConfig | None = None
) -> DynamicsModel:
    """The paper's dynamics MLP and its better-conditioned variants.

    Args:
        obs_size: length of the observation vector.
        num_actions: number of discrete actions, or what else they are (`jaxdyna.actions`).
        config: the program's settings.

    Returns:
        A `DynamicsModel` whose hparams are `SupervisedHParams`. The uncertainty is the ensemble's
        disagreement: the standard deviation over its members of what they predict of the state, in
        units of that target's standard deviation over the data, the largest of all variables; 0 of
        a single member.
    """
    config = config or SupervisedConfig()
    check_counts(obs_size=obs_size)
    actions = as_actions(num_actions)
    encode = partial(actions.encode, one_hot=config.one_hot)
    network = MLP((*config.hidden, obs_size + 2), weight_variance=config.weight_variance)
    spread = config.spread if config.normalise else 1.0

    def raw_target(obs: jax.Array, next_obs: jax.Array) -> jax.Array:
        obs, next_obs = obs.astype(jnp.float32), next_obs.astype(jnp.float32)  # bytes would wrap
        return next_obs - obs if config.delta else next_obs

    def member(weights: Any, params: SupervisedParams, obs: jax.Array, action: jax.Array):
        """Scaled state target ``[..., obs]``, reward and log odds of the end ``[...]`` by one
        member. A batch goes in whole: vmapped, XLA would turn the gradient of each weight around.
        """
        scaled = (obs - params.inputs.mean) / (spread * params.inputs.std)
        output: Any = network.apply(weights, jnp.concatenate([scaled, encode(action)], axis=-1))
        return output[..., :obs_size], output[..., obs_size], output[..., obs_size + 1]

    def init(key: Key, hparams: SupervisedHParams) -> Trained:
        zeros = jnp.zeros(obs_size + encode(jnp.zeros(actions.shape, actions.dtype)).size)
        weights = jax.vmap(network.init, (0, None))(jax.random.split(key, config.ensemble), zeros)
        still, rewards = _still(obs_size), _still(1) if config.scale_reward else None
        opt_state = config.optimizer(hparams.learning_rate).init(weights)
        return Trained(SupervisedParams(weights, still, still, rewards), opt_state)

    def predict(
        params: SupervisedParams, obs: jax.Array, action: jax.Array, key: Key
    ) -> Prediction:
        chex.assert_shape([obs, action], [(obs_size,), actions.shape])
        scaled, reward, logit = _over_members(
            partial(member, params=params, obs=obs, action=action), config.ensemble
        )(params.network)
        target = scaled * spread * params.targets.std + params.targets.mean
        next_obs = obs + target if config.delta else target
        if params.rewards is not None:
            reward = reward * params.rewards.std[0] + params.rewards.mean[0]
        said = next_obs, reward, jax.nn.sigmoid(logit)
        state, reward, end = _drawn(key, said) if config.one_member else _means(said)
        return Prediction(
            next_obs=as_held(state, obs),
            reward=reward,
            terminated=end,
            uncertainty=spread * scaled.std(axis=0).max(),
        )

    def update(
        state: Trained, transitions: Transition, key: Key, hparams: SupervisedHParams
    ) -> tuple[Trained, dict[str, jax.Array]]:
        check_transitions(transitions)
        lead = transitions.mask.ndim
        batch = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[lead:]), transitions)
        batch, weight = batch.blanked(), batch.weights
        chex.assert_shape([batch.obs, batch.next_obs], (None, obs_size))
        target = raw_target(batch.obs, batch.next_obs)
        params = _noted(config, state.params, batch, target)
        scaled_target = (target - params.targets.mean) / (spread * params.targets.std)
        reward = _scaled(params.rewards, batch.reward)

        def member_loss(weights, row):
            output = member(weights, params, batch.obs[row], batch.action[row])
            losses = jax.vmap(transition_loss)(
                *output, scaled_target[row], reward[row], batch.terminated[row]
            )
            total = (weight[row] * losses).sum()
            mean = total / jnp.maximum(weight[row].sum(), 1e-6)
            return (total if config.sum_loss else mean), mean

        def loss_fn(network_params):
            rows = _resample(key, weight.shape[0], config.ensemble)
            losses, means = _over_members(member_loss, config.ensemble)(network_params, rows)
            return losses.sum(), means.mean()

        (_, loss), grads = jax.value_and_grad(loss_fn, has_aux=True)(params.network)
        optimizer = config.optimizer(hparams.learning_rate)
        updates, opt_state = optimizer.update(grads, state.opt_state, params.network)
        params = replace(params, network=optax.apply_updates(params.network, updates))
        new = Trained(params, opt_state)
        return where((weight > 0).any(), new, state), {"loss": loss}

    return DynamicsModel(init, predict, update, num_actions, SupervisedHParams)


def _still(size: int) -> Moments:
    return Moments(jnp.zeros(size), jnp.ones(size), jnp.int32(0))


def _scaled(moments: Moments | None, reward: jax.Array) -> jax.Array:
    return reward if moments is None else (reward - moments.mean[0]) / moments.std[0]


def _noted(
    config: SupervisedConfig, params: SupervisedParams, batch: Transition, target: jax.Array
) -> SupervisedParams:
    """With the moments of a batch ``[B]`` and its state targets, of what is to be scaled."""
    weight, values = batch.weights, {}
    if config.normalise:
        values = {"inputs": batch.obs, "targets": target}
    if config.scale_reward:
        values["rewards"] = batch.reward[:, None]
    return replace(params, **{
        name: _update_moments(getattr(params, name), some, weight) for name, some in values.items()
    })  # fmt: skip


def _over_members(work: Callable[..., Any], members: int) -> Callable[..., Any]:
    """``vmap``, without an axis where there is one member: with it XLA turns the gradient of each
    weight around, and an update takes nearly twice as long.
    """
    if members > 1:
        return jax.vmap(work)

    def alone(*arguments: Any) -> Any:
        found = work(*jax.tree.map(lambda leaf: leaf[0], arguments))
        return jax.tree.map(lambda leaf: leaf[None], found)

    return alone


def _means(said: Any) -> Any:
    """Over the members."""
    return jax.tree.map(lambda leaf: leaf.mean(0), said)


def _drawn(key: Key, said: Any) -> Any:
    """What one of the members says."""
    member = jax.random.randint(key, (), 0, len(jax.tree.leaves(said)[0]))
    return jax.tree.map(lambda leaf: leaf[member], said)


def _resample(key: Key, size: int, members: int) -> jax.Array:
    """Rows of the batch for each member ``[members, size]``: all for one, a bootstrap for more."""
    if members == 1:
        return jnp.arange(size)[None]
    return jax.random.randint(key, (members, size), 0, size)


def _update_moments(moments: Moments, values: jax.Array, weight: jax.Array) -> Moments:
    """Takes in one batch ``[B, n]``; the first 200 count alike, later ones move it by 1/200. The
    variances are put together as Chan et al. (1979) do: a mean of squares less the square of the
    mean would lose all digits far from zero.
    """
    batches = moments.batches + 1
    rate = 1 / jnp.minimum(batches, 200)
    share = (weight / jnp.maximum(weight.sum(), 1e-6))[:, None]
    mean = (share * values).sum(0)
    variance = (share * jnp.square(values - mean)).sum(0)
    moved = mean - moments.mean
    return Moments(
        mean=moments.mean + rate * moved,
        variance=(1 - rate) * (moments.variance + rate * jnp.square(moved)) + rate * variance,
        batches=batches,
    )
