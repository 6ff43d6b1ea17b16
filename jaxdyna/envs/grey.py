"""Small grey frames, the form in which most of the literature sees Atari games."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna.envs.gymnasium import spaces
from jaxdyna.fields import SettingError, check, setting
from jaxdyna.types import Environment, Key

LUMINANCE = np.array([0.299, 0.587, 0.114], np.float32)
"""Of red, green and blue (ITU-R BT.601)."""


@dataclass(frozen=True)
class GreyFrames:
    """An environment whose coloured frames are seen as luminance, 84x84 (Mnih et al. 2015): each
    new pixel is the mean of the area that it covers. Frames are not maximised over two, since no
    game here flickers.
    """

    env: Environment = setting(
        help="Observes frames [H, W, 3], uint8; jaxdyna.envs.Pong and AtariPong with a scale of 1 "
        "show the whole screen."
    )
    size: int = setting(84, "Pixels a side, at most as many as the frames have.", at_least=1)

    def __post_init__(self) -> None:
        check(self)
        shape = self.env.observation_space(self.env.default_params).shape
        if len(shape) != 3 or shape[2] != 3:
            raise ValueError(
                f"{type(self.env).__name__} observes arrays of shape {shape}: give an environment "
                "that observes coloured pictures [height, width, 3]"
            )
        if self.size > min(shape[:2]):
            raise SettingError(
                "size", f"is {self.size}: frames of {shape[:2]} can only be made smaller"
            )

    @property
    def default_params(self) -> Any:
        """The environment's."""
        return self.env.default_params

    @property
    def num_actions(self) -> int:
        """The environment's."""
        return self.env.num_actions

    @property
    def frame_shape(self) -> tuple[int, int, int]:
        """``(size, size, 1)``."""
        return self.size, self.size, 1

    def reset(self, key: Key, params: Any) -> tuple[jax.Array, Any]:
        """Starts an episode."""
        frame, state = self.env.reset(key, params)
        return grey(frame, self.size), state

    def step(
        self, key: Key, state: Any, action: jax.Array, params: Any
    ) -> tuple[jax.Array, Any, jax.Array, jax.Array, jax.Array, dict[str, Any]]:
        """One step of the environment."""
        frame, *rest = self.env.step(key, state, action, params)
        return grey(frame, self.size), *rest  # type: ignore[return-value]

    def render(self, state: Any, params: Any) -> jax.Array:
        """The environment's."""
        return self.env.render(state, params)  # type: ignore[attr-defined]

    def observation_space(self, params: Any) -> spaces.Box:
        """Bytes."""
        del params
        return spaces.Box(0, 255, self.frame_shape, np.uint8)

    def action_space(self, params: Any) -> Any:
        """The environment's."""
        return self.env.action_space(params)


def grey(frame: jax.Array, size: int) -> jax.Array:
    """Luminance of frames, uint8 ``[..., H, W, 3]``, in mean over areas: uint8 ``[..., size, size,
    1]``.
    """
    height, width = frame.shape[-3:-1]
    rows, columns = (jnp.array(_overlaps(length, size)) for length in (height, width))
    light = frame.astype(jnp.float32) @ LUMINANCE
    return jnp.round(rows @ light @ columns.T)[..., None].astype(jnp.uint8)


def _overlaps(length: int, size: int) -> np.ndarray:
    """How much of each of ``size`` equal parts of a line lies in each of its ``length`` cells,
    ``[size, length]``; rows sum to one.
    """
    begins = np.arange(size)[:, None] * length / size
    cells = np.arange(length)[None]
    shared = np.minimum(begins + length / size, cells + 1) - np.maximum(begins, cells)
    return (np.maximum(shared, 0) * size / length).astype(np.float32)
