"""The settings of learning to play."""

from dataclasses import dataclass
from typing import ClassVar, Literal, Self

from jaxdyna.agents import DQNConfig, DQNHParams
from jaxdyna.dyna import DynaConfig, DynaHParams
from jaxdyna.envs import PongParams
from jaxdyna.experiments.pong.world import GameOptions, params_of
from jaxdyna.fields import LARGEST, SettingError, changed, setting
from jaxdyna.models import PixelHParams

MAIN_ARMS = ("model_free", "dyna_l2", "dyna_adversarial", "dyna")
TRUE_OBJECTS = {
    "true_ball": ("ball",),
    "true_own": ("own paddle",),
    "true_opponent": ("opponent",),
    "true_frames": ("ball", "own paddle", "opponent"),
}
GUIDED_SKIP = 4


@dataclass(frozen=True, kw_only=True)
class PongOptions(GameOptions):
    """DQN in Pong, with and without fake episodes from a learned model."""

    decided: ClassVar = {
        "dyna.num_episodes": "--episodes",
        "dyna.num_steps": "--steps",
        "agent.network": "--look",
        "agent.fake_episodes": "--agent.fake-capacity",
        "hparams.env.max_steps": "--steps",
        "hparams.env.points_to_win": "--steps",
        "hparams.env.first_serve_delay": "--serve-delay",
        "hparams.env.serve_delay": "--serve-delay",
    }

    arms: tuple[str, ...] = setting(MAIN_ARMS, "what is played", everyday=True)
    episodes: int = setting(200, "real episodes of a run at the most", at_least=1, everyday=True)
    stop_after_solved: int | None = setting(
        20, "real episodes played on once solved; None plays all", at_least=0, everyday=True
    )
    look: Literal["places", "glimpses", "convolutions"] = setting(
        "places", "what the agent's network takes of its frames: where each object is, glimpses of "
        "it, or what convolutions see; rgb frames need the last", everyday=True,
    )  # fmt: skip
    glimpse: int = setting(7, "pixels a side of the agent's glimpses, odd", at_least=1)
    dropout: float = setting(0.2, "share of our model's features that a gradient step does without",
                             at_least=0, below=1)  # fmt: skip
    weight_decay: float = setting(0.3, "of AdamW, for our model", at_least=0)
    reward_weight: float = setting(5.0, "of the reward's error in the paper's models", at_least=0)
    paper_rate: float = setting(4e-3, "Adam's in the paper's models and the discriminator", above=0)
    dyna: DynaConfig = setting(
        factory=lambda: DynaConfig(
            num_episodes=LARGEST, num_steps=1,  # until they are decided, in nobody's way
            num_real_first=20, model_updates=100, model_batch=64, rare_share=0.25,
            dream_episodes=200, dream_steps=20,
        )
    )  # fmt: skip
    agent: DQNConfig = setting(
        factory=lambda: DQNConfig(updates=100, fake_updates=400, n_step=3, fake_capacity=40_000)
    )
    hparams: DynaHParams = setting(
        factory=lambda: DynaHParams(
            agent=DQNHParams(discount=0.97, epsilon_hold=20.0, epsilon_episodes=30.0,
                             epsilon_last=0.02, epsilon_fake=0.1),
            model=PixelHParams(2e-3),
            env=PongParams(),
        )
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.glimpse % 2 == 0:
            raise SettingError("glimpse", f"is {self.glimpse}: give an odd number of pixels")
        if self.frames == "rgb" and self.look != "convolutions":
            raise SettingError(
                "look", f"is {self.look}, which needs each object in a channel of its own: choose "
                "--look convolutions, or leave out --frames rgb",
            )  # fmt: skip
        named = [arm for arm in self.arms if arm in ("oracle", *TRUE_OBJECTS)]
        if named and not self.readable:
            raise SettingError(
                "arms", f"{' '.join(named)} read the pure game's state off its frames: leave out, "
                f"or choose --game jax, --frames objects and --frame-skip {GUIDED_SKIP}",
            )  # fmt: skip
        default = params_of(self, PongParams())
        if self.game == "ale" and params_of(self, self.hparams.env) != default:
            raise ValueError("--hparams.env is the pure game's: leave it out, or choose --game jax")

    @property
    def readable(self) -> bool:
        """Whether the game's state can be read off its frames."""
        return (self.game, self.frames, self.frame_skip) == ("jax", "objects", GUIDED_SKIP)

    def resolved(self) -> Self:
        """An episode is so many steps of a game that nobody wins."""
        return changed(self, {
            "dyna.num_episodes": self.episodes, "dyna.num_steps": self.steps,
            "dyna.dream_steps": min(self.dyna.dream_steps or self.steps, self.steps),
            "hparams.env": params_of(self, self.hparams.env),
        })  # fmt: skip


TUNED = PongOptions()
SOONER = {"hparams.agent.epsilon_hold": 5.0, "hparams.agent.epsilon_episodes": 10.0}
LEAN = changed(
    TUNED, SOONER | {"preset": "lean", "arms": ("model_free", "dyna"), "dyna.num_real_first": 5}
)
QUICK = SOONER | {
    "seeds": 2, "episodes": 24, "steps": 100, "widths": (8, 8, 8), "dense": 64, "hidden": (64, 64),
    "dyna.num_real_first": 8, "dyna.model_updates": 30, "dyna.model_batch": 32,
    "dyna.dream_episodes": 25, "agent.updates": 30, "agent.fake_updates": 30,
    "agent.fake_capacity": 5_000,
}  # fmt: skip
