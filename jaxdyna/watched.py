"""Worlds that are watched, in films and under the keyboard: the true one, and a dream that begins
where it does, side by side under the same actions.
"""

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import jax
import numpy as np

from jaxdyna.envs import Hosted, HostEnv
from jaxdyna.envs.gymnasium import CannotRenderError
from jaxdyna.types import Environment

#: what is seen of a world, bytes ``[height, width, 3]``, and what is said of its episode
Shot = tuple[np.ndarray, str]


class Side:
    """One world: frames as they are seen, of a stack the newest; of vectors what the world draws,
    and `ValueError` where it draws nothing.
    """

    def __init__(self, env: Any, params: Any, num_frames: int):
        shape = env.observation_space(params).shape
        self.channels = shape[-1] // num_frames
        alone = env.env if num_frames == 1 and hasattr(env, "num_frames") else env
        if len(shape) == 1 and isinstance(alone, Hosted):
            self.host: Any = alone.drawn()
        else:
            self.host = HostEnv(env, params, None if len(shape) == 3 else "rgb_array")

    def begin(self, **how: Any) -> None:
        """An episode, ``how`` being what Gymnasium's ``reset`` takes."""
        self.obs, _ = self.host.reset(**how)
        self.steps, self.earned, self.over = 0, 0.0, False

    def step(self, action: Any) -> None:
        """Goes on, unless the episode is over."""
        if not self.over:
            self.obs, reward, terminated, truncated, _ = self.host.step(action)
            self.steps, self.earned = self.steps + 1, self.earned + float(reward)
            self.over = bool(terminated or truncated)

    def shot(self) -> Shot:
        """As it is now."""
        said = f"step {self.steps}, return {round(self.earned, 1):g}{', over' * self.over}"
        if self.obs.ndim != 3:
            return self.host.render(), said
        newest = self.obs[..., -self.channels :]
        return np.broadcast_to(newest, (*newest.shape[:2], 3)), said


class Scene:
    """The true world and a dream of it, ``sides`` by name: where there is a learned one, of a world
    that is seen as frames, or whose vectors say which state is seen so (``state_of``).
    """

    def __init__(self, env: Environment, params: Any, dream: Any = None, dream_params: Any = None):
        self.num_frames = getattr(env, "num_frames", 1)
        self.sides = {"true": Side(env, params, self.num_frames)}
        if hasattr(dream, "state_of"):
            with suppress(CannotRenderError):
                self.sides["dreamed"] = Side(dream, dream_params, self.num_frames)

    def begin(self, seed: int) -> None:
        """An episode: the same for the same seed."""
        self.sides["true"].begin(seed=seed)
        self.dream()

    def dream(self) -> None:
        """The dream begins anew where the true world is."""
        if "dreamed" in self.sides:
            self.sides["dreamed"].begin(options={"obs": self.sides["true"].obs})

    def step(self, action: Any) -> None:
        """The same on all sides."""
        for side in self.sides.values():
            side.step(action)

    def shots(self) -> dict[str, Shot]:
        """All sides as they are now."""
        return {name: side.shot() for name, side in self.sides.items()}

    def played(self, act: Callable[..., Any], seed: int, steps: int) -> list[dict[str, Shot]]:
        """The shots of an episode, of so many steps at the most, in which ``(obs, key) -> action``
        sees the true world. The dream begins once a stack of frames is full: an episode's first one
        is a frame repeated, of which nobody can tell what moves where.
        """
        self.begin(seed)
        key, shots = jax.random.key(seed), [self.shots()]
        while not self.sides["true"].over and len(shots) <= steps:
            key, key_act = jax.random.split(key)
            self.step(np.asarray(act(self.sides["true"].obs, key_act)))
            if len(shots) < self.num_frames:
                self.dream()
            shots.append(self.shots())
        return shots
