"""What a run of `jaxdyna.dyna` is told: counts that decide the program, values to be swept."""

from dataclasses import dataclass
from typing import Any

from flax import struct

from jaxdyna.fields import SettingError, check, setting
from jaxdyna.models.environment import DreamHParams


@dataclass(frozen=True)
class DynaConfig:
    """Counts and sizes: whatever decides the program."""

    num_episodes: int = setting(1000, "Real episodes in all.", at_least=1)
    num_real_first: int = setting(
        100, "N of the paper (§3.1.2): the first dream follows the N-th real episode (0 is as 1).",
        at_least=0, everyday=True)  # fmt: skip
    num_steps: int = setting(200, "The longest real episode, in steps.", at_least=1)
    model_updates: int = setting(
        10, "Gradient steps of the model after each real episode.", at_least=0, everyday=True
    )
    model_batch: int = setting(
        64, "Transitions in a gradient step of the model.", at_least=1, everyday=True
    )
    dream_updates: int = setting(
        1, "Policy updates on dreams after each real episode.", at_least=0, everyday=True
    )
    dream_episodes: int = setting(2, "Fake episodes in each of them.", at_least=1, everyday=True)
    dream_steps: int | None = setting(
        None, "The longest fake episode, in steps; None for as long as a real one.", at_least=1,
        everyday=True)  # fmt: skip
    eval_every: int = setting(
        0, "Real episodes between evaluations of the policy as it then is, greedy, in new episodes "
        "that nothing is learned of; 0 never, nor where an expert acts for good.", at_least=0,
    )  # fmt: skip
    eval_episodes: int = setting(100, "Episodes of an evaluation.", at_least=1)
    replay_capacity: int | None = setting(
        None,
        "Newest real transitions that model and dreams know, at least one episode; None: all, or "
        "those in the agent's own replay where it has one that serves.",
    )
    rare_share: float | None = setting(
        None,
        "At least this share of each model batch comes from rare transitions, those that ended an "
        "episode or what else jaxdyna.dyna.Dyna.memory takes for rare; None draws all alike.",
        at_least=0, at_most=1)  # fmt: skip

    def __post_init__(self) -> None:
        check(self)
        if self.replay_capacity is not None and self.replay_capacity < self.num_steps:
            said = f"is {self.replay_capacity}: give at least one episode of {self.num_steps} steps"
            raise SettingError("replay_capacity", said)


@struct.dataclass
class DynaHParams:
    """Everything that can be swept without compiling again."""

    agent: Any = setting(help="The agent's.")
    model: Any = setting(help="The model's.")
    env: Any = setting(help="The real environment's params.")
    dream: Any = setting(factory=DreamHParams, help="The dream's own.")
    model_trains: bool = setting(
        True, "False computes the model's updates and discards them (the placebo)."
    )
    real_weight: float = setting(
        1.0, "Weight of real transitions in the policy's update once dreams have begun.", at_least=0
    )
    fake_weight: float = setting(
        1.0, "Weight of fake transitions in the policy's update; 0 is the model-free arm.",
        at_least=0)  # fmt: skip
    num_real_first: int = setting(
        0, "Masks out dreams before this many real episodes, where that is more than the "
        "configuration's (which also saves their computation).", at_least=0)  # fmt: skip
