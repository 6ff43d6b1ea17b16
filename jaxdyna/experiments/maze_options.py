"""The settings of frame prediction in the Maze: its command line and what its models are."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal

import optax

from jaxdyna.envs import FrameStack, Maze, MazeParams
from jaxdyna.experiments import cli
from jaxdyna.losses import bce, l1, l2
from jaxdyna.models import PixelConfig
from jaxdyna.networks import EncoderDecoder, JointReward, LocalDynamics, LocalReward

DREAM_FROM = 10
"""Step of a held-out episode from which models dream."""

ModelName = Literal[
    "paper", "paper_l2", "paper_l1", "paper_reward", "lean", "lean_l2", "lean_l1"
]  # fmt: skip


@dataclass(frozen=True)
class Training:
    """How a model is trained on what is in its replay, from scratch at each stage."""

    updates: int = 5000
    """Gradient steps, however few the episodes."""
    updates_per_episode: float = 0.0
    """As many more for each episode of data."""
    batch: int = 32
    """Transitions in each."""
    learning_rate: float = 5e-3
    """Adam's at the start; it falls to 0 along half a cosine within the updates."""
    weight_decay: float = 0.0
    """Of AdamW (Loshchilov and Hutter 2019); 0 is Adam."""
    rare_share: float | None = 0.5
    """At least this share of each batch are collisions and goal steps, where there are any: half
    each, where there are both; None: as they come."""
    reward_weight: float = 1.0
    """Weight of the reward's squared error beside the frame's loss."""

    def updates_at(self, episodes: int) -> int:
        """Gradient steps on so many episodes."""
        return self.updates + round(self.updates_per_episode * episodes)

    def __post_init__(self) -> None:
        if self.updates < 1 or self.batch < 1:
            raise ValueError(f"{self.updates} updates of {self.batch}: both must be at least 1")
        if not 0 <= self.updates_per_episode < float("inf"):
            raise ValueError(f"updates_per_episode is {self.updates_per_episode}: give 0 or more")
        if not 0 < self.learning_rate < float("inf"):
            raise ValueError(f"the learning rate is {self.learning_rate}: it must be above 0")
        if not 0 <= self.weight_decay < float("inf"):
            raise ValueError(f"weight_decay is {self.weight_decay}: it must be 0 or more")
        if not 0 <= self.reward_weight < float("inf"):
            raise ValueError(f"reward_weight is {self.reward_weight}: it must be 0 or more")
        if self.rare_share is not None and not 0 <= self.rare_share <= 1:
            raise ValueError(f"rare_share is {self.rare_share}: it must lie in [0, 1], or be None")


