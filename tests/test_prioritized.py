"""Prioritised draws, and the glimpses that values are read from."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from jaxdyna.networks import GlimpseQ, glimpses
from jaxdyna.replay import frames as frame_replay, prioritized, ring
from jaxdyna.types import Transition

ADD, REPRIORITISE = jax.jit(prioritized.add), jax.jit(prioritized.reprioritise)
DRAW = jax.jit(prioritized.draw_numbers, static_argnums=2)


def episodes(count, steps):
    shape = (count, steps)
    frames = np.zeros((*shape, 3, 3, 8), np.uint8)
    numbers, flags = np.zeros(shape, np.float32), np.zeros(shape, bool)
    return Transition(frames, np.zeros(shape, np.int32), numbers, frames, flags, flags, ~flags)


def empty(capacity=20):
    example = jax.tree.map(lambda leaf: leaf[0, 0], episodes(1, 1))
    return prioritized.init(frame_replay.init(capacity, 10, example))


def frequencies(held, count=20_000):
    numbers, often = DRAW(held, jax.random.key(0), (count,))
    slots = np.asarray(numbers) % held.memory.capacity
    return np.bincount(slots, minlength=held.memory.capacity) / count, slots, np.asarray(often)


STAGES, STEPS, BATCH = 8, 5, 6


@partial(jax.jit, static_argnums=0)
def after_each(sizes, lengths, errors, which, exponent, key):
    """Priorities after each episode of such a length, and again after a batch was drawn and is
    given these errors.
    """
    zeros = jnp.zeros((1, STEPS))
    none = zeros.astype(bool)
    vectors = jnp.zeros((1, STEPS, 2))
    blank = Transition(vectors, zeros.astype(int), zeros, vectors, none, none, none)
    example = jax.tree.map(lambda leaf: leaf[0, 0], blank)

    def put(held, now):
        length, errors, which, key = now
        held = prioritized.add(held, blank._replace(mask=jnp.arange(STEPS)[None] < length))
        numbers, often = prioritized.draw_numbers(held, key, (BATCH,))
        after = prioritized.reprioritise(held, numbers, errors[numbers % BATCH], which, exponent)
        where = held.memory.number(jnp.arange(held.memory.capacity))
        return after, (where, held.memory.held, held.priority, numbers, often, after.priority)

    start = prioritized.init(frame_replay.init(*sizes, example, num_frames=2))
    keys = jax.random.split(key, STAGES)
    return jax.lax.scan(put, start, (lengths, errors, which, keys))[1]


@given(
    sizes=st.sampled_from([(7, 3), (40, 4)]),
    lengths=st.lists(st.integers(1, STEPS), min_size=STAGES, max_size=STAGES),
    errors=st.lists(
        st.lists(st.floats(-100, 100, width=32), min_size=BATCH, max_size=BATCH),
        min_size=STAGES, max_size=STAGES,
    ),
    which=st.lists(st.integers(0, 2**BATCH - 1), min_size=STAGES, max_size=STAGES),
    exponent=st.sampled_from([0.0, 0.6, 1.0]),
)  # fmt: skip
@settings(max_examples=40)
def test_priorities_are_what_a_dict_would_hold(sizes, lengths, errors, which, exponent):
    bits = (np.array(which)[:, None] >> np.arange(BATCH)) % 2 == 1
    errors, key = np.array(errors, np.float32), jax.random.key(lengths[0])
    answers = after_each(sizes, np.array(lengths), errors, bits, exponent, key)
    priority, added = {}, 0
    for time, now in enumerate(zip(*map(np.asarray, answers), strict=True)):
        numbers, held, before, drawn, often, after = now
        highest = max(priority.values(), default=1.0)
        priority |= dict.fromkeys(range(added, added + lengths[time]), highest)
        added += lengths[time]
        priority = {number: priority[number] for number in numbers[held].tolist()}
        assert dict(zip(numbers[held].tolist(), before[held].tolist(), strict=True)) == priority
        assert not before[~held].any()
        mean = sum(priority.values()) / len(priority)
        shares = [priority[number] / mean for number in drawn.tolist()]
        np.testing.assert_allclose(often, shares, rtol=1e-5)
        for number, chosen in zip(drawn.tolist(), bits[time], strict=True):
            if chosen:
                priority[number] = (abs(errors[time][number % BATCH]) + 1e-3) ** exponent
        np.testing.assert_allclose(after[held], [priority[n] for n in numbers[held]], rtol=1e-5)
        priority = dict(zip(numbers[held].tolist(), after[held].tolist(), strict=True))
        assert not after[~held].any()


def test_draws_are_in_proportion_and_say_how_often():
    held = ADD(empty(), episodes(2, 4))
    shares, _, often = frequencies(held)
    np.testing.assert_allclose(shares[:8], 1 / 8, atol=0.01)
    np.testing.assert_allclose(often, 1)
    errors, numbers = jnp.array([3.0, -1.0, 0.0]), jnp.array([0, 1, 2])
    held = REPRIORITISE(held, numbers, errors, jnp.array([True, True, False]), 1.0)
    shares, slots, often = frequencies(held)
    total = 3.001 + 1.001 + 6
    np.testing.assert_allclose(shares[:3], np.array([3.001, 1.001, 1]) / total, atol=0.01)
    np.testing.assert_allclose(often[slots == 0], 3.001 * 8 / total, rtol=1e-5)
    values = np.arange(20.0)
    assert (values[slots] / often).mean() == pytest.approx(values[:8].mean(), abs=0.1)


def test_what_is_new_comes_first_and_what_is_gone_never():
    held = ADD(empty(), episodes(2, 6))
    some = jnp.arange(12)
    held = REPRIORITISE(held, some, 0.1 * some, some > 0, 1.0)
    held = ADD(held, episodes(1, 6))
    highest = held.priority.max()
    assert highest == pytest.approx(1.101) and (held.priority[12:18] == highest).all()
    assert (held.priority[18:] == 0).all()
    held = ADD(held, episodes(1, 6))  # 24 in a buffer of 20: four are overwritten
    assert (held.priority > 0).sum() == held.size < 20
    _, slots, _ = frequencies(held)
    assert set(slots) == set(np.flatnonzero(np.asarray(held.memory.held)))


def test_an_exponent_of_zero_draws_uniformly():
    held = ADD(empty(), episodes(2, 4))
    some = jnp.arange(8)
    held = REPRIORITISE(held, some, 10.0 * some, some >= 0, 0.0)
    np.testing.assert_allclose(held.priority[:8], 1)


def test_a_glimpse_is_what_is_around_a_place():
    picture = jax.random.uniform(jax.random.key(0), (2, 6, 7, 3))
    rows = jax.nn.one_hot(jnp.array([[2, 0], [5, 3]]), 6).transpose(0, 2, 1)
    columns = jax.nn.one_hot(jnp.array([[3, 0], [6, 1]]), 7).transpose(0, 2, 1)
    seen = glimpses(picture, rows, columns, 3)
    np.testing.assert_allclose(seen[0, 0], picture[0, 1:4, 2:5], rtol=1e-6)
    np.testing.assert_allclose(seen[0, 1, 1:, 1:], picture[0, :2, :2], rtol=1e-6)
    assert (seen[0, 1, 0] == 0).all() and (seen[0, 1, :, 0] == 0).all()
    np.testing.assert_allclose(seen[1, 0, :2, :2], picture[1, 4:, 5:], rtol=1e-6)
    halfway = glimpses(picture, rows.mean(2, keepdims=True), columns[..., :1], 3)
    both = glimpses(picture, rows, columns[..., :1].repeat(2, -1), 3).mean(1, keepdims=True)
    np.testing.assert_allclose(halfway, both, rtol=1e-5)


def test_values_follow_what_is_looked_for():
    """What is out of every glimpse's sight, and moves no place, changes nothing."""
    network = GlimpseQ(5, size=3)
    stack = jnp.zeros((1, 9, 9, 6)).at[0, 4, 4, 3:].set(1.0)
    params = network.init(jax.random.key(0), stack)
    before = network.apply(params, stack)
    assert before.shape == (1, 5) and np.isfinite(before).all()
    kernel = params["params"]["Dense_0"]["kernel"].at[:3].set(0.0)  # deaf to the older frame
    params["params"]["Dense_0"]["kernel"] = kernel
    before = network.apply(params, stack)
    far = network.apply(params, stack.at[0, 0, 0, 0].set(1.0))
    near = network.apply(params, stack.at[0, 3, 4, 0].set(1.0))
    np.testing.assert_array_equal(before, far)
    assert (jnp.abs(before - near) > 1e-6).any()


