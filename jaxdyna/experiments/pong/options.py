"""The settings of learning to play."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Literal, Self

import optax

from jaxdyna.agents import DQNConfig, DQNHParams
from jaxdyna.dyna import DynaConfig, DynaHParams
from jaxdyna.experiments.engine import Overrides
from jaxdyna.experiments.pong.trained import checksum
from jaxdyna.experiments.pong.world import RULES, GameOptions
from jaxdyna.fields import LARGEST, SettingError, changed, setting
from jaxdyna.models import PixelHParams

MAIN_ARMS = ("model_free", "dyna_l2", "dyna_adversarial", "dyna")
TRUE_OBJECTS = {
    "true_ball": ("ball",),
    "true_own": ("own paddle",),
    "true_opponent": ("opponent",),
    "true_ball_own": ("ball", "own paddle"),
    "true_ball_opponent": ("ball", "opponent"),
    "true_own_opponent": ("own paddle", "opponent"),
    "true_frames": ("ball", "own paddle", "opponent"),
}


@dataclass(frozen=True, kw_only=True)
class PongOptions(GameOptions):
    """DQN in Pong, with and without fake episodes from a learned model."""

    decided: ClassVar = {
        "dyna.num_episodes": "--episodes",
        "dyna.num_steps": "--steps",
        "agent.network": "--frames and --network",
        "hparams.env.max_steps": "--steps",
        "hparams.env.points_to_win": "--steps",
        "models_made": "--models",
    }
    world_settings: ClassVar = ("hparams.env", "game", "frames", "scale")

    network: Literal["convolutions", "plain"] = setting(
        "convolutions", "of the agent where --frames is rgb: three convolutions and a normalised "
        "dense layer; or the convolutions and the dense layer of the paper's authors, on patches",
        everyday=True)  # fmt: skip
    convolutions: tuple[int, int, int] = setting((16, 16, 32), "channels of its convolutions",
                                                 at_least=1)  # fmt: skip
    agent_dense: int = setting(128, "width of its dense layer", at_least=1)
    models: Path | None = setting(
        None, "folder of a record of --part frames --keep: dreams are in its models, which learn "
        "nothing more; None: models learn from the run's own episodes", everyday=True)  # fmt: skip
    models_made: str | None = setting(None, "which models those are: a checksum")
    weight_decay: float = setting(0.3, "of AdamW, for our model", at_least=0)
    paper_rate: float = setting(4e-3, "Adam's in the paper's models and the discriminator", above=0)
    dyna: DynaConfig = setting(factory=lambda: DynaConfig(
        num_episodes=LARGEST, num_steps=1,  # until they are decided, in nobody's way
        num_real_first=20, model_updates=100, model_batch=64, rare_share=0.25, dream_episodes=200,
        dream_steps=20))  # fmt: skip
    agent: DQNConfig = setting(factory=lambda: DQNConfig(
        updates=100, fake_updates=400, n_step=3, fake_capacity=40_000))  # fmt: skip
    hparams: DynaHParams = setting(factory=lambda: DynaHParams(
        DQNHParams(discount=0.97, epsilon_hold=20.0, epsilon_episodes=30.0, epsilon_last=0.02,
                   epsilon_fake=0.1),
        PixelHParams(2e-3), RULES))  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        named = [arm for arm in self.arms if arm in ("oracle", *TRUE_OBJECTS)]
        if named and self.game != "jax":
            raise SettingError(
                "arms", f"{' '.join(named)} dream in the pure game: leave out, or choose --game jax"
            )
        if self.game == "ale" and replace(self.hparams.env, max_steps=RULES.max_steps) != RULES:
            raise ValueError("--hparams.env is the pure game's: leave it out, or choose --game jax")

    def resolved(self) -> Self:
        """An episode is so many steps, nobody wins; models that are given learn nothing."""
        learns = self.models is None
        return changed(self, {
            "dyna.model_updates": self.dyna.model_updates if learns else 0,
            "models_made": checksum(self.models),
            "dyna.num_episodes": self.episodes, "dyna.num_steps": self.steps,
            "dyna.dream_steps": min(self.dyna.dream_steps or self.steps, self.steps),
            "hparams.env.max_steps": self.steps})  # fmt: skip


TUNED = PongOptions(arms=MAIN_ARMS, episodes=200, stop_after_solved=20, dropout=0.2)
SOONER = {"hparams.agent.epsilon_hold": 5.0, "hparams.agent.epsilon_episodes": 10.0}
LEAN = changed(
    TUNED, SOONER | {"preset": "lean", "arms": ("model_free", "dyna"), "dyna.num_real_first": 5}
)
#: as literally as the paper can be read, line by line in ``docs/paper-method.md``; models are
#: trained beforehand, see ``models``
PAPER = changed(TUNED, {
    "preset": "paper", "arms": ("model_free", "more_updates", *MAIN_ARMS[1:]), "frames": "rgb",
    "network": "plain", "convolutions": (8, 16, 16), "stop_after_solved": None,
    "dyna.num_real_first": 20, "dyna.model_updates": 64, "dyna.model_batch": 32,
    "dyna.rare_share": None, "dyna.dream_episodes": 1, "dyna.dream_steps": None,
    "agent": DQNConfig(
        updates=200, fake_updates=200, double=False, act_by_target=False, drift=0.0,
        loss=optax.l2_loss, fake_capacity=40_000,
    ),
    "hparams.agent": DQNHParams(
        learning_rate=1e-3, discount=0.99, epsilon_first=0.5, epsilon_last=0.025,
        epsilon_episodes=100.0, epsilon_fake=None, target_rate=0.01, priority_exponent=0.0,
    ),
})  # fmt: skip
FEW: Overrides = {
    "seeds": 2, "episodes": 24, "steps": 100, "widths": (8, 8, 8), "dense": 64, "hidden": (64, 64),
    "dyna.num_real_first": 8, "agent.updates": 30, "agent.fake_updates": 30,
    "agent.fake_capacity": 5_000, "hparams.agent.epsilon_episodes": 10.0}  # fmt: skip
OURS: Overrides = {**FEW, "hparams.agent.epsilon_hold": 5.0, "dyna.model_updates": 30,
                   "dyna.model_batch": 32, "dyna.dream_episodes": 25}  # fmt: skip
QUICK: dict[str, Overrides] = {
    "tuned": OURS, "lean": OURS, "paper": {**FEW, "agent_dense": 32, "dyna.model_updates": 8},
}  # fmt: skip
