"""Action-conditional prediction of the next frame (§3.2 and Fig. 4; Oh et al. 2015)."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import chex
import jax
import jax.numpy as jnp
import optax
from flax import struct

from jaxdyna.fields import Checked, check_counts, check_shape, setting
from jaxdyna.losses import PixelLoss, bce, l1, l2
from jaxdyna.models.adversarial import AdversarialHParams, Adversary, gan_adam
from jaxdyna.networks import FrameModel, LocalDynamics, LocalReward
from jaxdyna.optimizers import Optimizer, optimizer_setting
from jaxdyna.trees import where
from jaxdyna.types import DynamicsModel, Key, Prediction, Transition, check_transitions


@struct.dataclass
class PixelHParams:
    """What can be swept."""

    learning_rate: float = setting(
        5e-3, "Learning rate of the model's optimiser.", at_least=0, everyday=True
    )


@dataclass(frozen=True)
class PixelConfig(Checked):
    """What decides the program."""

    network: Any = setting(
        LocalDynamics(3),
        "A module (stack [N, H, W, C * frames], action [N, actions], train, valid [N]) -> (raw "
        "[N, H, W, C], features); jaxdyna.networks.EncoderDecoder is the paper's.",
    )
    loss: PixelLoss = setting(bce, "Loss of the pixels.", choices={"bce": bce, "l1": l1, "l2": l2})
    threshold: float | None = setting(
        0.5, "A pixel is lit where it is believed to be with a greater probability (the paper's is "
        "0.2); None draws it with that probability.", at_least=0, below=1)  # fmt: skip
    reward: Any = setting(
        LocalReward(),
        "A module (features, next_frame [N, H, W, C]) -> (reward [N], charge [N]), such as "
        "jaxdyna.networks.JointReward and LocalReward, or with a loss of its own, as ClassReward; "
        "None predicts no reward.",
    )
    reward_weight: float = setting(
        1.0, "Weight of the reward's loss beside the pixels' summed one.", at_least=0
    )
    terminates: bool = setting(
        False, "Whether the end of the episode is predicted; without it no episode ends."
    )
    optimizer: Optimizer = optimizer_setting(optax.adam, gan_adam=gan_adam)
    shades: bool = setting(
        False, "Pixels keep what is believed of them, as a shade; the threshold does not count."
    )


@struct.dataclass
class PixelState:
    """Flax's variables, BatchNorm's running statistics among them, and the optimiser's state;
    beside them the adversary's, where there is one.
    """

    params: Any
    opt_state: Any
    adversary: Any = None


def pixels(
    frame_shape: tuple[int, int, int], num_actions: int, config: PixelConfig | None = None,
    num_frames: int = 4, adversary: Adversary | None = None,
) -> DynamicsModel:  # fmt: skip
    """A model of worlds that are seen as stacked frames; `ValueError` where the network predicts
    pictures of another shape.

    Args:
        frame_shape: ``(height, width, channels)`` of one frame.
        num_actions: number of discrete actions.
        config: the program's settings.
        num_frames: frames in an observation, uint8 ``[H, W, channels * num_frames]``, the newest
            last.
        adversary: who else judges the frames (`jaxdyna.models.discriminator`).

    Returns:
        A `DynamicsModel` whose hparams are `PixelHParams`, with an adversary `AdversarialHParams`;
        ``predict`` returns the next stack, its new frame with every channel 0 or 255, or in
        shades. The uncertainty is the number of pixels that it expects to be wrong.
    """
    config = config or PixelConfig()
    module = FrameModel(config.network, config.reward, config.terminates)
    _check_shape(module, frame_shape, num_actions, num_frames)
    channels = frame_shape[-1]

    def init(key: Key, hparams: PixelHParams) -> PixelState:
        stack = jnp.zeros((2, *frame_shape[:2], channels * num_frames))
        action = jnp.zeros((2, num_actions))
        other = None
        if adversary is not None:
            key, key_adversary = jax.random.split(key)
            other = adversary.init(key_adversary, hparams)
        variables = module.init(key, stack, action, stack[..., :channels], True)
        opt_state = config.optimizer(hparams.learning_rate).init(variables["params"])
        return PixelState(variables, opt_state, other)

    def predict(params: Any, obs: jax.Array, action: jax.Array, key: Key) -> Prediction:
        chex.assert_rank([obs, action], [3, 0])
        stack, one_hot = _scale(obs[None]), jax.nn.one_hot(jnp.array([action]), num_actions)
        raw, features = module.apply(params, stack, one_hot, method="frame")
        believed = config.loss.probability(raw)
        bar = jax.random.uniform(key, raw.shape) if config.threshold is None else config.threshold
        frame = believed if config.shades else (believed > bar).astype(jnp.float32)
        outcome: Any = module.apply(params, features, frame, method="outcome")
        reward, _, logit = outcome
        lit = jnp.round(frame[0] * 255).astype(obs.dtype)
        sure = jnp.where(frame > 0, believed, 1 - believed)
        wrong = 0.0 if config.shades else (1 - sure).sum()
        return Prediction(
            next_obs=jnp.concatenate([obs[..., channels:], lit], axis=-1),
            reward=reward[0],
            terminated=jax.nn.sigmoid(logit[0]),
            uncertainty=jnp.asarray(wrong, jnp.float32),
        )

    update = _learner(module, num_actions, channels, config, adversary)
    kinds = (PixelHParams, AdversarialHParams) if adversary is None else AdversarialHParams
    return DynamicsModel(init, predict, update, num_actions, kinds)


def _learner(
    module: FrameModel, num_actions: int, channels: int, config: PixelConfig,
    adversary: Adversary | None,
) -> Callable[..., tuple[PixelState, dict[str, jax.Array]]]:  # fmt: skip
    """The model's ``update``."""

    def update(
        state: PixelState, transitions: Transition, key: Key, hparams: PixelHParams
    ) -> tuple[PixelState, dict[str, jax.Array]]:
        """One gradient step; ``metrics`` are the mean losses of a transition."""
        check_transitions(transitions)
        lead = transitions.mask.ndim
        batch = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[lead:]), transitions)
        batch, weight = batch.blanked(), batch.weights
        truth = _scale(batch.next_obs[..., -channels:])
        one_hot = jax.nn.one_hot(batch.action, num_actions)

        def loss_fn(params):
            variables = {**state.params, "params": params}
            (raw, *outcome), settled = module.apply(
                variables, _scale(batch.obs), one_hot, truth, True, weight > 0,
                mutable=["batch_stats"])  # fmt: skip
            parts = _losses(config, raw, outcome, truth, batch)
            importance = {"reward_loss": config.reward_weight}
            if adversary is not None:
                parts["adversarial_loss"] = adversary.unmasked(
                    state.adversary, config.loss.picture(raw)
                )
                importance["adversarial_loss"] = hparams.adversarial_weight
            total, means = _weigh(parts, importance, weight)
            return total, (settled, means, raw)

        grads_of = jax.value_and_grad(loss_fn, has_aux=True)
        (loss, (settled, means, raw)), grads = grads_of(state.params["params"])
        optimizer = config.optimizer(hparams.learning_rate)
        updates, opt_state = optimizer.update(grads, state.opt_state, state.params["params"])
        trained = optax.apply_updates(state.params["params"], updates)
        other = None
        if adversary is not None:
            made = config.loss.picture(raw)
            other, seen = adversary.update(state.adversary, made, truth, weight, hparams)
            means |= seen
        new = PixelState({**state.params, **settled, "params": trained}, opt_state, other)
        return where((weight > 0).any(), new, state), {"loss": loss, **means}

    return update


