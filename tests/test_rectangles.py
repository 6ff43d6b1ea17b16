"""A model that believes in places of edges."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from parts import assert_close, assert_same

from jaxdyna.models import PixelHParams, RectangleConfig, rectangle_probability, rectangles
from jaxdyna.models.objects import surprise
from jaxdyna.networks.objects import (
    EdgeOdds,
    Rectangles,
    Resolution,
    drawn,
    each_alone,
    pairs,
    rectangles_of,
    tiles,
)
from jaxdyna.types import Transition

SHAPE = (8, 10, 2)
CONFIG = RectangleConfig(Resolution((2, 2)), groups=((1,), (0,)), hidden=(32,))
HPARAMS = PixelHParams(0.01)


def picture(*boxes):
    """Boxes ``(channel, top, bottom, left, right)`` on black."""
    frame = np.zeros(SHAPE, np.uint8)
    for channel, top, bottom, left, right in boxes:
        frame[top : bottom + 1, left : right + 1, channel] = 255
    return frame


@pytest.fixture(scope="module")
def batch():
    """The first thing moves by one column where the action is 1; the second follows, and is gone
    after the action 2, at a reward of -1.
    """
    before, after, actions, rewards = [], [], [], []
    for left in range(2, 7):
        for action in range(3):
            now = [(0, 2, 4, left, left + 1), (1, 5, 5, left, left)]
            right = left + (action == 1)
            then = [(0, 2, 4, right, right + 1), (1, 5, 5, right, right)]
            before.append(np.concatenate([picture(*now)] * 4, -1))
            after.append(picture(*then[: 1 if action == 2 else 2]))
            actions.append(action)
            rewards.append(-float(action == 2))
    obs, frame = jnp.array(np.stack(before)), jnp.array(np.stack(after))
    no = jnp.zeros(len(actions), bool)
    stack = jnp.concatenate([obs[..., 2:], frame], -1)
    return Transition(obs, jnp.array(actions), jnp.array(rewards), stack, no, no, ~no)


def trained(batch, config, steps):
    model = rectangles(SHAPE, 3, config)

    @jax.jit
    def run(key):
        def step(state, key):
            return model.update(state, batch, key, HPARAMS)

        return jax.lax.scan(step, model.init(key, HPARAMS), jax.random.split(key, steps))

    with jax.debug_key_reuse(False):
        state, losses = run(jax.random.key(0))
    return model, state, losses


def test_rectangles_and_pictures_say_the_same():
    frame = jnp.array(picture((0, 1, 3, 4, 9)))[None]
    there = rectangles_of(frame, 2)
    np.testing.assert_array_equal(there.edge[0, 0], [[1, 3, 4, 9], [0, 0, 0, 0]])
    np.testing.assert_array_equal(there.seen[0, 0], [True, False])
    np.testing.assert_array_equal(drawn(there, SHAPE[:2])[0, 0] * 255, frame[0])


def test_tiles_share_what_lies_between():
    np.testing.assert_allclose(tiles(jnp.array([1.0, 0.25, 7.0]), 0, 2),
                               [[0, 1, 0], [0.75, 0.25, 0], [0, 0, 0]])  # fmt: skip


def test_surprise_by_hand():
    half = jnp.log(jnp.full((1, 2, 2, 4), 0.25))
    odds = EdgeOdds(half, half, jnp.array([[0.0, 0.0]]))
    truth = Rectangles(jnp.zeros((1, 2, 4), jnp.int32), jnp.array([[True, False]]))
    np.testing.assert_allclose(surprise(odds, truth)[0], [np.log(2) + 4 * np.log(4), np.log(2)])


def test_it_learns_to_move_to_vanish_and_to_reward(batch):
    model, state, losses = trained(batch, CONFIG, 400)
    assert losses["loss"][-1] < 0.05 < losses["loss"][0]
    said = jax.jit(jax.vmap(model.predict, (None, 0, 0, 0)))(
        state.params, batch.obs, batch.action, jax.random.split(jax.random.key(1), 15)
    )
    np.testing.assert_array_equal(said.next_obs, batch.next_obs)
    np.testing.assert_array_equal(said.reward, batch.reward)
    assert not said.terminated.any() and (said.uncertainty < 1).all()
    believed = jax.jit(rectangle_probability(SHAPE, 3, CONFIG))(
        state.params, batch.obs, batch.action
    )
    assert believed.shape == (15, *SHAPE)
    np.testing.assert_array_equal(believed > 0.5, batch.next_obs[..., -2:] > 0)


def test_what_is_random_is_drawn_as_a_whole(batch):
    """Half of the time the first thing goes left, half right; it never grows or shrinks."""
    stack = np.concatenate([picture((0, 2, 4, 4, 5))] * 4, -1)
    ways = [np.concatenate([stack[..., 2:], picture((0, 2, 4, x, x + 1))], -1) for x in (3, 5)]
    tossed = jax.tree.map(lambda leaf: leaf[:2], batch)._replace(
        obs=jnp.array([stack] * 2), next_obs=jnp.array(np.stack(ways)), action=jnp.zeros(2, int)
    )
    config = RectangleConfig(
        Resolution((2, 2)), groups=((0, 1),), hidden=(32,), draws=True, dropout=0.1
    )
    model, state, _ = trained(tossed, config, 300)
    drawn_frames = jax.jit(jax.vmap(model.predict, (None, None, None, 0)))(
        state.params, tossed.obs[0], jnp.int32(0), jax.random.split(jax.random.key(2), 64)
    ).next_obs[..., -2:]
    at = rectangles_of(drawn_frames, 2).edge[:, 0, 0]
    assert set(map(tuple, np.asarray(at).tolist())) == {(2, 4, 3, 4), (2, 4, 5, 6)}
    assert 10 < (at[:, 2] == 3).sum() < 54


def test_masked_transitions_teach_nothing(batch):
    model = rectangles(SHAPE, 3, CONFIG)
    state = jax.jit(model.init)(jax.random.key(0), HPARAMS)
    key = jax.random.key(1)

    @jax.jit
    def update(batch):
        return model.update(state, batch, jax.random.clone(key), HPARAMS)[0]

    assert_same(update(batch._replace(mask=batch.mask & False)), state)
    some = batch._replace(mask=jnp.arange(15) < 9)
    garbage = some._replace(next_obs=jnp.where(some.mask[:, None, None, None], some.next_obs, 77))
    assert_close(update(garbage), update(some))


@pytest.mark.parametrize(
    "settings", [{"groups": ((0,),)}, {"told": Resolution((0, 1))}, {"dropout": 1.0}]
)
def test_clear_errors(settings):
    with pytest.raises(ValueError, match=next(iter(settings))):
        config = {"told": Resolution((2, 2)), "groups": ((0, 1),)} | settings
        rectangles(SHAPE, 3, RectangleConfig(**config))


def test_things_that_will_meet_are_told_to():
    """A ball flies two columns a step at a paddle that it meets halfway, or flies past above."""

    def told(ball_row):
        edge = jnp.array([[[3, 5, 6, 6], [ball_row, ball_row, 4, 4]]])
        shift = jnp.array([[[0.0, 0, 0, 0], [0, 0, 2, 2]]])
        return np.asarray(
            pairs(Rectangles(edge, jnp.ones((1, 2), bool)), shift, Resolution((2, 3)))
        )[0]

    apart = 2 * (5 + 7)
    hit, past = told(5), told(0)
    np.testing.assert_allclose(hit[apart : apart + 6], [0, 0, 0, 0.5, 1, 1])
    np.testing.assert_allclose(hit[apart + 6 : apart + 10], [0.5, 0, -0.125, -0.125])
    assert not past[apart:].any()
    np.testing.assert_allclose(past[:5], 0)  # two rows up at the most are told


def test_what_is_not_there_is_not_told_of():
    gone = Rectangles(jnp.zeros((1, 4, 2, 4), jnp.int32), jnp.zeros((1, 4, 2), bool))
    assert not each_alone(gone, (8, 10), Resolution((2, 2))).any()
    now = Rectangles(gone.edge[:, -1], gone.seen[:, -1])
    assert not pairs(now, jnp.zeros((1, 2, 4)), Resolution((2, 2))).any()


def test_a_place_is_told_by_its_walls_alone():
    """Far from the borders a thing that moves looks the same everywhere, but for the numbers."""

    def at(left):
        boxes = [[4, 4, left + step, left + step] for step in range(4)]
        edge = jnp.array(boxes)[None, :, None]
        past = Rectangles(edge, jnp.ones((1, 4, 1), bool))
        return np.asarray(each_alone(past, (9, 40), Resolution((2, 3))))[0]

    numbers = 4 * 4
    np.testing.assert_array_equal(at(10)[numbers:], at(20)[numbers:])
    assert (at(10)[numbers:] != at(33)[numbers:]).any()
