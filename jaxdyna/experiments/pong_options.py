"""The settings of frame prediction in Pong: its command line and what its models are."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from jaxdyna.envs import CHANNELS, Palette, Pong, PongParams
from jaxdyna.envs.gymnasium import check_atari
from jaxdyna.envs.pong_rules import FASTEST
from jaxdyna.experiments import cli
from jaxdyna.experiments.maze_options import decayed_adam
from jaxdyna.losses import bce, l1, l2
from jaxdyna.models import AdversaryConfig, PixelConfig, RectangleConfig
from jaxdyna.networks import Discriminator, EncoderDecoder, Patched

DREAM_FROM = 10
"""Step of a held-out episode from which the first dream begins."""
SERVE_DELAY = 5
"""Frames of the pure game after which a ball is served, where nothing else is said."""
ENDLESS = 1_000_000
"""Points that nobody comes to: an episode is so many steps."""

ModelName = Literal["ours", "l2", "l1", "bce", "adversarial"]
Policy = Literal["random", "mixed"]
GameName = Literal["jax", "ale"]
FrameKind = Literal["objects", "rgb"]
PALETTES: dict[str, Palette] = {"objects": CHANNELS, "rgb": Palette()}
"""The colours of each kind of frame."""
POLICIES: tuple[Policy, ...] = ("random", "mixed")


@dataclass(frozen=True)
class Training:
    """How a model is trained on its episodes."""

    updates: int = 3000
    """Gradient steps."""
    batch: int = 32
    """Transitions in each."""
    learning_rate: float = 2e-3
    """Adam's at the start; it falls to 0 along half a cosine."""
    weight_decay: float = 0.0
    """Of AdamW; 0 is Adam."""

    def __post_init__(self) -> None:
        if self.updates < 1 or self.batch < 1:
            raise ValueError(f"{self.updates} updates of {self.batch}: both must be at least 1")
        if not 0 < self.learning_rate < float("inf"):
            raise ValueError(f"the learning rate is {self.learning_rate}: it must be above 0")
        if not 0 <= self.weight_decay < float("inf"):
            raise ValueError(f"weight_decay is {self.weight_decay}: it must be 0 or more")


