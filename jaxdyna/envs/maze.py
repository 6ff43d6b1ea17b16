"""The paper's Maze (§4.2): reach the goal through a crowd of moving obstacles, seen from above."""

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxdyna.envs.gymnasium import Pictures
from jaxdyna.fields import SettingError, check, setting
from jaxdyna.types import Key, Stepped

MOVES = np.array([(0, -1), (0, 1), (-1, 0), (1, 0), (0, 0)], np.int32)
"""(row, column) by action: left, right, forward (up), backward (down), wait; obstacles' directions
are the first four, and ``direction ^ 1`` is the way back.
"""
WAIT = 4


@struct.dataclass
class MazeParams:
    """What can be swept."""

    collision_reward: float = setting(-5.0, "Earned by a step that ends on an obstacle's cell.")
    goal_reward: float = setting(1.0, "Earned on a step that ends on the goal, beside it.")
    max_steps: int = setting(200, "Steps until truncation; nothing terminates.", at_least=1)


@struct.dataclass
class MazeState:
    """Cells as (row, column), row 0 on top; int32."""

    agent: jax.Array  #: ``[2]``
    goal: jax.Array  #: ``[2]``
    obstacles: jax.Array  #: ``[n, 2]``
    directions: jax.Array  #: ``[n]``, see `MOVES`
    time: jax.Array  #: the number of steps taken


@dataclass(frozen=True)
class Maze(Pictures):
    """A square grid with one agent, one goal that stays, and obstacles that patrol.

    In a step the agent moves, then every obstacle moves one cell in its direction; one that would
    leave the grid turns around instead. Obstacles pass through one another, and changing places
    with one is no collision.

    The observation is the frame, uint8 ``[size, size, 3]``: red 255 where an obstacle is, green at
    the goal, blue at the agent; a shared cell lights several channels.
    """

    default_params: ClassVar = MazeParams()
    num_actions: ClassVar = len(MOVES)
    keys: ClassVar = {"left": 0, "right": 1, "up": 2, "down": 3, "space": WAIT}

    size: int = setting(16, "Cells a side.", at_least=2)
    num_obstacles: int = setting(5, "Obstacles.", at_least=0)
    start: tuple[int, int] | None = setting(
        None, "The agent's first cell (row, column); None for bottom left.", at_least=0
    )
    goal: tuple[int, int] | None = setting(
        None, "The goal's cell (row, column); None for top right.", at_least=0
    )

    def __post_init__(self) -> None:
        check(self)
        for name, cell in (("start", self.start_cell), ("goal", self.goal_cell)):
            if max(cell) >= self.size:
                raise SettingError(
                    name, f"is {cell}: give a tuple (row, column) within 0..{self.size - 1}"
                )
        if self.start_cell == self.goal_cell:
            raise SettingError("start", f"is {self.start_cell}, the goal's cell: give another one")
        free = self.size**2 - 2
        if self.num_obstacles > free:
            raise SettingError("num_obstacles", f"is {self.num_obstacles}: it must be in 0..{free}")

    @property
    def start_cell(self) -> tuple[int, int]:
        """Where the agent starts."""
        return self.start if self.start is not None else (self.size - 1, 0)

    @property
    def goal_cell(self) -> tuple[int, int]:
        """Where the goal is."""
        return self.goal if self.goal is not None else (0, self.size - 1)

    @property
    def frame_shape(self) -> tuple[int, int, int]:
        """``(size, size, 3)``."""
        return self.size, self.size, 3

    def reset(self, key: Key, params: MazeParams) -> tuple[jax.Array, MazeState]:
        """Obstacles on distinct random cells, none the agent's or the goal's, each with a random
        direction: ``obs, state``.
        """
        key_cells, key_directions = jax.random.split(key)
        agent, goal = jnp.array([self.start_cell, self.goal_cell], jnp.int32)
        taken = np.zeros((self.size, self.size), bool)
        taken[self.start_cell] = taken[self.goal_cell] = True
        ticket = jax.random.uniform(key_cells, (self.size**2,))
        _, cells = jax.lax.top_k(jnp.where(taken.reshape(-1), -1, ticket), self.num_obstacles)
        state = MazeState(
            agent=agent,
            goal=goal,
            obstacles=jnp.stack([cells // self.size, cells % self.size], axis=-1),
            directions=jax.random.randint(key_directions, (self.num_obstacles,), 0, 4, jnp.int32),
            time=jnp.int32(0),
        )
        return self.frame(state), state

    def step(self, key: Key, state: MazeState, action: jax.Array, params: MazeParams) -> Stepped:
        """One move of all. Deterministic: ``key`` is not used.

        Returns:
            ``obs, state, reward, terminated, truncated, info``; ``info`` has ``collision`` and
            ``at_goal``, both bool. ``terminated`` is always False.
        """
        moves = jnp.array(MOVES)
        agent = jnp.clip(state.agent + moves[action], 0, self.size - 1)
        obstacles, directions = self.patrol(state.obstacles, state.directions)
        collision = (obstacles == agent).all(-1).any()
        at_goal = (agent == state.goal).all()
        state = MazeState(agent, state.goal, obstacles, directions, state.time + 1)
        reward = collision * params.collision_reward + at_goal * params.goal_reward
        truncated = state.time >= params.max_steps
        info = {"collision": collision, "at_goal": at_goal}
        reward, never = reward.astype(jnp.float32), jnp.bool_(False)
        return self.frame(state), state, reward, never, truncated, info

    def patrol(self, obstacles: jax.Array, directions: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The obstacles' next cells ``[n, 2]`` and directions ``[n]``: nothing else moves them."""
        ahead = obstacles + jnp.array(MOVES)[directions]
        outside = ((ahead < 0) | (ahead >= self.size)).any(-1)
        return (
            jnp.where(outside[:, None], obstacles, ahead),
            jnp.where(outside, directions ^ 1, directions),
        )

    def frame(self, state: MazeState) -> jax.Array:
        """What the state looks like, uint8 ``[size, size, 3]``."""
        cells = jnp.concatenate([state.obstacles, state.goal[None], state.agent[None]])
        channels = np.array([0] * self.num_obstacles + [1, 2])
        dark = jnp.zeros(self.frame_shape, jnp.uint8)
        return dark.at[cells[:, 0], cells[:, 1], channels].set(255)

    def render(self, state: MazeState, params: MazeParams) -> jax.Array:
        """The frame for people, about 256 pixels a side: `enlarge` of it."""
        return enlarge(self.frame(state), max(1, 256 // self.size))


def enlarge(frame: jax.Array, scale: int) -> jax.Array:
    """Every cell of ``[rows, columns, 3]`` as a square of ``scale`` pixels."""
    return frame.repeat(scale, axis=0).repeat(scale, axis=1)