def _losses(
    config: PixelConfig, raw: jax.Array, outcome: list[jax.Array], truth: jax.Array, batch: Any
) -> dict[str, jax.Array]:
    """What each transition ``[N]`` is wrong by: its frame, and what the heads say."""
    chex.assert_equal_shape([raw, truth])
    reward, charge, end_logit = outcome
    parts = {"frame_loss": config.loss.error(raw, truth).sum((1, 2, 3))}
    if config.reward is not None:
        error = getattr(config.reward, "error", _squared)
        parts["reward_loss"] = error(reward, charge, batch.reward)
    if config.terminates:
        end = batch.terminated.astype(jnp.float32)
        parts["end_loss"] = optax.sigmoid_binary_cross_entropy(end_logit, end)
    return parts


def _squared(reward: jax.Array, charge: jax.Array, truth: jax.Array) -> jax.Array:
    return jnp.square(reward - truth) + charge


def _weigh(
    parts: dict[str, jax.Array], importance: dict[str, Any], weight: jax.Array
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """The loss, and the mean of each part ``[N]`` over transitions of some weight ``[N]``."""
    scale = jnp.maximum(weight.sum(), 1e-6)
    means = {name: (weight * part).sum() / scale for name, part in parts.items()}
    total = jnp.asarray(sum(importance.get(name, 1.0) * mean for name, mean in means.items()))
    return total, means


def frame_probability(
    num_actions: int, config: PixelConfig
) -> Callable[[Any, jax.Array, jax.Array], jax.Array]:
    """What a model of `pixels` with these arguments believes before any threshold:
    ``(params, obs [N, H, W, C * frames], action [N]) -> [N, H, W, C]`` in [0, 1].
    """
    module = FrameModel(config.network, config.reward, config.terminates)

    def probability(params: Any, obs: jax.Array, action: jax.Array) -> jax.Array:
        one_hot = jax.nn.one_hot(action, num_actions)
        raw, _ = module.apply(params, _scale(obs), one_hot, method="frame")
        return config.loss.probability(raw)

    return probability


def _check_shape(
    module: FrameModel, frame_shape: tuple[int, int, int], num_actions: int, num_frames: int
) -> None:
    check_shape(3, frame_shape=frame_shape)
    check_counts(num_actions=num_actions, num_frames=num_frames)

    def predict(key: Key) -> jax.Array:
        frame = jnp.zeros((2, *frame_shape))
        stack, action = jnp.tile(frame, (1, 1, 1, num_frames)), jnp.zeros((2, num_actions))
        return module.init_with_output(key, stack, action, frame, True)[0][0]

    try:
        shape = jax.eval_shape(predict, jax.random.key(0)).shape[1:]
    except Exception:  # such as a convolution that leaves nothing, or what is no module
        shape = ()
    if shape != tuple(frame_shape):
        raise ValueError(
            f"{type(module.network).__name__} predicts pictures of shape {shape} for frames "
            f"{frame_shape}: give it their number of channels, and kernels that fit into them"
        )


def _scale(picture: jax.Array) -> jax.Array:
    return picture.astype(jnp.float32) / 255