@dataclass(frozen=True)
class Options:
    """Action-conditional frame prediction in Pong: the paper's Fig. 9 in numbers."""

    part: Literal["train", "model"] = "model"
    """model: frame prediction; train: learning to play (a command line of its own)."""
    game: GameName = "jax"
    """jax: the pure game, objects exact; ale: the Atari 2600 game, objects by their colours (the
    atari extra)."""
    frames: FrameKind = "objects"
    """objects: each object in a channel of its own; rgb: in the game's colours, as in the paper."""
    preset: Literal["paper", "lean"] = "paper"
    """paper: the paper's models and other losses beside ours; lean: ours alone."""
    quick: bool = False
    """A look at everything in minutes: fewer seeds, episodes and updates, narrower networks."""
    seeds: int = 6
    """Runs of every arm, all in one jitted program."""
    seed: int = 0
    """Base seed of all runs."""
    episodes: int = 1000
    """Episodes of each policy that a model is trained on."""
    policies: tuple[Policy, ...] = POLICIES
    """Whose episodes: random: every action at random; mixed: players of all strengths, from random
    ones to one that follows the ball."""
    arms: tuple[ModelName, ...] = ("l2", "l1", "bce", "adversarial", "ours")
    """l2, l1, bce: Fig. 4 scaled to the frame, under that loss; adversarial: l2 and the adversarial
    loss (the paper's); ours: categories for the places of each object's edges."""
    out: Path | None = None
    """Folder for the results; runs/pong-model by default."""
    resume: bool = False
    """Go on with the run in that folder: arms that are finished are not repeated."""
    scale: int = 4
    """The game's pixels in a pixel of the frame, a side: 4 gives 40x40."""
    frame_skip: int = 4
    """The game's frames in a step."""
    steps: int = 200
    """Steps of an episode."""
    serve_delay: int = SERVE_DELAY
    """The game's frames from a point to the next serve (63 in the real game, which keeps them, are
    more than a stack of four frames can count). With no more than --frame-skip a serve can look
    like a ball that jumps."""
    patch: int = 4
    """Pixels a side of the patches that Fig. 4 works on."""
    widths: tuple[int, ...] = (32, 32, 32)
    """Channels of the three convolutions of Fig. 4."""
    kernels: tuple[int, ...] = (4, 3, 3)
    """Patches a side of their kernels."""
    dense: int = 512
    """Width of its dense layer."""
    adversarial_weight: float = 0.1
    """The paper's lambda, beside half the squared error summed over a frame."""
    hidden: tuple[int, ...] = (256, 256)
    """Widths of the perceptrons of ours."""
    dropout: float = 0.1
    """Share of the features that a gradient step of ours does without."""
    held_out: int = 20
    """New episodes of the mixed policy that models are judged on."""
    horizon: int = 30
    """Steps of an open-loop dream."""
    dreams: int = 8
    """Dreams in each held-out episode."""
    paper: Training = field(default_factory=lambda: Training(6000, 32, 4e-3))
    """Training of Fig. 4."""
    ours: Training = field(default_factory=lambda: Training(6000, 256, 2e-3, 0.1))
    """Training of ours."""

    def __post_init__(self) -> None:
        cli.check_common(self)
        if not self.arms or not self.policies:
            raise ValueError("--arms and --policies: name at least one each")
        check_game(self)
        game_of(self)
        side = Pong(scale=self.scale).frame_shape[1]
        if len(self.widths) != 3 or len(self.kernels) != 3 or min(self.widths) < 1:
            raise ValueError("--widths and --kernels: give three numbers each, at least 1")
        if min(self.kernels) < 1 or min(self.hidden, default=0) < 1 or self.dense < 1:
            raise ValueError("--kernels, --hidden and --dense: give numbers of at least 1")
        if self.patch < 1 or side % self.patch or sum(self.kernels) - 3 >= side // self.patch:
            raise ValueError(
                f"--patch {self.patch} and --kernels {self.kernels} do not fit frames of {side} "
                "pixels a side: give a divisor of it that leaves more patches than kernels take"
            )
        if not 0 <= self.dropout < 1:
            raise ValueError(f"--dropout is {self.dropout}: give a number from 0 up to below 1")
        if not 0 <= self.adversarial_weight < float("inf"):
            raise ValueError("--adversarial-weight must be a finite number of at least 0")
        span = DREAM_FROM + self.horizon
        if min(self.held_out, self.horizon, self.dreams) < 1 or span > self.steps:
            raise ValueError(
                f"--held-out, --horizon and --dreams must be at least 1, and {DREAM_FROM} + "
                "--horizon, where the first dream ends, at most --steps"
            )

    def stages_of(self, arm: str) -> tuple[Policy, ...]:
        """Whose episodes the arm is trained on, one after the other."""
        del arm
        return tuple(dict.fromkeys(self.policies))

    @property
    def dream_starts(self) -> list[int]:
        """Steps of a held-out episode that dreams begin at."""
        room = self.steps - self.horizon - DREAM_FROM
        gaps = max(self.dreams - 1, 1)
        return [DREAM_FROM + room * number // gaps for number in range(self.dreams)]


def game_of(options: Any) -> Pong:
    """The pure game that the options ask for, in the colours that they ask for."""
    if options.scale < 2:
        raise ValueError("--scale is less than 2: give a divisor of 160 from 2 on")
    return Pong(options.frame_skip, options.scale, PALETTES[options.frames])


def check_game(options: Any) -> None:
    """Whether the game can be played here, and as asked for.

    Raises:
        ValueError: with what to change, or how to install what is missing.
    """
    if options.game != "ale":
        return
    if options.serve_delay != SERVE_DELAY:
        raise ValueError("--serve-delay: the real game keeps its own, leave it out of --game ale")
    try:
        check_atari()
    except ImportError as error:
        raise ValueError(f"--game ale: {error}") from None


def params_of(options: Any, given: PongParams | None = None) -> PongParams:
    """Its params: episodes of so many steps, however many points; the rest as given."""
    return replace(
        given or PongParams(),
        points_to_win=ENDLESS,
        max_steps=options.steps,
        first_serve_delay=options.serve_delay,
        serve_delay=options.serve_delay,
    )


PAPER = Options()
LEAN = Options(preset="lean", arms=("ours",))
PRESETS = {"paper": PAPER, "lean": LEAN}
_FEW: dict[str, Any] = {
    "quick": True,
    "seeds": 2,
    "episodes": 20,
    "steps": 100,
    "widths": (8, 8, 8),
    "dense": 64,
    "hidden": (128, 128),
    "held_out": 5,
    "horizon": 20,
    "dreams": 3,
    "paper": Training(200, 16, 2e-3),
    "ours": Training(1000, 64, 2e-3, 0.1),
}
QUICK = {"paper": replace(PAPER, **_FEW), "lean": replace(LEAN, **_FEW)}


def training_of(options: Options, arm: str) -> Training:
    """How this arm is trained."""
    return options.ours if arm == "ours" else options.paper


def config_of(options: Options, arm: str, channels: int = 3) -> PixelConfig | RectangleConfig:
    """The model of this arm. Under L1, L2 and with the adversary frames are in shades, and count as
    lit from one half on; the cross-entropy has the paper's threshold of 0.2, but in the game's
    colours it is in shades as well.
    """
    if arm == "ours":
        optimizer = decayed_adam(options.ours.weight_decay)
        fastest = FASTEST * options.frame_skip
        reach = (80 // options.scale, fastest // options.scale + 1)
        hidden, dropout = tuple(options.hidden), options.dropout
        return RectangleConfig(reach, hidden=hidden, dropout=dropout, optimizer=optimizer)
    coder = EncoderDecoder(
        channels * options.patch**2, tuple(options.widths), tuple(options.kernels), options.dense
    )
    network, optimizer = (
        Patched(coder, options.patch),
        decayed_adam(options.paper.weight_decay, 0.5),
    )
    if arm == "bce" and options.frames == "objects":
        return PixelConfig(network, bce, 0.2, None, optimizer=optimizer)
    loss = {"l1": l1, "bce": bce}.get(arm, l2)
    return PixelConfig(network, loss, 0.5, None, optimizer=optimizer, shades=True)


def adversary_config(side: int) -> AdversaryConfig:
    """The discriminator of the ``adversarial`` arm, on patches that frames of so many pixels a side
    divide into.
    """
    first = next(size for size in (5, 4, 2, 1) if side % size == 0)
    second = 2 if side // first % 2 == 0 else 1
    return AdversaryConfig(Discriminator((first, second)))
