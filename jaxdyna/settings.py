"""What a run of `jaxdyna.dyna` is told: counts that decide the program, values to be swept."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from flax import struct


@dataclass(frozen=True)
class DynaConfig:
    """Counts and sizes: whatever decides the program.

    Attributes:
        num_episodes: real episodes in all.
        num_real_first: N of §3.1.2: the first dream follows the N-th real episode (0 is as 1).
        num_steps: the longest episode in steps.
        model_updates: gradient steps of the model after each real episode.
        model_batch: transitions a gradient step.
        dream_updates: policy updates on dreams after each real episode.
        dream_episodes: fake episodes in each of those updates.
        dream_steps: the longest fake episode in steps; None for ``num_steps``.
        replay_capacity: transitions kept; None keeps all.
        forget_every: real episodes after which the replay is emptied, as the authors' code does;
            0 never.
        rare_share: at least this share of each model batch comes from rare transitions, those that
            ended an episode or what else `jaxdyna.dyna.Dyna.memory` takes for rare; None draws all
            alike.
        rest_when_safe: for tasks whose end is a failure. Neither train the model nor dream after
            a real episode that was truncated instead of terminated, and stop dreaming after a
            batch of fake episodes of which none terminated: what works is left alone, and costs
            nothing.
    """

    num_episodes: int = 1000
    num_real_first: int = 100
    num_steps: int = 200
    model_updates: int = 10
    model_batch: int = 64
    dream_updates: int = 1
    dream_episodes: int = 2
    dream_steps: int | None = None
    replay_capacity: int | None = None
    forget_every: int = 0
    rare_share: float | None = None
    rest_when_safe: bool = False

    def __post_init__(self) -> None:
        for name in ("num_episodes", "num_steps", "model_batch", "dream_episodes", "dream_steps"):
            if getattr(self, name) is not None and getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}: it must be at least 1")
        for name in ("num_real_first", "model_updates", "dream_updates", "forget_every"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} is {getattr(self, name)}: it must not be negative")
        if self.num_real_first > self.num_episodes:
            raise ValueError(
                f"num_real_first (N) is {self.num_real_first} but there are only "
                f"{self.num_episodes} episodes: lower N or raise the number of episodes"
            )
        if self.rare_share is not None and not 0 <= self.rare_share <= 1:
            raise ValueError(
                f"rare_share is {self.rare_share}: it must lie between 0 and 1, or be None"
            )
        if self.replay_capacity is not None and self.replay_capacity < self.num_steps:
            raise ValueError(
                f"replay_capacity is {self.replay_capacity}: it must hold at least one episode "
                f"of {self.num_steps} steps"
            )


@struct.dataclass
class DynaHParams:
    """Everything that can be swept without compiling again.

    Attributes:
        agent: the agent's.
        model: the model's.
        env: the real environment's params.
        real_weight: weight of real transitions in the policy's update once dreams have begun.
        model_trains: False computes the model's updates and discards them (the placebo).
        fake_weight: weight of fake transitions in the policy's update; 0 is the model-free arm.
        num_real_first: masks out dreams before this many real episodes, where that is more than
            `DynaConfig.num_real_first` (which also saves their computation).
        termination_threshold: see `jaxdyna.models.LearnedParams`.
        disagreement_threshold: likewise.
    """

    agent: Any
    model: Any
    env: Any
    model_trains: bool = True
    real_weight: float = 1.0
    fake_weight: float = 1.0
    num_real_first: int = 0
    termination_threshold: float = 0.5
    disagreement_threshold: float = math.inf
