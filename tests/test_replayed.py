"""The oracle's dreams: the true world, from where real episodes have been."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdyna.envs import Catch, CatchParams, FrameStack, Maze, MazeParams, Replayed, ReplayedParams
from jaxdyna.experiments.study.frames import draw_state
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


def test_a_state_without_a_clock_is_refused():
    """A dream that goes on from it would end when the real episode did."""

    def draw(key, start):
        return jnp.zeros((16, 16, 12), jnp.uint8), {"agent": jnp.zeros(2)}

    with pytest.raises(ValueError, match="dict has no field time: count the steps"):
        Replayed(FrameStack(Maze()), draw).reset(
            jax.random.key(0), ReplayedParams(MazeParams(), None)
        )
