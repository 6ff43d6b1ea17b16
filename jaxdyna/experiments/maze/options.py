"""The settings of learning to act."""

from dataclasses import dataclass
from typing import ClassVar, Literal, Self

import optax

from jaxdyna.agents import CloningConfig, DQNConfig, DQNHParams
from jaxdyna.agents.cloning import margin_loss
from jaxdyna.dyna import DynaConfig, DynaHParams
from jaxdyna.envs import MazeParams
from jaxdyna.experiments.engine import Options, Overrides
from jaxdyna.experiments.maze.frames import TUNED as FRAMES
from jaxdyna.fields import LARGEST, SettingError, changed, setting
from jaxdyna.models import PixelHParams
from jaxdyna.planners import SearchConfig, ShootingConfig
from jaxdyna.statistics import SolveRule

EVERY_ACTION = "MuZero's search, which looks at every action"
RULE = SolveRule(50, 0.95, "optimal_return")


@dataclass(frozen=True, kw_only=True)
class MazeOptions(Options):
    """DQN in the Maze, with and without fake episodes from a learned model."""

    decided: ClassVar = {
        "dyna.num_episodes": "--episodes", "dyna.num_steps": "--steps",
        "hparams.env.max_steps": "--steps", "agent.network": "--network",
        "mpc.discount": "--hparams.agent.discount", "mcts.discount": "--hparams.agent.discount",
        "mcts.considered": EVERY_ACTION, "mcts.gumbel_scale": EVERY_ACTION,
        "cloning.capacity": "--shown-episodes",
        "cloning.updates": "--agent.fake-updates, since it makes as many as dyna on dreams",
    }  # fmt: skip
    world_settings: ClassVar = ("hparams.env", "size", "obstacles")

    size: int = setting(16, "cells a side of the board", at_least=2, at_most=1000, everyday=True)
    obstacles: int = setting(5, "how many obstacles", at_least=0, everyday=True)
    steps: int = setting(200, "steps of a real episode", at_least=1, everyday=True)
    network: Literal["convolutions", "glimpse", "plain"] = setting(
        "convolutions", "network of the agent, the same in all arms: three convolutions and a "
        "dense layer; what is around the places of a few things, at first one of each colour; or "
        "the convolutions and the dense layer of the paper's authors", everyday=True)  # fmt: skip
    convolutions: tuple[int, int, int] = setting(
        (16, 16, 32), "channels of the network's convolutions: one of 2x2 cells at a stride of 2, "
        "two of 3x3; of the plain network all of 3x3", at_least=1)  # fmt: skip
    dense: int = setting(128, "width of the dense layer after the convolutions", at_least=1)
    model: Literal["local", "paper"] = setting(
        "local", "network of the model: 3x3 convolutions, or Fig. 4, slower and to be trained for "
        "much longer", everyday=True)  # fmt: skip
    model_widths: tuple[int, ...] = setting((32, 32), "channels of the local model's convolutions",
                                            at_least=1)  # fmt: skip
    coder_widths: tuple[int, int, int] = setting(FRAMES.widths, "channels of Fig. 4's convolutions",
                                                 at_least=1)  # fmt: skip
    coder_kernels: tuple[int, int, int] = setting(
        FRAMES.kernels, "cells a side of their kernels", at_least=1
    )
    coder_dense: int = setting(FRAMES.dense, "width of Fig. 4's dense layer", at_least=1)
    coder_decay: float = setting(
        FRAMES.paper.weight_decay, "weight decay of Fig. 4 (Loshchilov and Hutter 2019); 0 is Adam",
        at_least=0)  # fmt: skip
    model_loss: Literal["bce", "l2", "l1"] = setting("bce", "loss of the model's pixels")
    model_reward: Literal["picture", "classes"] = setting(
        "picture", "how the model predicts the reward: as a sum over the cells of the picture that "
        "it predicts, or as one of three classes, off the features under it", everyday=True,
    )  # fmt: skip
    reward_hidden: tuple[int, ...] = setting(
        (512, 256), "widths of the hidden layers of the classes' head", at_least=1
    )
    reward_weights: tuple[float, float, float] = setting(
        (1.0, 1.0, 1.0), "weights of the three classes, collision, neither and goal, in its loss",
        at_least=0)  # fmt: skip
    reward_weight: float = setting(
        1.0, "weight of the reward's loss beside the summed one of the pixels", at_least=0
    )
    dream_start: Literal["branched", "observed"] = setting(
        "branched", "where dreams begin: any frames of a real episode, or its first", everyday=True
    )
    judged_on: Literal["own", "common"] = setting(
        "own", "what a model is judged on: each real episode before it is trained on it, or the "
        "same transitions for all models")  # fmt: skip
    shown_episodes: int = setting(
        10, "real episodes after the first N in which mpc_init is shown what to do", at_least=1
    )
    dyna: DynaConfig = setting(factory=lambda: DynaConfig(
        num_episodes=LARGEST, num_steps=1,  # until they are decided, in nobody's way
        model_updates=50, model_batch=32, rare_share=0.25, dream_episodes=400, dream_steps=5,
        eval_every=10, eval_episodes=20))  # fmt: skip
    agent: DQNConfig = setting(factory=lambda: DQNConfig(
        updates=50, fake_updates=400, fake_capacity=64_000, explore_until_rewarded=True,
    ))  # fmt: skip
    hparams: DynaHParams = setting(factory=lambda: DynaHParams(
        DQNHParams(epsilon_hold=30.0, target_rate=0.02), PixelHParams(3e-3), MazeParams(),
    ))  # fmt: skip
    mpc: ShootingConfig = setting(factory=lambda: ShootingConfig(5, 32, drift=1.0))
    mcts: SearchConfig = setting(factory=lambda: SearchConfig(simulations=32))
    cloning: CloningConfig = setting(
        factory=lambda: CloningConfig(learning_rate=1e-3, loss=margin_loss, learns_too=True)
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        way, free = 2 * self.size - 2, self.size**2 - 2
        if self.steps <= way:
            raise SettingError("steps", f"is {self.steps}: the goal is {way} steps away, give more")
        if self.obstacles > free:
            raise SettingError("obstacles", f"is {self.obstacles}: there are {free} free cells")
        least = {"network": 7 if self.network == "plain" else 0,
                 "model": sum(self.coder_kernels) - 2 if self.model == "paper" else 0}  # fmt: skip
        for name, cells in least.items():
            if self.size < cells:
                chosen = getattr(self, name)
                raise SettingError(
                    "size", f"is {self.size}: --{name} {chosen} needs a larger one, {cells} at "
                    "least, or choose another")  # fmt: skip

    def resolved(self) -> Self:
        """Episodes are so many steps; planners discount as the agent does."""
        steps, discount = self.steps, self.hparams.agent.discount
        updates = self.agent.fake_updates * self.dyna.dream_updates
        return changed(self, {
            "dyna.num_episodes": self.episodes, "dyna.num_steps": steps,
            "dyna.dream_steps": min(self.dyna.dream_steps or steps, steps),
            "hparams.env.max_steps": steps, "cloning.capacity": self.shown_episodes * steps,
            "cloning.updates": min(max(updates, 1), LARGEST),
            "mpc.discount": discount, "mcts.discount": discount})  # fmt: skip


def rule(options: MazeOptions) -> SolveRule:
    """When a run counts as solved."""
    return RULE


TUNED = MazeOptions(arms=("model_free", "dyna"), episodes=500, stop_after_solved=0)
LEAN = changed(TUNED, {
    "preset": "lean", "network": "glimpse", "episodes": 150, "stop_after_solved": 50,
    "dyna.num_real_first": 5, "dyna.model_updates": 300, "dyna.dream_updates": 2,
    "agent.updates": 100, "agent.fake_capacity": 8000,
    "hparams.agent": DQNHParams(epsilon_hold=5.0, epsilon_episodes=2.0)})  # fmt: skip
#: as literally as the paper can be read; where it is silent its authors' code decides, line by line
#: in ``docs/paper-method.md``. Widths are what two cores can carry.
PAPER = changed(TUNED, {
    "preset": "paper", "episodes": 800, "network": "plain", "convolutions": (8, 16, 16),
    "dense": 128, "model": "paper", "coder_widths": (32, 32, 32), "coder_dense": 256,
    "coder_decay": 0.0, "model_reward": "classes", "reward_hidden": (128, 64),
    "reward_weights": (1.0, 0.1, 1.0), "dream_start": "observed",
    "dyna.model_updates": 64, "dyna.rare_share": None, "dyna.dream_updates": 2,
    "dyna.dream_episodes": 1, "dyna.dream_steps": None,
    "agent": DQNConfig(
        updates=200, fake_updates=200, double=False, act_by_target=False, drift=0.0,
        loss=optax.l2_loss, fake_capacity=200_000,
    ),
    "hparams.agent": DQNHParams(
        learning_rate=1e-4, discount=0.99, epsilon_first=0.5, epsilon_last=0.025,
        epsilon_episodes=475.0, epsilon_fake=None, fake_share=None, target_rate=0.01,
        priority_exponent=0.0,
    ),
    "hparams.model.learning_rate": 1e-4})  # fmt: skip
FEW: Overrides = {"seeds": 2, "size": 6, "obstacles": 1, "steps": 40, "episodes": 80}
QUICK: dict[str, Overrides] = {
    "tuned": {**FEW, "dyna.num_real_first": 15, "hparams.agent.epsilon_hold": 5.0,
              "hparams.agent.epsilon_episodes": 10.0},
    "lean": FEW,
    "paper": {**FEW, "size": 8, "coder_kernels": (3, 3, 3), "coder_widths": (8, 8, 8),
              "coder_dense": 64, "dyna.num_real_first": 15, "dyna.model_updates": 8,
              "agent.updates": 40, "agent.fake_updates": 40,
              "hparams.agent.epsilon_episodes": 30.0}}  # fmt: skip
