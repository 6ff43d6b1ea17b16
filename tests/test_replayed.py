"""The oracle's dreams: the true world, from where real episodes have been."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdyna.dyna.frames import draw_first_stack, draw_first_state, draw_state
from jaxdyna.envs import Catch, CatchParams, FrameStack, Maze, MazeParams, Replayed, ReplayedParams
from jaxdyna.replay import frames as frame_replay
from jaxdyna.rollout import rollout

WORLDS = {
    "maze": (FrameStack(Maze(size=6, num_obstacles=4)), MazeParams(max_steps=30), 30),
    "catch": (FrameStack(Catch(frames=True)), CatchParams(), 9),
}


@pytest.mark.parametrize("name", WORLDS)
def test_a_dream_goes_on_from_where_a_real_episode_has_been(name):
    """As that episode did, where the same is done: states are remembered, not guessed."""
    env, params, steps = WORLDS[name]

    def random(obs, key):
        return jax.random.randint(key, (), 0, env.num_actions)

    @jax.jit
    def play(key):
        return rollout(
            env, random, key, params, 5, num_steps=steps, record=lambda state, *_: state.env
        )

    real, states = play(jax.random.key(2))
    example = jax.tree.map(lambda leaf: leaf[0, 0], (real, states))
    held = frame_replay.init(200, 10, example[0], beside=example[1])
    held = frame_replay.add(held, real, states)
    world = Replayed(env, draw_state)

    @jax.jit
    def dream(key):
        given = ReplayedParams(params, held, steps)
        return rollout(world, lambda obs, key: jnp.int32(1), key, given, 20, num_steps=1,
                       record=lambda state, *_: state)  # fmt: skip

    dreamed, begun = dream(jax.random.key(3))
    steps_of = {}
    flat = jax.tree.map(lambda leaf: np.asarray(leaf)[np.asarray(real.mask)], real)
    for stack, *step in zip(flat.obs, flat.action, flat.next_obs, flat.reward, strict=True):
        steps_of.setdefault(stack.tobytes(), []).append(step)
    assert not begun.env.time.any()
    compared = 0
    for number, stack in enumerate(np.asarray(dreamed.obs[:, 0])):
        (action, after, reward), *others = steps_of[stack.tobytes()]
        if action == 1 and not others:  # what looks alike may go on otherwise
            np.testing.assert_array_equal(dreamed.next_obs[number, 0], after)
            assert dreamed.reward[number, 0] == reward
            compared += 1
    assert compared > 0


def test_dreams_begin_where_episodes_did():
    """At first observations of those that are still held, with their states."""
    env, params, steps = WORLDS["maze"]

    @jax.jit
    def begin(key):
        key_play, key_draw = jax.random.split(key)
        real, states = rollout(env, lambda obs, key: jnp.int32(2), key_play, params, 4,
                               num_steps=steps, record=lambda state, *_: state.env)  # fmt: skip
        example = jax.tree.map(lambda leaf: leaf[0, 0], (real, states))
        held = frame_replay.init(3 * steps + 3, 10, example[0], beside=example[1])
        held = frame_replay.add(
            held, jax.tree.map(lambda leaf: leaf[:2], real), states_of(states, 0)
        )
        held = frame_replay.add(
            held, jax.tree.map(lambda leaf: leaf[2:], real), states_of(states, 2)
        )
        keys = jax.random.split(key_draw, 40)
        seen, drawn = jax.vmap(draw_first_state, (0, None))(keys, held)
        return real.obs[:, 0], states.obstacles[:, 0], seen, drawn, draw_first_stack(key_draw, held)

    def states_of(states, first):
        return jax.tree.map(lambda leaf: leaf[first : first + 2], states)

    with jax.debug_key_reuse(False):
        firsts, obstacles, seen, drawn, alone = jax.tree.map(np.asarray, begin(jax.random.key(5)))
    which = [int(np.flatnonzero((firsts == one).all((1, 2, 3)))[0]) for one in seen]
    assert set(which) == {1, 2, 3}  # the first has made room
    np.testing.assert_array_equal(drawn.obstacles, obstacles[which])
    assert (drawn.time == 0).all() and (firsts[1:] == alone).all((1, 2, 3)).any()


def test_a_state_without_a_clock_is_refused():
    """A dream that goes on from it would end when the real episode did."""

    def draw(key, start):
        return jnp.zeros((16, 16, 12), jnp.uint8), {"agent": jnp.zeros(2)}

    with pytest.raises(ValueError, match="dict has no field time: count the steps"):
        Replayed(FrameStack(Maze()), draw).reset(
            jax.random.key(0), ReplayedParams(MazeParams(), None)
        )