@pytest.mark.parametrize("error", [np.nan, np.inf, -np.inf])
def test_an_error_that_is_no_number_stops_nothing(error):
    held = ADD(empty(), episodes(2, 4))
    errors = jnp.ones(8).at[3].set(error)
    held = REPRIORITISE(held, jnp.arange(8), errors, jnp.ones(8, bool), 1.0)
    shares, *_ = frequencies(held)
    expected = np.where(np.arange(8) == 3, 0, 1 / 7)
    np.testing.assert_allclose(shares[:8], expected, atol=0.01)


def test_priorities_far_apart_are_drawn_but_for_rounding(monkeypatch):
    """Where one of 200,000 is 100,000 times less likely than others, 2^23 heights are too few: by
    the last 64 of them 3,054 items are to be drawn; which is the last of them is rounding, since a
    sum of 4,000 is known to within 24 of them.
    """
    weight = jnp.where(jnp.arange(200_000) < 4_000, 1.0, 1e-5)
    last = np.arange(2**32 - 64 * 512, 2**32).astype(np.uint32)
    monkeypatch.setattr(jax.random, "bits", lambda *given: jnp.asarray(last))
    drawn = np.bincount(np.asarray(ring.draw(weight, jax.random.key(0), last.shape)))
    assert drawn.size > 200_000 - 24
    assert 2_700 < (drawn > 0).sum() < 3_400 and drawn.max() < 256
