"""The replay that keeps each frame once, against stacks that were kept whole."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from parts import assert_same

from jaxdyna import rollout
from jaxdyna.envs import FrameStack, Maze, MazeParams
from jaxdyna.replay import frames as frame_replay
from jaxdyna.replay.memory import frames
from jaxdyna.replay.n_step import take_window
from jaxdyna.replay.ring import share_weight
from jaxdyna.types import Transition

ENV = FrameStack(Maze(size=5, num_obstacles=3))
TAKE, ADD = jax.jit(frame_replay.take), jax.jit(frame_replay.add)
HELD = jax.jit(lambda buffer: buffer.held)
SAMPLE = jax.jit(frame_replay.sample, static_argnums=2)
WINDOW = jax.jit(take_window, static_argnums=2)


def act(obs, key):
    return jax.random.randint(key, (), 0, 5)


@partial(jax.jit, static_argnums=(1, 2))
def _play(key, count, steps):
    return rollout(ENV, act, key, MazeParams(max_steps=steps), count, num_steps=steps)


def play(seed, count, steps=7, lengths=None):
    """Episodes ``[count, steps]``, in NumPy; those cut to ``lengths`` terminate there."""
    most = jax.tree.map(np.asarray, _play(jax.random.key(seed), 3, steps))
    episodes = jax.tree.map(lambda leaf: leaf[:count], most)
    if lengths is None:
        return episodes
    time, ends = np.arange(steps), np.asarray(lengths)[:, None]
    return episodes._replace(
        mask=time < ends, terminated=time == ends - 1, truncated=np.zeros((count, steps), bool)
    )


def play_maze():
    """Shapes of a transition of the default maze."""
    world = FrameStack(Maze())
    played = jax.eval_shape(
        lambda key: rollout(world, act, key, MazeParams(max_steps=5), 1), jax.random.key(0)
    )
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[2:], leaf.dtype), played)


def flat(parts):
    """All valid transitions in the order in which they were added."""
    rows = [jax.tree.map(lambda leaf, p=part: np.asarray(leaf)[np.asarray(p.mask)], part)
            for part in parts]  # fmt: skip
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *rows)


def example(episodes):
    return jax.tree.map(lambda leaf: leaf[0, 0], episodes)


def check(buffer, parts):
    """Everything held is as it was added; returns how much that is."""
    kept = flat(parts)
    numbers = np.arange(int(buffer.oldest), int(buffer.added))
    padded = np.resize(numbers, 64)  # one shape, and so one program, for all
    got = jax.tree.map(lambda leaf: np.asarray(leaf)[: len(numbers)], TAKE(buffer, padded))
    assert_same(got, jax.tree.map(lambda leaf: leaf[numbers], kept))
    assert int(HELD(buffer).sum()) == int(buffer.size) == len(numbers)
    return len(numbers)


def test_stacks_come_back_as_they_were_across_the_ends_of_episodes():
    parts = [play(0, 2), play(1, 1, lengths=[1]), play(2, 3, lengths=[3, 7, 2])]
    buffer = frame_replay.init(64, 20, example(parts[0]))
    assert int(buffer.size) == 0 and not HELD(buffer).any()
    for part in parts:
        buffer = ADD(buffer, part)
    assert check(buffer, parts) == 14 + 1 + 12
    assert int(buffer.episodes_added) == 6


def test_a_branch_remembers_what_was_seen_before_it():
    branch = jax.tree.map(lambda leaf: leaf[:, 3:], play(0, 2))
    parts = [branch, play(1, 1), jax.tree.map(lambda leaf: leaf[:, 1:3].copy(), play(2, 2))]
    parts[2].truncated[:, -1] = True
    buffer = frame_replay.init(64, 20, example(branch))
    for part in parts:
        buffer = ADD(buffer, part)
    assert check(buffer, parts) == 2 * 4 + 7 + 2 * 2


def test_an_episode_whose_last_steps_are_masked_ends_before_them():
    episodes = play(0, 2)
    weight = np.full((2, 7), 0.5, np.float32)
    light = episodes._replace(mask=episodes.mask & (np.arange(7) < 4), weight=weight)
    buffer = ADD(frame_replay.init(64, 9, example(light)), light)
    assert int(buffer.size) == 8
    drawn = TAKE(buffer, jnp.arange(8))
    assert_same(drawn.next_obs, episodes.next_obs[:, :4].reshape(8, 5, 5, 12))
    np.testing.assert_array_equal(drawn.weight, 0.5)
    window = WINDOW(buffer, jnp.arange(8), 3, 1.0)
    assert_same(window.last_obs[2], episodes.next_obs[0, 3])


def test_a_gap_in_the_mask_is_kept_as_it_was():
    episodes = play(0, 1)
    episodes = episodes._replace(mask=episodes.mask & (np.arange(7) != 3))
    buffer = ADD(frame_replay.init(64, 20, example(episodes)), episodes)
    assert int(buffer.size) == 7
    drawn = TAKE(buffer, jnp.arange(7))
    np.testing.assert_array_equal(drawn.mask, episodes.mask[0])
    assert_same(drawn.next_obs, episodes.next_obs[0])


def test_an_emptied_replay_yields_nothing():
    """Though what it held still lies there."""
    memory, episodes = frames(lambda rest: rest["reward"] > 0), play(0, 2)
    held = ADD(frame_replay.init(32, 8, example(episodes)), episodes)
    assert SAMPLE(held, jax.random.key(0), (3,)).mask.all()
    assert not SAMPLE(memory.forget(held, jnp.bool_(True)), jax.random.key(0), (3,)).mask.any()


def test_a_window_ends_with_the_newest_transition():
    """Nothing lies behind it, or something of long ago."""
    episodes = play(3, 1)
    buffer = ADD(frame_replay.init(64, 20, example(episodes)), episodes)
    window = WINDOW(buffer, jnp.array([4, 5, 6, 6]), 3, 0.5)
    np.testing.assert_allclose(window.discount, [0.125, 0.25, 0.5, 0.5])
    assert_same(window.last_obs[1], episodes.next_obs[0, 6])


def test_windows_by_hand():
    episodes = play(3, 2, lengths=[3, 7])
    episodes = episodes._replace(reward=np.arange(14, dtype=np.float32).reshape(2, 7))
    buffer = ADD(frame_replay.init(64, 20, example(episodes)), episodes)
    window = WINDOW(buffer, jnp.arange(4), 3, 0.5)
    np.testing.assert_allclose(window.reward, [0 + 0.5 + 0.5, 1 + 1, 2, 7 + 4 + 9 / 4])
    np.testing.assert_allclose(window.discount, [0, 0, 0, 0.125])
    assert_same(window.first, TAKE(buffer, jnp.arange(4)))
    assert_same(window.last_obs[3], episodes.next_obs[1, 2])
    single = WINDOW(buffer, jnp.arange(4), 1, 0.5)
    np.testing.assert_allclose(single.reward, [0, 1, 2, 7])
    np.testing.assert_allclose(single.discount, [0.5, 0.5, 0, 0.5])
    cut = episodes._replace(truncated=episodes.terminated, terminated=episodes.truncated)
    buffer = ADD(frame_replay.init(64, 20, example(cut)), cut)
    window = WINDOW(buffer, jnp.arange(3), 3, 0.5)
    np.testing.assert_allclose(window.discount, [0.125, 0.25, 0.5])  # truncation never cuts
    np.testing.assert_allclose(WINDOW(buffer, jnp.arange(4), 1, 0.5).discount, 0.5)


FRAMES, BATCH, LENGTH, LENGTHS = 3, 2, 4, 3
"""In a stack; episodes at a time and their longest; of a window."""


def numbered(first, masks, older):
    """A batch of episodes ``[N, T]`` of vectors that are numbers, each another one; before the
    first there is its own repeated, or where it branched off (``older``) what was seen before.
    """
    count, steps = masks.shape
    frames = 100.0 * (first + np.arange(count))[:, None] + np.arange(FRAMES + steps)
    frames[~older, : FRAMES - 1] = frames[~older, FRAMES - 1 : FRAMES]
    stacks = np.lib.stride_tricks.sliding_window_view(frames, FRAMES, axis=1).astype(np.float32)
    last = np.arange(steps) == (masks * np.arange(1, steps + 1)).max(1)[:, None] - 1
    ends = last & (frames[:, 0] % 200 < 100)[:, None]
    reward = frames[:, FRAMES:].astype(np.float32)
    action = np.broadcast_to(np.arange(steps, dtype=np.int32), masks.shape)
    return Transition(stacks[:, :-1], action, reward, stacks[:, 1:], ends, last & ~ends, masks)


@partial(jax.jit, static_argnums=0)
def after_each(sizes, batches, forgotten, key):
    """A replay after each batch, before which it may be emptied; whatever is at every place, as
    transitions and as windows; and a draw.
    """
    memory = frames(lambda rest: rest["truncated"], FRAMES)
    example = jax.tree.map(lambda leaf: leaf[0, 0, 0], batches)

    def put(held, now):
        batch, forget, key = now
        held = memory.add(memory.forget(held, forget), batch, (), 0)
        numbers = jnp.maximum(held.number(jnp.arange(held.capacity)), held.oldest)
        window = take_window(held, numbers, LENGTHS, 0.5)
        drawn = frame_replay.draw_numbers(held, key, (16,))
        counts = held.oldest, held.added, held.size
        return held, (counts, held.held, numbers, memory.take(held, numbers), window, drawn)

    start = memory.init(*sizes, example, ())
    keys = jax.random.split(key, len(forgotten))
    return jax.lax.scan(put, start, (batches, forgotten, keys))[1]


def windows(items, episodes):
    """Of each transition of a list: the reward of its window, what is seen after it, and the
    discount of that.
    """
    found = []
    for number, episode in enumerate(episodes):
        steps = min(LENGTHS, np.count_nonzero(episodes[number:] == episode))
        last = number + steps - 1
        reward = sum(0.5**step * float(items.reward[number + step]) for step in range(steps))
        found.append((reward, items.next_obs[last], 0.5**steps * (not items.terminated[last])))
    return [np.array(part) for part in zip(*found, strict=True)]


@given(data=st.data(), sizes=st.sampled_from([(8, 2), (11, 5)]))
@settings(max_examples=50)
def test_what_is_held_is_what_was_added(data, sizes):
    """Episodes of any length, none included, some branched off, wherever they wrap around: stacks
    and windows look across no episode's end and at nothing that was overwritten.
    """
    capacity, room = sizes
    ends = data.draw(st.lists(st.integers(0, LENGTH), min_size=12, max_size=12))
    older = np.array(data.draw(st.lists(st.booleans(), min_size=12, max_size=12)))
    often = data.draw(st.integers(2, 7))
    masks = (np.arange(LENGTH) < np.array(ends)[:, None]).reshape(-1, BATCH, LENGTH)
    older, forgotten = older.reshape(-1, BATCH), np.arange(1, 7) % often == 0
    parts = [numbered(2 * number, masks[number], older[number]) for number in range(6)]
    batches = jax.tree.map(lambda *leaves: np.stack(leaves), *parts)
    answers = after_each(sizes, batches, forgotten, jax.random.key(often))
    answers = jax.tree.map(np.asarray, answers)
    items, episodes = flat(parts), np.repeat(np.arange(12), ends)
    expected = windows(items, episodes) if len(episodes) else None
    begun = 0
    for time in range(6):
        now = jax.tree.map(lambda leaf, at=time: leaf[at], answers)
        counts, held, numbers, taken, window, drawn = now
        begun = 2 * time if forgotten[time] else begun
        before, added = np.searchsorted(episodes, [begun, 2 * time + 2])
        lost = max(added - before - capacity, 0)
        first = before + (lost + FRAMES - 1 if lost else 0)
        first = max(first, np.searchsorted(episodes, 2 * time + 2 - room))
        here = np.arange(first, added)
        assert counts[2] == len(here) == held.sum()
        assert len(here) or not taken.mask.any()
        if len(here):
            assert counts[:2] == (first - before, added - before)
            assert set(before + drawn) <= set(here)
            places = before + numbers[held]
            np.testing.assert_array_equal(np.sort(places), here)
            held_items, its_windows = jax.tree.map(lambda leaf, at=held: leaf[at], (taken, window))
            assert_same(held_items, jax.tree.map(lambda leaf, at=places: leaf[at], items))
            for ours, theirs in zip(its_windows[1:], expected, strict=True):
                np.testing.assert_array_equal(ours, theirs[places])


def test_memory_draws_rare_transitions_and_forgets():
    episodes = play(0, 2)
    episodes = episodes._replace(reward=np.zeros((2, 7), np.float32))
    episodes.reward[1, 3] = 1
    memory = frames(lambda rest: rest["reward"] > 0)
    add, forget = jax.jit(memory.add), jax.jit(memory.forget)
    held = add(memory.init(64, 9, example(episodes), ()), episodes, (), 0)

    @partial(jax.jit, static_argnums=1)
    def mean_reward(held, share):
        return memory.take(held, memory.draw(held, jax.random.key(0), (400,), share)).reward.mean()

    assert mean_reward(held, 0.5) == pytest.approx(0.5, abs=0.08)
    assert mean_reward(held, None) < 0.2
    emptied = forget(held, jnp.bool_(True))
    assert int(emptied.size) == 0
    assert int(add(emptied, play(1, 2), (), 2).size) == 14
    assert int(forget(held, jnp.bool_(False)).size) == 14


def test_what_lost_its_frames_is_not_drawn():
    parts = [play(seed, 1, lengths=[length]) for seed, length in enumerate([7, 5, 2, 7, 6, 3, 7])]
    buffer = frame_replay.init(16, 20, example(parts[0]))
    for number, part in enumerate(parts, start=1):
        buffer = ADD(buffer, part)
        check(buffer, parts[:number])
    assert int(buffer.size) == 16 - 3
    few = frame_replay.init(64, 2, example(parts[0]))
    for part in parts:
        few = ADD(few, part)
    assert check(few, parts) == 3 + 7


def test_samples_are_uniform_and_whole():
    parts = [play(0, 2), play(1, 2, lengths=[3, 5])]
    buffer = frame_replay.init(32, 8, example(parts[0]))
    empty = SAMPLE(buffer, jax.random.key(0), (3,))
    assert not empty.mask.any()
    for part in parts:
        buffer = ADD(buffer, part)
    drawn = SAMPLE(buffer, jax.random.key(0), (100, 40))
    assert drawn.obs.shape == (100, 40, 5, 5, 12) and drawn.mask.all()
    rows = {row.tobytes() for row in np.asarray(flat(parts).obs)}
    seen = [row.tobytes() for row in np.asarray(drawn.obs).reshape(-1, 5, 5, 12)]
    assert set(seen) == rows
    ends = buffer.rest["truncated"] | buffer.rest["terminated"]
    weight = jax.jit(share_weight, static_argnums=2)(HELD(buffer), ends, 0.5)
    drawn = SAMPLE(buffer, jax.random.key(1), (4000,), weight)
    assert (drawn.truncated | drawn.terminated).mean() == pytest.approx(0.5, abs=0.03)


def bytes_per_transition(replay):
    leaves = jax.tree.leaves(replay)
    return sum(leaf.size * leaf.dtype.itemsize for leaf in leaves) / replay.capacity


def test_memory_is_a_frame_and_little_more():
    big = play(0, 1)
    buffer = frame_replay.init(4000, 20, example(big))
    frame = 5 * 5 * 3
    room = frame_replay.init(60_000, 300, play_maze())
    assert bytes_per_transition(room) == pytest.approx(802, abs=1.5)
    assert frame < bytes_per_transition(buffer) < frame + 21


def test_clear_errors():
    episodes = play(0, 3)
    with pytest.raises(ValueError, match="at once"):
        frame_replay.add(frame_replay.init(20, 9, example(episodes)), episodes)
    with pytest.raises(ValueError, match="at once"):
        frame_replay.add(frame_replay.init(90, 2, example(episodes)), episodes)
    buffer = frame_replay.init(90, 9, example(episodes))
    with pytest.raises(AssertionError, match="says which steps there are"):
        frame_replay.add(buffer, episodes._replace(mask=episodes.mask * 1.0))
    with pytest.raises(AssertionError, match="shape"):
        frame_replay.add(buffer, episodes._replace(reward=episodes.reward.T))
    with pytest.raises(ValueError, match="equal depth"):
        frame_replay.init(20, 9, example(episodes), num_frames=5)
    with pytest.raises(ValueError, match="capacity is 3: give at least a stack"):
        frame_replay.init(3, 9, example(episodes))
