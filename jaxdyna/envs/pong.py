"""Pong with the measures of the Atari 2600 game: its field, ball, paddles, bounces and opponent."""

from dataclasses import dataclass, replace
from typing import ClassVar

import jax
import jax.numpy as jnp

from jaxdyna.envs.gymnasium import Pictures
from jaxdyna.envs.pong_rules import FIELD, NUM_ACTIONS, PongParams, PongState, advance, first_state
from jaxdyna.envs.pong_screen import (
    ABOVE,
    BELOW,
    ObjectMasks,
    Palette,
    blank,
    empty_screen,
    field_masks,
    paint,
    screen_masks,
)
from jaxdyna.fields import SettingError, check, setting
from jaxdyna.types import Key, Stepped


@dataclass(frozen=True)
class Pong(Pictures):
    """The player on the right against the built-in opponent on the left.

    The rules were measured on the Atari 2600 game frame by frame, and a test compares the two. A
    paddle sends the ball up or down by which part of it is hit; pressing fire at that moment makes
    the ball faster, up to three pixels a frame; who lost a point is served, upwards or downwards at
    random; the opponent runs after the ball at two pixels a frame and rests in one of eight; the
    own paddle is slow to start and to stop.

    The observation is a frame, uint8. With ``scale`` 1 it is the whole screen ``[210, 160, 3]``
    with walls and points; with more it is the field alone, ``[160 / scale, 160 / scale, 3]``, where
    a pixel shows what touches any of the pixels that it stands for, so that the ball never
    vanishes.
    """

    default_params: ClassVar = PongParams()
    num_actions: ClassVar = NUM_ACTIONS
    keys: ClassVar = {"up": 2, "down": 3, "space": 0}

    frame_skip: int = setting(4, "Frames a step, all with the same action.", at_least=1)
    scale: int = setting(
        1, "How many of the game's pixels a pixel of the frame is wide and high; a divisor of 160.",
        at_least=1)  # fmt: skip
    palette: Palette = setting(Palette(), "The colours; CHANNELS gives each object its channel.")

    def __post_init__(self) -> None:
        check(self)
        if FIELD % self.scale:
            raise SettingError("scale", f"is {self.scale}: it must be a divisor of {FIELD}")

    @property
    def frame_shape(self) -> tuple[int, int, int]:
        """``(height, width, 3)``."""
        side = FIELD // self.scale
        return (side + ABOVE + BELOW if self.scale == 1 else side, side, 3)

    def reset(self, key: Key, params: PongParams) -> tuple[jax.Array, PongState]:
        """The empty field some time before the first serve: ``obs, state``. Nothing is random."""
        state = first_state(params)
        return self.frame(state), state

    def step(self, key: Key, state: PongState, action: jax.Array, params: PongParams) -> Stepped:
        """``frame_skip`` frames.

        Returns:
            ``obs, state, reward, terminated, truncated, info``: the reward is 1 for a point won and
            -1 for one lost.
        """

        def won(state):
            return state.score.max() >= params.points_to_win

        def one_frame(carry, _):
            now, key = carry
            key, key_frame = jax.random.split(key)
            moved = advance(key_frame, now, action, params)
            now = jax.tree.map(lambda old, new: jnp.where(won(now), old, new), now, moved)
            return (now, key), None

        (new, _), _ = jax.lax.scan(one_frame, (state, key), length=self.frame_skip)
        new = replace(new, time=state.time + 1)
        lost, gained = new.score - state.score
        reward = (gained - lost).astype(jnp.float32)
        over, late = won(new), new.time >= params.max_steps
        return self.frame(new), new, reward, over, ~over & late, {}

    def object_masks(self, state: PongState) -> ObjectMasks:
        """Which pixels of the frame show the ball, the own paddle and the opponent's: bool
        ``[height, width]`` each, in this order.
        """
        return screen_masks(state) if self.scale == 1 else field_masks(state, self.scale)

    def frame(self, state: PongState) -> jax.Array:
        """What the state looks like, uint8 ``frame_shape``."""
        if self.scale == 1:
            below = empty_screen(state, self.palette)
        else:
            below = blank(self.frame_shape, self.palette)
        return paint(below, self.object_masks(state), self.palette)

    def render(self, state: PongState, params: PongParams) -> jax.Array:
        """The whole screen in the game's colours, twice as large: uint8 ``[420, 320, 3]``."""
        screen = paint(empty_screen(state, Palette()), screen_masks(state), Palette())
        return screen.repeat(2, axis=0).repeat(2, axis=1)
