"""The exact optimum of the Maze: value iteration (Bellman 1957) over time, row and column.

Obstacles move whatever the agent does, so their whole way is known at the start of an episode, and
what remains is a finite-horizon problem over the agent's cell.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxdyna.envs.maze import MOVES, Maze, MazeParams, MazeState


class Plan(NamedTuple):
    """The best that can be done from one start state."""

    best_return: jax.Array  #: undiscounted return of the optimal policy, scalar
    #: int32 ``[T, size, size]``: the optimal action at each time and cell of the agent
    action: jax.Array
    value: jax.Array  #: float32 ``[T + 1, size, size]``: the optimal return still to come


def solve_maze(env: Maze, state: MazeState, params: MazeParams, num_steps: int) -> Plan:
    """Plans from ``state``, usually of `Maze.reset`, to the end of the episode; ``num_steps`` is T,
    static, at least the steps that are left. Those beyond ``params.max_steps`` earn nothing; of
    equally good actions the lowest number is chosen.
    """
    cells = jnp.stack(jnp.meshgrid(*[jnp.arange(env.size)] * 2, indexing="ij"), axis=-1)
    landing = jnp.clip(cells[None] + jnp.array(MOVES)[:, None, None], 0, env.size - 1)

    def move(carry, _):
        obstacles, directions = env.patrol(*carry)
        return (obstacles, directions), obstacles

    start = (state.obstacles, state.directions)
    _, ways = jax.lax.scan(move, start, length=num_steps)

    def back(value, now):
        obstacles, time = now
        hit = (cells[:, :, None] == obstacles).all(-1).any(-1)
        home = (cells == state.goal).all(-1)
        reward = hit * params.collision_reward + home * params.goal_reward
        worth = jnp.where(time <= params.max_steps, reward + value, 0.0)
        choices = worth[landing[..., 0], landing[..., 1]]
        value = choices.max(0).astype(jnp.float32)
        return value, (choices.argmax(0).astype(jnp.int32), value)

    times = state.time + 1 + jnp.arange(num_steps)
    nothing = jnp.zeros((env.size, env.size), jnp.float32)
    _, (action, value) = jax.lax.scan(back, nothing, (ways, times), reverse=True)
    return Plan(
        best_return=value[0, state.agent[0], state.agent[1]],
        action=action,
        value=jnp.concatenate([value, nothing[None]]),
    )
