"""The Atari 2600 game of Pong as a pure function, so that it can be played like any environment.

The whole emulator is the state: a step restores it on the host, plays a few frames and returns what
it has become. So the same state and action give the same outcome, copies are batched by ``vmap``,
episodes by ``lax.scan``; the copies of a batch are played by a thread for each core.
"""

import os
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxdyna.envs.gymnasium import Pictures, atari_emulator, check_atari
from jaxdyna.envs.pong_rules import FIELD, NUM_ACTIONS
from jaxdyna.envs.pong_screen import CHANNELS, Palette, blank, masks_by_colour, paint
from jaxdyna.fields import SettingError, check, setting
from jaxdyna.types import Key, Stepped

EMULATOR_BYTES = 16_384  #: room for a saved emulator, of which Pong takes 14,500
SCREEN = (210, 160, 3)
_here = threading.local()


@struct.dataclass
class AtariParams:
    """What can be swept."""

    max_steps: int = setting(27_000, "Steps until truncation.", at_least=1)
    no_ops: int = setting(
        30,
        "An episode begins with 1 to so many frames of doing nothing (Mnih et al. 2015); 0 counts "
        "as 1.", at_least=0)  # fmt: skip


@struct.dataclass
class AtariState:
    """The saved emulator, uint8 ``[EMULATOR_BYTES]``, and steps taken."""

    emulator: jax.Array
    time: jax.Array


@dataclass(frozen=True)
class AtariPong(Pictures):
    """The real game (Bellemare et al. 2013), without repeated actions; actions and rewards are
    those of `jaxdyna.envs.Pong`, and frames look like its own in the same palette. `ImportError`
    without the ``atari`` extra, `ValueError` where a setting is impossible.
    """

    num_actions: ClassVar = NUM_ACTIONS

    frame_skip: int = setting(4, "Frames a step, all with the same action.", at_least=1)
    scale: int = setting(
        1, "As in jaxdyna.envs.Pong; with 1 the frame is the whole screen in its own colours.",
        at_least=1)  # fmt: skip
    palette: Palette = setting(
        CHANNELS, "The colours of a smaller frame; objects are told by their colours on the screen."
    )

    def __post_init__(self) -> None:
        check_atari()
        check(self)
        if FIELD % self.scale:
            raise SettingError("scale", f"is {self.scale}: it must be a divisor of {FIELD}")

    @property
    def default_params(self) -> AtariParams:
        """Games to 21 points, cut after the 108,000 frames (half an hour) of the literature."""
        return AtariParams(max_steps=108_000 // self.frame_skip)

    @property
    def frame_shape(self) -> tuple[int, int, int]:
        """``(height, width, 3)``."""
        return SCREEN if self.scale == 1 else (FIELD // self.scale, FIELD // self.scale, 3)

    def reset(self, key: Key, params: AtariParams) -> tuple[jax.Array, AtariState]:
        """A new game after some frames of doing nothing: ``obs, state``."""
        waits = jax.random.randint(key, (), 1, jnp.maximum(params.no_ops, 1) + 1)
        nothing = jnp.zeros(EMULATOR_BYTES, jnp.uint8)
        saved, screen, *_ = _on_host(nothing, jnp.int32(0), waits)
        return self._frame(screen), AtariState(saved, jnp.int32(0))

    def step(self, key: Key, state: AtariState, action: jax.Array, params: AtariParams) -> Stepped:
        """``frame_skip`` frames.

        Returns:
            ``obs, state, reward, terminated, truncated, info``: the reward is 1 for a point won and
            -1 for one lost. The emulator too cuts games off, after 108,000 frames with the first.
        """
        saved, screen, reward, over, cut = _on_host(
            state.emulator, jnp.asarray(action, jnp.int32), jnp.int32(self.frame_skip)
        )
        new = replace(state, emulator=saved, time=state.time + 1)
        late = cut | (new.time >= params.max_steps)
        return self._frame(screen), new, reward, over, ~over & late, {}

    def _frame(self, screen: jax.Array) -> jax.Array:
        if self.scale == 1:
            return screen
        below = blank(self.frame_shape, self.palette)
        return paint(below, masks_by_colour(screen, self.scale, Palette()), self.palette)


def _on_host(saved: jax.Array, action: jax.Array, frames: jax.Array) -> Any:
    """``saved, screen, reward, over, cut off`` after so many frames; all zeros is a new game."""
    shapes = (
        jax.ShapeDtypeStruct((EMULATOR_BYTES,), jnp.uint8),
        jax.ShapeDtypeStruct(SCREEN, jnp.uint8),
        jax.ShapeDtypeStruct((), jnp.float32),
        jax.ShapeDtypeStruct((), jnp.bool_),
        jax.ShapeDtypeStruct((), jnp.bool_),
    )
    return jax.pure_callback(_play, shapes, saved, action, frames, vmap_method="broadcast_all")


def _play(saved: Any, action: Any, frames: Any) -> Any:
    """`_on_host` for arrays with any leading axes."""
    saved, action, frames = (np.asarray(leaf) for leaf in (saved, action, frames))
    lead = action.shape
    rows = (saved.reshape(-1, EMULATOR_BYTES), action.reshape(-1), frames.reshape(-1))
    played = list(_threads().map(_play_one, *rows))
    dtypes = (np.uint8, np.uint8, np.float32, np.bool_, np.bool_)
    columns = zip(zip(*played, strict=True), dtypes, strict=True)
    stacks: Any = (np.stack(column).astype(dtype, copy=False) for column, dtype in columns)
    return tuple(stack.reshape((*lead, *stack.shape[1:])) for stack in stacks)


def _play_one(saved: np.ndarray, action: int, frames: int) -> tuple[Any, ...]:
    if not hasattr(_here, "emulator"):
        _here.emulator = atari_emulator("Pong")
        _here.start = _here.emulator.cloneState(include_rng=True)
    ale = _here.emulator
    ale.restoreState(_unpacked(saved, _here.start) if saved.any() else _here.start)
    buttons = ale.getMinimalActionSet()
    reward = sum(ale.act(buttons[int(action)]) for _ in range(int(frames)))
    ends = (ale.game_over(with_truncation=False), ale.game_truncated())
    return _packed(ale.cloneState(include_rng=True)), ale.getScreenRGB(), reward, *ends


def _packed(state: Any) -> np.ndarray:
    """A saved emulator as bytes, how many first; no pickle: a checkpoint's could run any code."""
    data = state.__getstate__()
    if len(data) > EMULATOR_BYTES - 4:
        raise RuntimeError(f"a saved emulator has {len(data)} bytes, room is for {EMULATOR_BYTES}")
    sized = np.uint32(len(data)).tobytes() + data
    return np.frombuffer(sized.ljust(EMULATOR_BYTES, b"\0"), np.uint8)


def _unpacked(room: np.ndarray, like: Any) -> Any:
    size = int(np.frombuffer(room[:4].tobytes(), np.uint32)[0])
    kind: Any = type(like)
    state = kind.__new__(kind)
    state.__setstate__(room[4 : 4 + size].tobytes())
    return state


@cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="atari")
