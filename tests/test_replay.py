"""The ring buffer."""

from collections import Counter
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from jaxdyna.replay import ring
from jaxdyna.replay.memory import transitions

SAMPLE = jax.jit(ring.sample, static_argnums=2)
DRAW = jax.jit(ring.draw, static_argnums=2)
DISTINCT = jax.jit(ring.sample_distinct, static_argnums=2)
WEIGH = jax.jit(lambda buffer, marked, share: ring.share_weight(buffer.held, marked, share))


BLOCKS, DRAWN = 12, 32


@partial(jax.jit, static_argnums=(0, 1))
def filled(capacity, block, masks, forgotten, key):
    """A buffer of numbers after each of some blocks, before which it may be emptied, and draws."""

    def add(buffer, now):
        mask, forget, first, key = now
        buffer = transitions().forget(buffer, forget)
        items = {"x": first + jnp.arange(mask.size).reshape(block)}
        buffer = ring.add(buffer, items, mask)
        key, key_distinct = jax.random.split(key)
        drawn = ring.sample(buffer, key, (DRAWN,))["x"]
        distinct = ring.sample_distinct(buffer, key_distinct, capacity)["x"]
        return buffer, (buffer.data["x"], buffer.held, buffer.size, drawn, distinct)

    firsts = 1 + jnp.arange(BLOCKS) * masks[0].size
    empty = ring.init(capacity, {"x": jnp.int32(0)})
    keys = jax.random.split(key, BLOCKS)
    return jax.lax.scan(add, empty, (masks, forgotten, firsts, keys))[1]


@given(data=st.data(), sizes=st.sampled_from([(1, (1,)), (5, (3,)), (13, (2, 4))]))
@settings(max_examples=50)
def test_it_holds_what_a_list_would_hold(data, sizes):
    """The newest of what was not masked since it was last emptied, and draws nothing else."""
    capacity, block = sizes
    count = int(np.prod(block))
    bits = st.integers(0, 2**count - 1)
    drawn = data.draw(st.lists(bits, min_size=BLOCKS, max_size=BLOCKS))
    masks = (np.array(drawn)[:, None] >> np.arange(count)) % 2 == 1
    often = data.draw(st.integers(1, BLOCKS + 1))
    forgotten = np.arange(1, BLOCKS + 1) % often == 0
    key = jax.random.key(data.draw(st.integers(0, 99)))
    answers = filled(capacity, block, masks.reshape(BLOCKS, *block), forgotten, key)
    kept = []
    stages = zip(*map(np.asarray, answers), strict=True)
    for time, (rows, held, size, drawn, distinct) in enumerate(stages):
        kept = [] if forgotten[time] else kept
        kept += [1 + time * count + item for item in np.flatnonzero(masks[time]).tolist()]
        expected = kept[-capacity:]
        assert sorted(rows[held].tolist()) == expected
        assert size == len(expected)
        if expected:
            assert set(drawn.tolist()) <= set(expected)
        assert Counter(distinct.tolist()) == Counter(expected + [0] * (capacity - len(expected)))


@given(
    weights=st.lists(st.one_of(st.just(0.0), st.floats(1e-3, 1e3)), min_size=1, max_size=8),
    gap=st.sampled_from([1, 3, 60]),
    key=st.integers(0, 99),
)
@settings(max_examples=40)
def test_draws_are_in_proportion_to_any_weights(weights, gap, key):
    """Over several rows of them too; what weighs nothing is never drawn where anything weighs."""
    weight = np.zeros(600, np.float32)
    weight[gap * np.arange(len(weights))] = weights
    positions = np.asarray(DRAW(weight, jax.random.key(key), (800,)))
    if not any(weights):
        assert ((positions >= 0) & (positions < weight.size)).all()
        return
    shares = weight / weight.sum()
    counts = np.bincount(positions, minlength=weight.size)
    assert (counts[shares == 0] == 0).all()
    spread = np.sqrt(shares * (1 - shares) / len(positions))
    assert (np.abs(counts / len(positions) - shares) <= 5 * spread + 2e-4).all()


def test_flattens_leading_axes_of_every_leaf():
    example = {"x": jnp.zeros((), jnp.int32), "y": jnp.zeros((2, 3))}
    items = {"x": jnp.arange(6).reshape(2, 3), "y": jnp.arange(36.0).reshape(2, 3, 2, 3)}
    buffer = ring.add(ring.init(8, example), items, jnp.ones((2, 3), bool))
    np.testing.assert_array_equal(buffer.data["x"][:6], np.arange(6))
    np.testing.assert_array_equal(buffer.data["y"][4], np.arange(24, 30).reshape(2, 3))


