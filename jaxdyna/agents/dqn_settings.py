"""What `jaxdyna.agents.dqn` is told."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import optax
from flax import struct


@struct.dataclass
class DQNHParams:
    """What can be swept.

    Attributes:
        learning_rate: of the optimiser.
        discount: of the returns.
        epsilon_first: share of exploratory actions in the first real episodes.
        epsilon_last: likewise in the end; linear between.
        epsilon_hold: real episodes for which it stays at the first.
        epsilon_episodes: real episodes in which it then falls to the last.
        epsilon_fake: share of exploratory actions in dreams.
        fake_share: share of each batch that is drawn from fake transitions, once there are any.
        target_rate: how far the target network moves towards the online one at a time.
        priority_exponent: of a transition's TD error in how often it is drawn; 0 for uniform draws.
        importance_exponent: how far the loss makes up for that: 0 not at all, 1 wholly.
        reward_scale: times every reward; it decides where Huber's loss turns linear.
    """

    learning_rate: float = 1e-3
    discount: float = 0.95
    epsilon_first: float = 1.0
    epsilon_last: float = 0.0
    epsilon_hold: float = 0.0
    epsilon_episodes: float = 20.0
    epsilon_fake: float = 0.3
    fake_share: float = 0.5
    target_rate: float = 0.005
    priority_exponent: float = 0.6
    importance_exponent: float = 0.4
    reward_scale: float = 1.0


@dataclass(frozen=True)
class DQNConfig:
    """What decides the program.

    Attributes:
        network: a module from frames ``[N, H, W, C]`` in [0, 1] to values ``[N, actions]``; None
            for `jaxdyna.networks.GlimpseQ`.
        updates: gradient steps after each call of ``update``.
        fake_updates: likewise of ``update_fake``.
        batch: transitions a gradient step.
        n_step: rewards in a target before it is bootstrapped. From 2 on nothing corrects for what
            the policy of old would have done otherwise.
        double: choose the next action by the online network instead of the target network.
        target_period: gradient steps between moves of the target network; with a ``target_rate``
            of 1 it is copied every so often, as by Mnih et al.
        act_by_target: act by the target network. Under Polyak averaging that is a mean of the last
            networks, which falls into the noise of single gradient steps less often.
        capacity: real transitions kept.
        episodes: real episodes kept.
        fake_capacity: fake transitions kept.
        fake_episodes: fake episodes kept.
        drift: standard deviation of the log odds of exploratory actions in real episodes, drawn
            anew after every update: an exploring episode keeps its direction, as a random walk does
            not. 0 for a random walk. Dreams explore without.
        explore_until_rewarded: let exploration stay at its first share for as long as no real step
            has brought a reward above 0. A learner that has met nothing but punishment by the time
            exploration ends learns to stay away from everything, and never finds out.
        optimizer: from a learning rate to an optax transformation.
    """

    network: Any = None
    updates: int = 200
    fake_updates: int = 200
    batch: int = 32
    n_step: int = 1
    double: bool = True
    target_period: int = 1
    act_by_target: bool = True
    capacity: int = 200_000
    episodes: int = 2_000
    fake_capacity: int = 20_000
    fake_episodes: int = 4_000
    drift: float = 1.0
    explore_until_rewarded: bool = False
    optimizer: Callable[[Any], optax.GradientTransformation] = optax.adam

    def __post_init__(self) -> None:
        sizes = ("capacity", "episodes", "fake_capacity", "fake_episodes")
        for name in ("batch", "n_step", "target_period", *sizes):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}: it must be at least 1")
        for name in ("updates", "fake_updates", "drift"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} is {getattr(self, name)}: it must be 0 or more")
