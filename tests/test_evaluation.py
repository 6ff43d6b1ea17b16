"""How good a model is, by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdyna.models.evaluation import change_error, one_step_sums, r_squared
from jaxdyna.types import Prediction, Transition


def steps(path, padding=1):
    """One episode through these states ``[T + 1, obs]``, and padding that holds garbage."""
    path = np.asarray(path, np.float32)
    rest = np.full((padding, path.shape[1]), 77.0, np.float32)
    obs, after = (jnp.array(np.concatenate([part, rest]))[None] for part in (path[:-1], path[1:]))
    mask = jnp.arange(obs.shape[1])[None] < len(path) - 1
    nothing = jnp.zeros(mask.shape)
    return Transition(obs, nothing.astype(int), nothing, after, ~mask, ~mask, mask)


def off_by(error):
    """A model of a state that goes up by one a step, wrong by so much."""
    return lambda params, obs, action, key: Prediction(obs + 1 + jnp.array(error), 0.0, 0.0, 0.0)


@pytest.mark.parametrize("offset", [0.0, 10_000.0])
def test_the_variance_explained_is_of_what_varies(offset):
    """States 1, 2, 3, 4 after 0, 1, 2, 3, predicted 0.5 too high, however far from zero."""
    real = steps(offset + np.arange(5.0)[:, None])
    sums = one_step_sums(off_by([0.5]))(None, real, jax.random.key(0))
    assert sums["count"] == 4
    np.testing.assert_allclose(r_squared(sums, "state"), [1 - 4 * 0.25 / 5], rtol=1e-5)
    assert not np.isfinite(r_squared(sums, "change")).any()  # which is always 1


def test_errors_are_of_the_change_and_what_does_not_change_is_left_out():
    path = np.stack([np.arange(5.0), np.full(5, 3.0)], 1)
    diagnose = change_error(off_by([0.5, -1.0]))
    assert diagnose(None, steps(path), jax.random.key(0))["model_error"] == 0.25
    nothing = steps(np.full((5, 2), 3.0))
    assert diagnose(None, nothing, jax.random.key(0))["model_error"] == 0
