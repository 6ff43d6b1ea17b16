"""The oracle's dreams in the Maze: the true world, from where real episodes have been."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna import frame_replay
from jaxdyna.envs import FrameStack, Maze, MazeParams, ReplayedParams
from jaxdyna.experiments.maze.oracle import read_state, true_dream
from jaxdyna.rollout import rollout

MAZE = Maze(size=8, num_obstacles=4)
ENV = FrameStack(MAZE)
PARAMS = MazeParams(max_steps=30)


def play(key, episodes):
    def act(obs, key):
        return jax.random.randint(key, (), 0, 5)

    return rollout(ENV, act, key, PARAMS, episodes)


def test_the_state_is_read_off_the_frames():
    """One step on, the true and the read state look the same, whatever the agent does."""
    played = jax.jit(lambda key: play(key, 40))(jax.random.key(0))
    stacks, actions = played.obs.reshape(-1, *played.obs.shape[2:]), played.action.reshape(-1)
    keys = jax.random.split(jax.random.key(1), len(stacks))

    @jax.vmap
    def go_on(stack, action, key):
        key_read, key_step = jax.random.split(key)
        state = read_state(MAZE, stack, PARAMS, key_read)
        return MAZE.frame(state), MAZE.step(key_step, state, action, PARAMS)[0]

    now, after = jax.jit(go_on)(stacks, actions, keys)
    np.testing.assert_array_equal(now, played.obs[..., -3:].reshape(now.shape))
    right = (after == played.next_obs[..., -3:].reshape(after.shape)).all((1, 2, 3))
    right = np.asarray(right).reshape(40, 30)
    assert right[:, 3:].mean() > 0.97  # what is hidden behind another cannot be known
    assert right[:, 0].mean() < 0.5  # nor which way things go before they have moved


def test_a_maze_without_obstacles_is_read_too():
    empty = Maze(size=4, num_obstacles=0)
    stack, state = FrameStack(empty).reset(jax.random.key(0), PARAMS)
    read = jax.jit(lambda key: read_state(empty, stack, PARAMS, key))(jax.random.key(1))
    np.testing.assert_array_equal(read.agent, state.env.agent)
    assert read.obstacles.shape == (0, 2)


def test_a_dream_goes_on_from_a_real_frame():
    real = jax.jit(lambda key: play(key, 5))(jax.random.key(2))
    held = frame_replay.init(200, 10, jax.tree.map(lambda leaf: leaf[0, 0], real), 4)
    held = frame_replay.add(held, real)
    none = frame_replay.sample(held, jax.random.key(4), (0, 3))  # an arm without model updates
    assert none.obs.shape == (0, 3, 8, 8, 12)
    params = ReplayedParams(PARAMS, held, max_steps=30)
    env = true_dream(MAZE).env

    def act(obs, key):
        return jax.random.randint(key, (), 0, 5)

    @jax.jit
    def dream(key):
        return rollout(env, act, key, params, 20, num_steps=6)

    dreamed = dream(jax.random.key(3))
    seen = {stack.tobytes() for stack in np.asarray(real.obs).reshape(-1, *real.obs.shape[2:])}
    assert all(stack.tobytes() in seen for stack in np.asarray(dreamed.obs[:, 0]))
    collision = (dreamed.next_obs[..., -3] & dreamed.next_obs[..., -1]).any((-1, -2))
    at_goal = (dreamed.next_obs[..., -2] & dreamed.next_obs[..., -1]).any((-1, -2))
    np.testing.assert_array_equal(dreamed.reward, -5.0 * collision + at_goal)
    assert bool(jnp.any(collision)) and dreamed.mask.all()
