"""What `jaxdyna.agents.dqn` is told."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import optax
from flax import struct

from jaxdyna.fields import SettingError, check, setting
from jaxdyna.optimizers import Optimizer, optimizer_setting


@struct.dataclass
class DQNHParams:
    """What can be swept."""

    learning_rate: float = setting(
        1e-3, "Learning rate of the values' optimiser.", at_least=0, everyday=True
    )
    discount: float = setting(0.95, "Discount of returns.", at_least=0, at_most=1, everyday=True)
    epsilon_first: float = setting(
        1.0, "Share of exploratory actions in the first real episodes.", at_least=0, at_most=1
    )
    epsilon_last: float = setting(
        0.0, "Share of exploratory actions at last; linear between.", at_least=0, at_most=1
    )
    epsilon_hold: float = setting(
        0.0, "Real episodes for which the share of exploratory actions stays at the first.",
        at_least=0, everyday=True)  # fmt: skip
    epsilon_episodes: float = setting(20.0, "Real episodes in which it then falls.", at_least=0)
    epsilon_fake: float | None = setting(
        0.3, "Share of exploratory actions in dreams; None: as in real episodes.", at_least=0,
        at_most=1)  # fmt: skip
    fake_share: float | None = setting(
        0.5, "Share of each batch that is drawn from fake transitions, once there are any; None: "
        "as large as their share of all that are kept, as if in one replay.",
        at_least=0, at_most=1)  # fmt: skip
    target_rate: float = setting(
        0.005, "How far the target network moves towards the online one at a time.", at_least=0,
        at_most=1)  # fmt: skip
    priority_exponent: float = setting(
        0.6, "Exponent of a transition's TD error in how often it is drawn; 0 for uniform draws.",
        at_least=0, at_most=1)  # fmt: skip
    importance_exponent: float = setting(
        0.4, "How far the loss makes up for that: 0 not at all, 1 wholly.", at_least=0, at_most=1
    )
    reward_scale: float = setting(
        1.0, "Times every reward; it decides where Huber's loss turns linear.", above=0
    )


@dataclass(frozen=True)
class DQNConfig:
    """What decides the program."""

    network: Any = setting(
        None,
        "A module from frames [N, H, W, C] in [0, 1], or vectors [N, n], to values [N, actions]; "
        "None for jaxdyna.networks.GlimpseQ, or PerceptronQ.",
    )
    updates: int = setting(
        200, "Gradient steps of the agent after each real episode.", at_least=0, everyday=True
    )
    fake_updates: int = setting(
        200, "Gradient steps of the agent after a batch of dreams.", at_least=0, everyday=True
    )
    updates_per_step: float = setting(
        0.0, "Gradient steps of the agent for each step of a real episode, rounded, beside the "
        "updates after it: a ratio that holds where episodes differ in length.", at_least=0,
        at_most=1000)  # fmt: skip
    reset_every: int = setting(
        0, "Gradient steps after which both networks and the optimiser begin anew, before the next "
        "ones; what is replayed stays (Nikishin et al. 2022; D'Oro et al. 2023). 0 never.",
        at_least=0)  # fmt: skip
    batch: int = setting(
        32, "Transitions in a gradient step of the agent.", at_least=1, at_most=1_000_000,
        everyday=True)  # fmt: skip
    n_step: int = setting(
        1, "Rewards in a target before it is bootstrapped. From 2 on nothing corrects for what the "
        "policy of old would have done otherwise.", at_least=1)  # fmt: skip
    double: bool = setting(
        True, "Choose the next action by the online network instead of the target network."
    )
    loss: Callable[[Any], Any] = setting(
        optax.huber_loss, "Loss of a TD error: Huber's is linear beyond 1 (Mnih et al. 2015).",
        choices=(optax.huber_loss, optax.l2_loss))  # fmt: skip
    target_period: int = setting(
        1,
        "Gradient steps between moves of the target network; with a target_rate of 1 it is copied "
        "every so often, as by Mnih et al. 2015.", at_least=1)  # fmt: skip
    act_by_target: bool = setting(
        True,
        "Act by the target network. Under Polyak averaging that is a mean of the last networks, "
        "which falls into the noise of single gradient steps less often.",
    )
    capacity: int = setting(200_000, "Real transitions kept.", at_least=1)
    episodes: int = setting(2_000, "Real episodes kept.", at_least=1)
    fake_capacity: int = setting(20_000, "Fake transitions kept.", at_least=1)
    fake_episodes: int = setting(4_000, "Fake episodes kept.", at_least=1)
    drift: float = setting(
        1.0,
        "Standard deviation of the log odds of exploratory actions in real episodes, drawn anew "
        "after every update: an exploring episode keeps its direction, as a random walk does not. "
        "0 for a random walk. Dreams explore without.", at_least=0)  # fmt: skip
    explore_until_rewarded: bool = setting(
        False,
        "Let exploration stay at its first share for as long as no real step has brought a reward "
        "above 0. A learner that has met nothing but punishment by the time exploration ends "
        "learns to stay away from everything, and never finds out.",
    )
    optimizer: Optimizer = optimizer_setting(optax.adam)

    def __post_init__(self) -> None:
        check(self)
        if self.n_step > self.capacity:
            said = (
                f"is {self.n_step}, and the capacity {self.capacity} steps: raise this or lower it"
            )
            raise SettingError("n_step", said)
