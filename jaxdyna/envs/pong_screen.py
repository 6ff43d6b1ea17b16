"""What `jaxdyna.envs.Pong` looks like: objects as masks, and the screen drawn from them."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna.envs.pong_rules import BALL, FIELD, OPPONENT_COLUMN, OWN_COLUMN, PADDLE, PongState

ABOVE, BELOW, WALL = 34, 16, 10
"""Rows of the whole screen above and below the field, and of the upper wall, which touches it."""
DIGIT_COLUMNS = (20, 100)  #: where the opponent's points and the own are written
_ROWS = "75557 26227 71747 71317 55711 74717 74757 71222 75757 75717"
"""Of each digit, the bits of three pixels."""
_DIGITS = np.array(
    [[[int(row) >> bit & 1 for bit in (2, 1, 0)] for row in rows] for rows in _ROWS.split()], bool
)
_DIGITS = _DIGITS.repeat(4, axis=1).repeat(4, axis=2)


class Palette(NamedTuple):
    """Colours ``(red, green, blue)``."""

    background: tuple[int, int, int] = (144, 72, 17)
    ball: tuple[int, int, int] = (236, 236, 236)
    own: tuple[int, int, int] = (92, 186, 92)
    opponent: tuple[int, int, int] = (213, 130, 74)


CHANNELS = Palette((0, 0, 0), ball=(0, 0, 255), own=(0, 255, 0), opponent=(255, 0, 0))
"""One channel an object, on black."""


class ObjectMasks(NamedTuple):
    """The pixels of each object in a frame, bool ``[height, width]``."""

    ball: jax.Array
    own: jax.Array
    opponent: jax.Array


def field_masks(state: PongState, scale: int) -> ObjectMasks:
    """Which pixels of the field an object touches, bool ``[160 / scale, 160 / scale]`` each;
    ``scale`` is how many of the game's pixels are a side of one.
    """
    first = scale * jnp.arange(FIELD // scale)

    def covered(start, length):
        return (start < first + scale) & (start + length > first)

    def box(row, column, size):
        return covered(row, size[0])[:, None] & covered(column, size[1])[None, :]

    return ObjectMasks(
        ball=box(state.ball[0], state.ball[1], BALL),
        own=box(state.own - state.own % 2, OWN_COLUMN, PADDLE),
        opponent=box(state.opponent, OPPONENT_COLUMN, PADDLE),
    )


def screen_masks(state: PongState) -> ObjectMasks:
    """The same on the whole screen, ``[210, 160]``."""
    margins = ((ABOVE, BELOW), (0, 0))
    return jax.tree.map(lambda mask: jnp.pad(mask, margins), field_masks(state, 1))


def masks_by_colour(screen: jax.Array, scale: int, palette: Palette) -> ObjectMasks:
    """As `field_masks`, bool ``[..., 160 / scale, 160 / scale]`` each, but from a picture of the
    whole screen in these colours, uint8 ``[..., 210, 160, 3]``, the real game's for one.
    """
    field = screen[..., ABOVE : ABOVE + FIELD, :, :]
    blocks = (*field.shape[:-3], FIELD // scale, scale, FIELD // scale, scale)

    def shown(colour):
        return (field == jnp.array(colour, jnp.uint8)).all(-1).reshape(blocks).any((-3, -1))

    return ObjectMasks(shown(palette.ball), shown(palette.own), shown(palette.opponent))


def paint(frame: jax.Array, masks: ObjectMasks, palette: Palette) -> jax.Array:
    """The objects, bool ``[..., height, width]`` each, in their colours on a frame, uint8 ``[...,
    height, width, 3]``; the ball in front.
    """
    for name in ("opponent", "own", "ball"):
        colour = jnp.array(getattr(palette, name), jnp.uint8)
        frame = jnp.where(getattr(masks, name)[..., None], colour, frame)
    return frame


def blank(shape: tuple[int, ...], palette: Palette) -> jax.Array:
    """Nothing but background, uint8 ``shape``, which ends in 3."""
    return jnp.broadcast_to(jnp.array(palette.background, jnp.uint8), shape)


def shares_of(frame: jax.Array, palette: Palette) -> jax.Array:
    """How much of opponent, own paddle and ball, ``[..., H, W, 3]`` in [0, 1], there is in each
    pixel of a frame of the field, 0 to 255, that may be blurred: a mixture of the background and
    one object, the one with which it comes closest. In `CHANNELS` an object has a channel of its
    own, and all of them count.
    """
    frame = frame.astype(jnp.float32)
    if palette == CHANNELS:
        return frame / 255
    ground = jnp.array(palette.background, jnp.float32)
    towards = jnp.array(_in_order(palette), jnp.float32) - ground
    off = frame - ground
    share = jnp.clip(off @ towards.T / jnp.square(towards).sum(-1), 0, 1)
    left = jnp.square(off[..., None, :] - share[..., None] * towards).sum(-1)
    return jnp.where(jnp.arange(3) == left.argmin(-1)[..., None], share, 0)


def picture_of(masks: jax.Array, palette: Palette) -> jax.Array:
    """The frame of the field with these objects, bool ``[..., H, W, 3]`` as `shares_of`; the ball
    in front: uint8, the same shape.
    """
    opponent, own, ball = jnp.moveaxis(masks, -1, 0)
    return paint(blank(masks.shape, palette), ObjectMasks(ball, own, opponent), palette)


def mixture_of(shares: jax.Array, palette: Palette) -> jax.Array:
    """A picture of so much of each object in a pixel, ``[..., H, W, 3]`` as `shares_of`: float32, 0
    to 255, the same shape.
    """
    ground = jnp.array(palette.background, jnp.float32)
    towards = jnp.array(_in_order(palette), jnp.float32) - ground
    return jnp.clip(ground + shares.astype(jnp.float32) @ towards, 0, 255)


def in_channels(stack: jax.Array, palette: Palette) -> jax.Array:
    """A stack ``[..., H, W, 3 * frames]`` in these colours, each object in a channel of its own,
    uint8. They are told by how red they are, in which they all differ.
    """
    if palette == CHANNELS:
        return stack
    reds = jnp.array([colour[0] for colour in (palette.opponent, palette.own, palette.ball)])
    red = stack.reshape(*stack.shape[:-1], -1, 3)[..., :1]
    return 255 * (red == reds.astype(jnp.uint8)).reshape(stack.shape).astype(jnp.uint8)


def middles(masks: jax.Array, axis: int, scale: int = 1) -> jax.Array:
    """Mean row or column, in pixels ``1 / scale`` as large, of a thing in each frame of ``[H, W,
    frames]``: ``[frames]``, 0 where there is none.
    """
    profile = masks.sum(1 - axis)
    numbers = jnp.arange(profile.shape[0]) + 0.5
    return scale * (numbers @ profile) / jnp.maximum(profile.sum(0), 1)


def _in_order(palette: Palette) -> tuple[tuple[int, int, int], ...]:
    return palette.opponent, palette.own, palette.ball


def empty_screen(state: PongState, palette: Palette) -> jax.Array:
    """Walls and points, uint8 ``[210, 160, 3]``."""
    screen = blank((ABOVE + FIELD + BELOW, FIELD, 3), palette)
    wall = jnp.array(palette.ball, jnp.uint8)
    screen = screen.at[ABOVE - WALL : ABOVE].set(wall).at[-BELOW:].set(wall)
    digits = jnp.array(_DIGITS)
    height, width = _DIGITS.shape[1:]
    names = (palette.opponent, palette.own)
    for points, column, colour in zip(state.score, DIGIT_COLUMNS, names, strict=True):
        for place, digit, shown in ((0, points // 10, points >= 10), (1, points % 10, True)):
            left = column + place * (width + 4)
            area = screen[1 : 1 + height, left : left + width]
            lit = digits[digit][..., None] & shown
            screen = screen.at[1 : 1 + height, left : left + width].set(
                jnp.where(lit, jnp.array(colour, jnp.uint8), area)
            )
    return screen
