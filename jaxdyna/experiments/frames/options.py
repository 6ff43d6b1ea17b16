"""Settings that all experiments on frames have."""

from dataclasses import dataclass
from typing import ClassVar

from jaxdyna import fields
from jaxdyna.experiments.engine import Options
from jaxdyna.fields import setting


@dataclass(frozen=True)
class Training(fields.Checked):
    """How a model is trained, from scratch at each stage."""

    updates: int = setting(5000, "gradient steps, however few the episodes", at_least=1)
    updates_per_episode: float = setting(0.0, "gradient steps more for each episode of data",
                                         at_least=0)  # fmt: skip
    batch: int = setting(32, "transitions in a gradient step", at_least=1)
    learning_rate: float = setting(5e-3, "Adam's at the start; it falls to 0 along half a cosine",
                                   above=0)  # fmt: skip
    weight_decay: float = setting(0.0, "of AdamW (Loshchilov and Hutter 2019); 0 is Adam",
                                  at_least=0)  # fmt: skip
    rare_share: float | None = setting(
        0.5, "at least this share of a batch are steps with a reward below or above 0, half each "
        "where there are both; None: as they come", at_least=0, at_most=1)  # fmt: skip
    reward_weight: float = setting(1.0, "of the reward's squared error beside the frame's loss",
                                   at_least=0)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class FrameOptions(Options):
    """What every experiment on frames can be told; ``dream_from`` is the first step of a held-out
    episode from which models dream.
    """

    decided: ClassVar = {"stop_after_solved": "the model's updates"}
    dream_from: ClassVar[int] = 0

    steps: int = setting(200, "steps of an episode", at_least=1, everyday=True)
    stop_after_solved: int | None = setting(None, "nothing is solved")
    held_out: int = setting(20, "new episodes that models are judged on", at_least=1, everyday=True)
    loss_every: int = setting(
        0, "gradient steps from one look at the loss, on new and on old episodes, to the next; 0 "
        "never looks", at_least=0)  # fmt: skip
    horizon: int = setting(50, "steps of an open-loop dream", at_least=1, everyday=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.dream_from + self.horizon > self.steps:
            raise fields.SettingError(
                "horizon", f"is {self.horizon}: {self.dream_from} steps and it, where dreams end, "
                f"must be at most an episode's {self.steps} steps")  # fmt: skip
