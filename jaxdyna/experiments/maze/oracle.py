"""The true Maze for the oracle's dreams, whose episodes begin where real ones have been."""

from functools import cache, partial

import jax
import jax.numpy as jnp

from jaxdyna.dyna import Dream
from jaxdyna.envs import FrameStack, Maze, MazeParams, MazeState
from jaxdyna.experiments.study import frames
from jaxdyna.types import Key


@cache
def true_dream(maze: Maze) -> Dream:
    """The oracle's dreams."""
    return frames.true_dream(FrameStack(maze), partial(read_state, maze))


def read_state(maze: Maze, stack: jax.Array, params: MazeParams, key: Key) -> MazeState:
    """The state, at step 0, that a stack of frames ``[size, size, 3 * frames]`` shows, the newest
    last. The key draws what cannot be told: which way an obstacle goes at the start of an episode.
    Of obstacles that share a cell each takes the direction that explains the frames next best.
    """
    frames = stack.reshape(maze.size, maze.size, -1, 3) > 0
    red, agent, goal = frames[..., 0], frames[:, :, -1, 2], frames[:, :, -1, 1]
    lit, cells = jax.lax.top_k(red[..., -1].reshape(-1).astype(jnp.int32), maze.num_obstacles)
    scores = _explained(maze, red, _cell(maze, cells))
    scores = scores + 1e-3 * jax.random.uniform(key, scores.shape)
    second = jnp.where(lit > 0, jnp.sort(scores, axis=1)[:, -2], -jnp.inf)
    hidden_at = jnp.argmax(second) if maze.num_obstacles else 0
    chosen = jnp.where(lit > 0, jnp.arange(maze.num_obstacles), hidden_at)
    earlier = jnp.tril(chosen[:, None] == chosen, -1).sum(1)
    best_first = jnp.argsort(-scores[chosen], axis=1)
    directions = jnp.take_along_axis(best_first, jnp.minimum(earlier, 3)[:, None], 1)[:, 0]
    return MazeState(
        agent=_cell(maze, jnp.argmax(agent)),
        goal=_cell(maze, jnp.argmax(goal)),
        obstacles=_cell(maze, cells[chosen]),
        directions=directions.astype(jnp.int32),
        time=jnp.int32(0),
    )


def _explained(maze: Maze, red: jax.Array, cells: jax.Array) -> jax.Array:
    """How well an obstacle in each of ``cells [n, 2]`` explains the frames before, ``[n, 4]`` by
    its direction; the newer the frame the more it counts.
    """
    count = red.shape[-1]
    where = jnp.repeat(cells, 4, axis=0)
    heading = jnp.tile(jnp.arange(4), len(cells))
    score = jnp.zeros(len(heading))
    for back in range(1, count):
        where, turned = maze.patrol(where, heading ^ 1)  # a patrol is the same backwards
        heading = turned ^ 1
        score += 0.5**back * red[where[:, 0], where[:, 1], count - 1 - back]
    return score.reshape(-1, 4)


def _cell(maze: Maze, number: jax.Array) -> jax.Array:
    return jnp.stack([number // maze.size, number % maze.size], axis=-1).astype(jnp.int32)
