"""Networks that move things as wholes."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna.networks import ShiftDynamics
from jaxdyna.networks.shifts import places, shift_matrix, whereabouts


def test_a_shift_moves_a_line_and_repeats_its_edge():
    line = jnp.array([1.0, 2, 3, 4, 5])
    for shift, expected in {0: [1, 2, 3, 4, 5], 1: [1, 1, 2, 3, 4], -2: [3, 4, 5, 5, 5]}.items():
        share = jax.nn.one_hot(shift + 2, 5)
        np.testing.assert_allclose(shift_matrix(share, 5) @ line, expected)
    mixed = shift_matrix(jnp.array([0, 0.25, 0, 0.75, 0]), 5)
    np.testing.assert_allclose(mixed.sum(-1), 1)
    np.testing.assert_allclose(
        mixed @ line, 0.25 * np.array([2, 3, 4, 5, 5]) + 0.75 * np.array([1, 1, 2, 3, 4])
    )


def test_places_by_hand():
    """Two colours in two frames; the first moves one down and two right, the second is new."""
    stack = np.zeros((1, 6, 8, 4), np.float32)
    stack[0, 2, 3, 0] = stack[0, 3, 5, 2] = 1
    stack[0, 4:6, 1, 3] = 1
    where = whereabouts(jnp.array(stack), 2)
    features = np.asarray(places(where)[0])
    place, seen, moved, apart, near, mass = np.split(features, np.cumsum([8, 4, 4, 2, 2]))
    np.testing.assert_allclose(
        place,
        [
            2 * 2 / 6 - 1,
            2 * 3 / 8 - 1,
            0,
            0,
            2 * 3 / 6 - 1,
            2 * 5 / 8 - 1,
            2 * 4.5 / 6 - 1,
            2 / 8 - 1,
        ],
        atol=1e-6,
    )
    np.testing.assert_array_equal(seen, [1, 0, 1, 1])
    np.testing.assert_allclose(moved, [0.5, 1, 0, 0])
    np.testing.assert_allclose(apart, np.array([-1.5, 4]) / 4)
    np.testing.assert_allclose(near, np.tanh(np.array([-1.5, 4]) / 2), rtol=1e-6)
    np.testing.assert_allclose(mass, np.array([1, 2]) / 8)


def test_a_thing_keeps_its_shape():
    """An untrained network mixes shifts; forced to one, it returns the newest frame, moved."""
    stack = np.zeros((1, 8, 8, 4), np.float32)
    stack[0, 2:5, 3, 2] = stack[0, 6, 6, 3] = 1
    network, action = ShiftDynamics(2, (2, 2), (8,)), jnp.zeros((1, 3))
    params = jax.jit(network.init, static_argnums=3)(
        jax.random.key(0), jnp.array(stack), action, True
    )
    forced = jax.tree.map(jnp.zeros_like, params)
    down = np.zeros((2, 5), np.float32)
    down[0, 3] = down[1, 0] = 50
    stays = np.array([[50, -50], [50, -50]], np.float32)
    weights = forced["params"]
    weights["Dense_1"]["bias"] = jnp.array(down.reshape(-1))
    weights["Dense_2"]["bias"] = jnp.array(np.tile(50 * np.eye(5)[2], 2))
    weights["Dense_3"]["bias"] = jnp.array(stays.reshape(-1))
    raw, features = jax.jit(network.apply, static_argnums=3)(
        forced, jnp.array(stack), action, False
    )
    lit = np.asarray(raw[0] > 0)
    expected = np.zeros((8, 8, 2), bool)
    expected[3:6, 3, 0] = expected[4, 6, 1] = True
    np.testing.assert_array_equal(lit, expected)
    assert features.shape == (1, 8) and np.isfinite(raw).all()
    total = jax.jit(jax.grad(lambda p: network.apply(p, jnp.array(stack), action, True)[0].sum()))
    gradient = total(params)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
