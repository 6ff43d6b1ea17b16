"""Values of actions from where things are."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna.networks import FeaturePointQ
from jaxdyna.networks.q_networks import dueling, mean_places


def picture(row, column, shade=1.0):
    return jnp.zeros((1, 5, 9, 3)).at[0, row, column, 2].set(shade)


def test_mean_places_by_hand():
    place, mass = mean_places(picture(0, 6) + picture(2, 8))
    np.testing.assert_allclose(place[0, 2], [-0.5, 0.75])
    np.testing.assert_allclose(mass[0], [0, 0, 2])
    assert (place[0, :2] == 0).all()


def test_a_blurred_thing_is_at_its_mean_place():
    sharp, _ = mean_places(picture(1, 4))
    blurred, mass = mean_places(picture(0, 4, 0.5) + picture(2, 4, 0.5))
    np.testing.assert_allclose(blurred, sharp, atol=1e-6)
    np.testing.assert_allclose(mass[0, 2], 1)


def test_values_hang_on_where_things_are_and_how_they_move():
    network = FeaturePointQ(6, hidden=(8,))
    still = jnp.tile(picture(1, 4), (1, 1, 1, 4))
    moving = jnp.concatenate([picture(1, column) for column in (1, 2, 3, 4)], axis=-1)
    params = network.init(jax.random.key(0), still)
    values = network.apply(params, jnp.concatenate([still, moving]))
    assert values.shape == (2, 6)
    assert not np.allclose(values[0], values[1])


def test_dueling_values_by_hand():
    """The first output is their mean."""
    np.testing.assert_allclose(dueling(jnp.array([[10.0, 1.0, 2.0, 6.0]])), [[8, 9, 13]])
