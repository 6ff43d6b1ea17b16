"""Catch with bsuite's rules (Osband et al. 2020): a ball falls, a paddle goes to meet it."""

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxdyna.envs.gymnasium import Discrete, spaces
from jaxdyna.envs.maze import enlarge
from jaxdyna.fields import Checked, setting
from jaxdyna.types import Key, Stepped

MOVES = np.array([-1, 0, 1], np.int32)  #: the paddle's columns by action: left, stay, right


@struct.dataclass
class CatchParams:
    """What can be swept; ``max_steps`` is that of 10 rows, see `Catch.default_params`."""

    catch_reward: float = setting(1.0, "Earned when the ball lands on the paddle.")
    miss_reward: float = setting(-1.0, "Earned when it lands beside the paddle.")
    max_steps: int = setting(9, "Steps to truncation; the ball lands after rows - 1.", at_least=1)


@struct.dataclass
class CatchState:
    """Cells count from the top left; int32."""

    ball: jax.Array  #: ``[2]``, (row, column)
    paddle: jax.Array  #: its column; its row is the last one
    time: jax.Array  #: the number of steps taken


@dataclass(frozen=True)
class Catch(Discrete, Checked):
    """A ball starts in the top row and falls one row a step; the paddle starts in the middle of
    the bottom row and moves left (0), stays (1) or moves right (2), staying on the board. The
    episode terminates when the ball reaches the bottom row; only that step earns anything.

    The observation is float32 ``[rows * columns]``, bsuite's board row by row: 1 at the ball and
    the paddle. With ``frames`` it is uint8 ``[rows, columns, 3]``: red 255 at the ball, blue at
    the paddle; a shared cell lights both.
    """

    num_actions: ClassVar = len(MOVES)

    rows: int = setting(10, "Of the board.", at_least=2)
    columns: int = setting(5, "Of the board.", at_least=1)
    frames: bool = setting(False, "Whether it is seen as a picture.")

    @property
    def default_params(self) -> CatchParams:
        """bsuite's rewards; every episode terminates, none is truncated."""
        return CatchParams(max_steps=self.rows - 1)

    def reset(self, key: Key, params: CatchParams) -> tuple[jax.Array, CatchState]:
        """The ball in a random column: ``obs, state``."""
        column = jax.random.randint(key, (), 0, self.columns, jnp.int32)
        zero, middle = jnp.int32(0), jnp.int32(self.columns // 2)
        state = CatchState(ball=jnp.stack([zero, column]), paddle=middle, time=zero)
        return self.observe(state), state

    def step(self, key: Key, state: CatchState, action: jax.Array, params: CatchParams) -> Stepped:
        """The paddle moves, the ball falls. Deterministic: ``key`` is not used.

        Returns:
            ``obs, state, reward, terminated, truncated, info``; ``info`` has ``caught``, bool. A
            step that terminates is not truncated.
        """
        paddle = jnp.clip(state.paddle + jnp.array(MOVES)[action], 0, self.columns - 1)
        ball = state.ball + jnp.array([1, 0], jnp.int32)
        state = CatchState(ball, paddle, state.time + 1)
        terminated = ball[0] >= self.rows - 1
        truncated = ~terminated & (state.time >= params.max_steps)
        caught = terminated & (ball[1] == paddle)
        landing = jnp.where(caught, params.catch_reward, params.miss_reward)
        reward = jnp.where(terminated, landing, 0).astype(jnp.float32)
        return self.observe(state), state, reward, terminated, truncated, {"caught": caught}

    def observe(self, state: CatchState) -> jax.Array:
        """What is seen of a state, in either form."""
        frame = self.frame(state)
        return frame if self.frames else frame.any(-1).reshape(-1).astype(jnp.float32)

    def frame(self, state: CatchState) -> jax.Array:
        """What the state looks like, uint8 ``[rows, columns, 3]``."""
        rows, columns = jnp.arange(self.rows)[:, None], jnp.arange(self.columns)
        ball = (rows == state.ball[0]) & (columns == state.ball[1])
        paddle = (rows == self.rows - 1) & (columns == state.paddle)
        layers = [ball, jnp.zeros_like(ball), paddle]
        return jnp.stack(layers, axis=-1).astype(jnp.uint8) * jnp.uint8(255)

    def render(self, state: CatchState, params: CatchParams) -> jax.Array:
        """The frame for people, about 256 pixels on its longer side: `enlarge` of it."""
        return enlarge(self.frame(state), max(1, 256 // max(self.rows, self.columns)))

    def observation_space(self, params: CatchParams) -> spaces.Box:
        """Zeros and ones, or bytes with ``frames``."""
        if self.frames:
            return spaces.Box(0, 255, (self.rows, self.columns, 3), np.uint8)
        return spaces.Box(0, 1, (self.rows * self.columns,), np.float32)
