"""How good a dynamics model is, one step ahead and fed with its own predictions."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxdyna.models.environment import as_observed
from jaxdyna.types import Key, Prediction, Transition

HALF = 127  #: up to this shade of 255 a pixel counts as dark
Predict = Callable[[Any, jax.Array, jax.Array, Key], Prediction]


def one_step(predict: Predict, params: Any, transitions: Transition, key: Key) -> Prediction:
    """Predictions ``[N, T, ...]`` from the true observations of transitions ``[N, T]``; ``predict``
    is a model's, ``params`` are its parameters.
    """
    keys = jax.random.split(key, transitions.mask.shape)
    over_time = jax.vmap(predict, (None, 0, 0, 0))
    return jax.vmap(over_time, (None, 0, 0, 0))(params, transitions.obs, transitions.action, keys)


def open_loop(
    predict: Predict, params: Any, obs: jax.Array, action: jax.Array, key: Key
) -> Prediction:
    """Predictions ``[T, ...]`` fed back as the next input, from ``obs [*obs]`` on, under given
    actions, ``[T, ...]``; they go on past any predicted end.
    """

    def step(carry, action):
        obs, key = carry
        key, key_predict = jax.random.split(key)
        prediction = predict(params, obs, action, key_predict)
        return (as_observed(prediction.next_obs, obs.dtype), key), prediction

    _, predictions = jax.lax.scan(step, (obs, key), action)
    return predictions


def one_step_sums(predict: Predict) -> Callable[[Any, Transition, Key], dict[str, jax.Array]]:
    """A ``diagnose`` for `jaxdyna.dyna.Dyna`: sums over the valid transitions of real episodes,
    from which `r_squared` and error rates follow.

    Returns:
        ``diagnose(params, transitions [N, T], key)`` giving ``count``, ``state_error``,
        ``state_spread`` and ``change_spread`` (squares about the mean, of the next state and of its
        change) and ``change_square`` (about 0), each ``[obs]``.
    """

    def diagnose(params: Any, transitions: Transition, key: Key) -> dict[str, jax.Array]:
        prediction, valid = one_step(predict, params, transitions, key), transitions.mask
        obs, target = (seen.astype(jnp.float32) for seen in (transitions.obs, transitions.next_obs))

        def total(values: jax.Array) -> jax.Array:
            return jnp.where(valid[..., None], values, 0).sum((0, 1))

        def spread(values: jax.Array) -> jax.Array:
            return total(jnp.square(values - total(values) / valid.sum()))

        return {
            "count": valid.sum(dtype=jnp.float32),
            "state_error": total(jnp.square(prediction.next_obs - target)),
            "state_spread": spread(target),
            "change_spread": spread(target - obs),
            "change_square": total(jnp.square(target - obs)),
        }

    return diagnose


def r_squared(sums: dict[str, jax.Array], kind: str) -> jax.Array:
    """The share of the variance explained, R² ``[obs]``, of the next ``state`` or of its
    ``change``, out of `one_step_sums`; not finite for what does not vary.
    """
    return 1 - sums["state_error"] / sums[f"{kind}_spread"]


def change_error(predict: Predict) -> Callable[[Any, Transition, Key], dict[str, jax.Array]]:
    """A ``diagnose`` for `jaxdyna.dyna.Dyna` where observations are vectors.

    Returns:
        ``diagnose(params, transitions [N, T], key)`` giving ``model_error``, a scalar: the squared
        error one step ahead over the mean square of a step's change, averaged over the variables
        that change; 0 where none does.
    """
    sums_of = one_step_sums(predict)

    def diagnose(params: Any, transitions: Transition, key: Key) -> dict[str, jax.Array]:
        sums = sums_of(params, transitions, key)
        error, changes = sums["state_error"], sums["change_square"] > 0
        each = jnp.where(changes, error / jnp.where(changes, sums["change_square"], 1), 0)
        return {"model_error": each.sum() / jnp.maximum(changes.sum(), 1)}

    return diagnose


def frame_errors(predict: Predict) -> Callable[[Any, Transition, Key], dict[str, jax.Array]]:
    """A ``diagnose`` for `jaxdyna.dyna.Dyna` where observations are frames.

    Returns:
        ``diagnose(params, transitions [N, T], key)`` giving the shares of valid transitions whose
        next frame is predicted wrong anywhere, ``wrong_frames``, a pixel of uint8 frames where it
        is lit (above 127) and should not be or the other way round, and whose reward is by half
        or more, ``wrong_rewards``.
    """

    def diagnose(params: Any, transitions: Transition, key: Key) -> dict[str, jax.Array]:
        prediction = one_step(predict, params, transitions, key)
        valid = transitions.mask
        lit, truth = prediction.next_obs > HALF, transitions.next_obs > HALF
        frame = (lit != truth).any((-1, -2, -3))
        reward = jnp.abs(prediction.reward - transitions.reward) >= 0.5
        shares = {"wrong_frames": frame, "wrong_rewards": reward}
        return {name: (wrong & valid).sum() / valid.sum() for name, wrong in shares.items()}

    return diagnose
