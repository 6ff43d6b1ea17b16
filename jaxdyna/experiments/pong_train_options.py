"""The settings of learning to play Pong: its command line and its presets."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from jaxdyna.agents import DQNConfig, DQNHParams
from jaxdyna.dyna import DynaHParams
from jaxdyna.envs import PongParams
from jaxdyna.experiments import cli
from jaxdyna.experiments.maze_train_options import SHARES
from jaxdyna.experiments.pong_options import DREAM_FROM, SERVE_DELAY, check_game
from jaxdyna.experiments.pong_train_parts import (
    NEED_STATE,
    check_env,
    check_sight,
    dyna_config,
    frames_of,
)
from jaxdyna.models import PixelHParams
from jaxdyna.statistics import SolveRule

ArmName = Literal[
    "model_free", "dyna", "dyna_l2", "dyna_adversarial", "placebo", "oracle", "more_updates",
    "true_ball", "true_own", "true_opponent", "true_frames",
]  # fmt: skip
GUIDED_SKIP = 4
WINDOW = 20
LEVEL = 0.0


@dataclass(frozen=True)
class Options:
    """DQN in Pong, with and without fake episodes from a learned model."""

    part: Literal["train", "model"] = "train"
    """train: learning to play; model: frame prediction alone (a command line of its own)."""
    game: Literal["jax", "ale"] = "jax"
    """jax: the pure game, objects exact; ale: the Atari 2600 game, objects by their colours (the
    atari extra)."""
    frames: Literal["objects", "rgb", "grey"] = "objects"
    """objects: each object in a channel of its own; rgb: in the game's colours, as in the paper;
    grey: the whole screen in grey, 84x84 (Mnih et al. 2015)."""
    preset: Literal["paper", "lean"] = "paper"
    """paper: the paper's models beside ours; lean: model_free and ours, and dreams sooner."""
    quick: bool = False
    """A look at everything in minutes: two runs, few episodes."""
    seeds: int = 6
    """Runs of every arm, all in one jitted program."""
    seed: int = 0
    """Base seed of all runs."""
    episodes: int = 200
    """Real episodes of a run at the most."""
    arms: tuple[ArmName, ...] = ("model_free", "dyna_l2", "dyna_adversarial", "dyna")
    """dyna: our model; dyna_l2, dyna_adversarial: the paper's; placebo: ours, never trained;
    oracle: the true game from the same frames; more_updates: as many updates an episode as dyna
    makes, all of them on real steps; true_ball, true_own, true_opponent, true_frames: dyna_l2
    with one object of its dreams replaced by the truth, or all of them."""
    out: Path | None = None
    """Folder for the results; runs/pong-PRESET by default."""
    resume: bool = False
    """Go on with the run in that folder, bit for bit."""
    stop_after_solved: int | None = 20
    """Episodes an arm plays on once all its seeds have solved; None plays all of them."""
    steps: int = 200
    """Steps of a real episode."""
    scale: int = 4
    """The game's pixels in a pixel of the frame, a side: 4 gives 40x40. Not of grey ones."""
    frame_skip: int = 4
    """The game's frames in a step."""
    serve_delay: int = SERVE_DELAY
    """The game's frames from a point to the next serve (63 in the real game, which keeps them).
    With no more than --frame-skip a serve can look like a ball that jumps."""
    real_first: int = 20
    """N of the paper: real episodes before the first dream."""
    look: Literal["places", "glimpses", "convolutions"] = "places"
    """What the agent's network takes of its frames: where each object is, glimpses of it, or what
    convolutions see; rgb and grey frames need the last."""
    glimpse: int = 7
    """Pixels a side of the agent's glimpses, odd."""
    patch: int = 4
    """Pixels a side of the patches that the paper's model works on."""
    widths: tuple[int, ...] = (32, 32, 32)
    """Channels of its convolutions."""
    kernels: tuple[int, ...] = (4, 3, 3)
    """Patches a side of their kernels."""
    dense: int = 512
    """Width of its dense layer."""
    hidden: tuple[int, ...] = (256, 256)
    """Widths of the perceptrons of our model."""
    dropout: float = 0.2
    """Share of the features that a gradient step of our model does without."""
    weight_decay: float = 0.3
    """Of AdamW, for our model."""
    reward_weight: float = 5.0
    """Weight of the reward's squared error beside the frame's loss, in the paper's models."""
    paper_rate: float = 4e-3
    """Adam's learning rate, in the paper's models and the discriminator."""
    adversarial_weight: float = 0.1
    """The paper's lambda, beside half the squared error summed over a frame."""
    model_updates: int = 100
    """Gradient steps of the model after each real episode."""
    model_batch: int = 64
    """Transitions in each gradient step of the model."""
    rare_share: float | None = 0.25
    """At least this share of each model batch are points won and lost; None: as they come."""
    dream_episodes: int = 200
    """Fake episodes after each real one."""
    dream_steps: int = 20
    """The longest fake episode; each begins at a real stack of frames."""
    agent: DQNConfig = field(
        default_factory=lambda: DQNConfig(
            updates=100, fake_updates=400, n_step=3, fake_capacity=40_000
        )
    )
    """Updates, batches and replays of the agent (DQN)."""
    hparams: DynaHParams = field(
        default_factory=lambda: DynaHParams(
            agent=DQNHParams(
                discount=0.97,
                epsilon_hold=20.0,
                epsilon_episodes=30.0,
                epsilon_last=0.02,
                epsilon_fake=0.1,
            ),
            model=PixelHParams(2e-3),
            env=PongParams(),
        )
    )
    """Learning rates, discount: what `jaxdyna.sweep` can sweep."""

    def __post_init__(self) -> None:
        cli.check_common(self)
        if not self.arms:
            raise ValueError("--arms is empty: name at least one arm")
        check_game(self)
        hidden = [arm for arm in self.arms if arm in NEED_STATE]
        if self.game == "ale" and hidden:
            raise ValueError(
                f"--arms {' '.join(hidden)} read the pure game's state off its frames: leave out, "
                "or choose --game jax"
            )
        if hidden and self.frame_skip != GUIDED_SKIP:
            raise ValueError(
                f"--arms {' '.join(hidden)} read the pure game's state off frames {GUIDED_SKIP} of "
                f"its own apart: leave out, or choose --frame-skip {GUIDED_SKIP}"
            )
        check_sight(self)
        check_env(self)
        cli.check_numbers(self.hparams, "--hparams", may_be_infinite=["disagreement_threshold"])
        for name in SHARES:
            if not 0 <= getattr(self.hparams.agent, name) <= 1:
                flag = f"--hparams.agent.{name.replace('_', '-')}"
                raise ValueError(f"{flag} must lie between 0 and 1")
        if self.dream_steps > self.steps:
            raise ValueError("--dream-steps is more than --steps: a dream is no longer than that")
        if self.glimpse < 1 or self.glimpse % 2 == 0:
            raise ValueError(f"--glimpse is {self.glimpse}: give an odd number of pixels")
        if not 0 <= self.reward_weight < float("inf"):
            raise ValueError("--reward-weight must be a finite number of at least 0")
        if not 0 < self.paper_rate < float("inf"):
            raise ValueError(f"--paper-rate is {self.paper_rate}: give a number above 0")
        if not 0 <= self.adversarial_weight < float("inf"):
            raise ValueError("--adversarial-weight must be a finite number of at least 0")
        if self.steps <= DREAM_FROM:
            raise ValueError(f"--steps is {self.steps}: an episode needs more than {DREAM_FROM}")
        frames_of(self)
        dyna_config(self)

    @property
    def rule(self) -> SolveRule:
        """As many points as the opponent."""
        return SolveRule(WINDOW, LEVEL)


PAPER = Options()
LEAN = replace(
    PAPER,
    preset="lean",
    arms=("model_free", "dyna"),
    real_first=5,
    hparams=replace(
        PAPER.hparams,
        agent=replace(PAPER.hparams.agent, epsilon_hold=5.0, epsilon_episodes=10.0),
    ),
)
PRESETS = {"paper": PAPER, "lean": LEAN}
_FEW: dict[str, Any] = {
    "quick": True,
    "seeds": 2,
    "episodes": 24,
    "steps": 100,
    "real_first": 8,
    "widths": (8, 8, 8),
    "dense": 64,
    "hidden": (64, 64),
    "model_updates": 30,
    "model_batch": 32,
    "dream_episodes": 25,
    "agent": replace(PAPER.agent, updates=30, fake_updates=30, fake_capacity=5_000),
    "hparams": LEAN.hparams,
}
QUICK = {"paper": replace(PAPER, **_FEW), "lean": replace(LEAN, **_FEW)}