@dataclass(frozen=True)
class Options:
    """Action-conditional frame prediction in the Maze: the paper's F1 table and Fig. 7."""

    part: Literal["train", "model"] = "model"
    """model: frame prediction from a random policy's episodes; train: learning to act (a command
    line of its own)."""
    preset: Literal["paper", "lean"] = "paper"
    """Which arms are played by default: paper, the paper's model beside ours; lean, ours alone."""
    quick: bool = False
    """A look at everything in minutes: fewer seeds, episodes and updates, narrower networks; under
    paper with its other losses beside it."""
    seeds: int = 10
    """Runs of every arm, all in one jitted program."""
    seed: int = 0
    """Base seed of all runs."""
    episodes: int = 300
    """Episodes of the random policy at the most."""
    stages: tuple[int, ...] = (10, 30, 100, 300)
    """After how many of them a model is trained, from scratch, and judged; those above --episodes
    are left out."""
    ablation_stage: int = 100
    """The stage at which losses are compared, the only one of models with another loss."""
    arms: tuple[ModelName, ...] = ("paper", "lean")
    """paper: Fig. 4 with the multi-label cross-entropy; lean: convolutions throughout; with _l1 and
    _l2 the same network under another loss, to compare losses and thresholds; with _reward Fig. 4
    and a reward head."""
    out: Path | None = None
    """Folder for the results; runs/maze-model by default."""
    resume: bool = False
    """Go on with the run in that folder: stages that are finished are not repeated."""
    widths: tuple[int, ...] = (32, 32, 32)
    """Channels of the paper's three convolutions; the authors' code has 128 in each."""
    kernels: tuple[int, ...] = (5, 4, 4)
    """Cells a side of their kernels."""
    dense: int = 1024
    """Width of the paper's dense layer."""
    lean_widths: tuple[int, ...] = (32, 32, 32)
    """Channels of our 3x3 convolutions."""
    reward: Literal["own", "joint", "local", "none"] = "own"
    """Reward head: joint, off the features of stack and action; local, a sum over cells of the
    predicted frame; none; own: none for the paper's models but paper_reward, whose is joint; local
    for ours."""
    size: int = 16
    """Cells a side of the maze."""
    obstacles: int = 5
    """How many there are."""
    collision_reward: float = -5.0
    """Earned on a step that ends on an obstacle's cell."""
    goal_reward: float = 1.0
    """Earned on a step that ends on the goal."""
    steps: int = 200
    """Steps of an episode."""
    held_out: int = 20
    """New episodes that models are judged on."""
    horizon: int = 50
    """Steps of an open-loop dream."""
    paper: Training = field(default_factory=lambda: Training(8000, 40, 32, 3e-3, 0.4, None))
    """Training of the paper's model."""
    lean: Training = field(default_factory=Training)
    """Training of ours."""

    def __post_init__(self) -> None:
        cli.check_common(self)
        if not self.arms:
            raise ValueError("--arms is empty: name at least one model")
        if min(self.stages, default=0) < 1 or self.ablation_stage < 1:
            raise ValueError("--stages and --ablation-stage: give numbers of episodes, at least 1")
        if not self.played_stages:
            raise ValueError(
                f"--episodes is {self.episodes}, less than the first of --stages: raise it"
            )
        for name in ("collision_reward", "goal_reward"):
            if not math.isfinite(getattr(self, name)):
                raise ValueError(f"--{name.replace('_', '-')} must be a finite number")
        if len(self.widths) != 3 or len(self.kernels) != 3 or min(self.widths) < 1:
            raise ValueError("--widths and --kernels: give three numbers each, at least 1")
        papers = any(arm.startswith("paper") for arm in self.arms)
        if papers and (min(self.kernels) < 1 or sum(self.kernels) - 3 >= self.size):
            raise ValueError(
                f"--kernels {self.kernels} leave nothing of a maze of {self.size} cells a side: "
                "give smaller ones, or a larger --size"
            )
        if min(self.lean_widths, default=0) < 1 or self.dense < 1:
            raise ValueError("--lean-widths and --dense: give numbers of at least 1")
        if self.held_out < 1 or self.horizon < 1 or DREAM_FROM + self.horizon > self.steps:
            raise ValueError(
                f"--held-out and --horizon must be at least 1, and {DREAM_FROM} + --horizon, where "
                "dreams end, at most --steps"
            )
        world(self)

    @property
    def played_stages(self) -> tuple[int, ...]:
        """The stages within ``episodes``, in order."""
        return tuple(sorted({stage for stage in self.stages if stage <= self.episodes}))

    def stages_of(self, arm: str) -> tuple[int, ...]:
        """All of them, or for a model with another loss the one nearest ``ablation_stage``."""
        if arm in ("paper", "lean"):
            return self.played_stages
        return (min(self.played_stages, key=lambda stage: abs(stage - self.ablation_stage)),)


def world(options: Options) -> tuple[FrameStack, MazeParams]:
    """The maze, seen as stacked frames, and its params."""
    params = MazeParams(options.collision_reward, options.goal_reward, options.steps)
    return FrameStack(Maze(options.size, options.obstacles)), params


PAPER = Options()
LEAN = Options(preset="lean", arms=("lean",))
PRESETS = {"paper": PAPER, "lean": LEAN}
_FEW: dict[str, Any] = {
    "seeds": 2,
    "episodes": 100,
    "held_out": 5,
    "widths": (8, 8, 8),
    "dense": 128,
    "lean_widths": (32, 32),
    "paper": Training(300, 0, 32, 3e-3, 0.2, None),
    "lean": Training(500, 0, 32, 1e-2),
}
QUICK = {
    "paper": replace(PAPER, **_FEW, arms=("paper", "paper_l2", "paper_l1", "lean")),
    "lean": replace(LEAN, **_FEW),
}


def training_of(options: Options, arm: str) -> Training:
    """How this arm is trained."""
    return options.paper if arm.startswith("paper") else options.lean


def config_of(options: Options, arm: str) -> PixelConfig:
    """The model of this arm. The paper's threshold of 0.2 serves its cross-entropy; 0.5 serves
    ours, and L1 and L2, whose outputs are no probabilities.
    """
    loss = {"l1": l1, "l2": l2}.get(arm.partition("_")[2], bce)
    training = training_of(options, arm)
    optimizer = decayed_adam(training.weight_decay)
    weight = training.reward_weight
    own = {"paper_reward": "joint"}.get(arm, "none" if arm.startswith("paper") else "local")
    head = {"joint": JointReward(), "local": LocalReward(), "none": None}[
        own if options.reward == "own" else options.reward
    ]
    if arm.startswith("paper"):
        coder = EncoderDecoder(3, tuple(options.widths), tuple(options.kernels), options.dense)
        threshold = 0.2 if loss is bce else 0.5
        return PixelConfig(coder, loss, threshold, head, weight, optimizer=optimizer)
    local = LocalDynamics(3, tuple(options.lean_widths))
    return PixelConfig(local, loss, 0.5, head, weight, optimizer=optimizer)


@cache
def decayed_adam(weight_decay: float, b1: float = 0.9) -> Any:
    """AdamW: one object, and so one program, for the same settings."""
    return partial(optax.adamw, b1=b1, weight_decay=weight_decay)