def test_samples_every_held_item_equally_and_nothing_else():
    buffer = ring.init(10, {"x": jnp.int32(0)})
    buffer = ring.add(buffer, {"x": jnp.arange(1, 5)}, jnp.ones(4, bool))
    drawn = SAMPLE(buffer, jax.random.key(0), (100, 80))["x"]
    assert drawn.shape == (100, 80)
    counts = np.bincount(np.asarray(drawn).ravel(), minlength=6)
    assert counts[0] == counts[5] == 0
    np.testing.assert_allclose(counts[1:5], 2000, rtol=0.1)


def test_distinct_draws_repeat_nothing():
    buffer = ring.init(10, {"x": jnp.int32(0)})
    buffer = ring.add(buffer, {"x": jnp.arange(1, 8)}, jnp.ones(7, bool))
    drawn = DISTINCT(buffer, jax.random.key(0), 7)["x"]
    assert sorted(drawn.tolist()) == list(range(1, 8))
    fewer = [DISTINCT(buffer, jax.random.key(seed), 3)["x"] for seed in range(30)]
    assert len({tuple(sorted(row.tolist())) for row in fewer}) > 10


def test_marked_items_get_their_share_of_the_draws():
    buffer = ring.init(2000, {"x": jnp.int32(0)})
    buffer = ring.add(buffer, {"x": jnp.arange(1000)}, jnp.ones(1000, bool))

    def draw(marked, share):
        weight = WEIGH(buffer, marked, share)
        np.testing.assert_allclose(weight.sum(), 1, rtol=1e-5)
        return np.asarray(SAMPLE(buffer, jax.random.key(0), (50, 200), weight)["x"])

    rare = np.zeros(2000, bool)
    rare[[3, 700, 1500]] = True  # the last one is not held
    drawn = draw(rare, 0.25)
    assert np.isin(drawn, [3, 700]).mean() == pytest.approx(0.25, abs=0.02)
    assert (drawn == 3).mean() == pytest.approx(0.125, abs=0.015)
    assert len(np.unique(drawn)) > 990
    for none_or_all in (np.zeros(2000, bool), np.ones(2000, bool)):
        counts = np.bincount(draw(none_or_all, 0.25).ravel(), minlength=1000)
        assert len(counts) == 1000 and counts.max() < 40
    assert np.isin(draw(rare, 0.0), [3, 700]).mean() < 0.01
    kinds = np.stack([rare, np.arange(2000) >= 600])
    drawn = draw(kinds * (np.arange(2000) != 700), 0.5)
    assert (drawn == 3).mean() == pytest.approx(0.25, abs=0.02)
    assert (drawn >= 600).mean() == pytest.approx(0.4, abs=0.02)  # common: as often as they come
    assert set(np.unique(draw(rare, 1.0))) == {3, 700}


def test_vmapped_buffers_fill_at_their_own_pace():
    buffers = jax.vmap(lambda _: ring.init(4, {"x": jnp.int32(0)}))(jnp.arange(2))
    masks = jnp.array([[True, True, True], [False, True, False]])
    buffers = jax.vmap(ring.add, (0, None, 0))(buffers, {"x": jnp.arange(3) + 1}, masks)
    np.testing.assert_array_equal(buffers.added, [3, 1])
    np.testing.assert_array_equal(buffers.data["x"], [[1, 2, 3, 0], [2, 0, 0, 0]])


def test_clear_errors():
    with pytest.raises(ValueError, match="at least 1"):
        ring.init(0, jnp.zeros(()))
    with pytest.raises(ValueError, match="5 items at once"):
        ring.add(ring.init(3, jnp.zeros(())), jnp.zeros(5), jnp.ones(5, bool))
    with pytest.raises(AssertionError, match="type"):
        ring.add(ring.init(3, jnp.zeros(())), jnp.zeros(2), jnp.ones(2))
    with pytest.raises(AssertionError, match="shape"):
        ring.add(ring.init(9, jnp.zeros(())), jnp.zeros(6), jnp.ones((2, 3), bool))


def test_any_number_of_items_is_counted():
    buffer = ring.add(ring.init(7, {"x": jnp.int32(0)}), {"x": jnp.arange(7)}, jnp.ones(7, bool))
    buffer = replace(buffer, added=jnp.int32(2**31 - 2))
    for number in (100, 101, 102):
        buffer = jax.jit(ring.add)(buffer, {"x": jnp.array([number])}, jnp.ones(1, bool))
    place = (2**31 - 2) % 7
    held = [100 + (i - place) % 7 if (i - place) % 7 < 3 else i for i in range(7)]
    assert buffer.size == 7 and buffer.data["x"].tolist() == held


def test_floats_are_not_stored_as_bytes_without_a_word():
    buffer = ring.init(4, {"x": jnp.uint8(0)})
    with pytest.raises(TypeError, match="holds uint8 and is given float32: let the environment"):
        ring.add(buffer, {"x": jnp.array([0.5])}, jnp.ones(1, bool))
