"""The game as both parts play and see it, and the models of its frames."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

from jaxdyna.envs import CHANNELS, AtariPong, Palette, Pong, PongParams
from jaxdyna.envs.pong_rules import FASTEST
from jaxdyna.experiments.engine import Options
from jaxdyna.experiments.frames.options import decayed_adam
from jaxdyna.fields import SettingError, setting
from jaxdyna.losses import PixelLoss, l2
from jaxdyna.models import AdversaryConfig, PixelConfig, RectangleConfig
from jaxdyna.networks import Discriminator, EncoderDecoder, Patched

PALETTES = {"objects": CHANNELS, "rgb": Palette()}
"""The colours of each kind of frame."""
OBJECTS = {"ball": 2, "own paddle": 1, "opponent": 0}
"""Their channels in `CHANNELS`."""
NUM_FRAMES = 4
SERVE_DELAY = 5
"""Frames of the pure game after which a ball is served, where nothing else is said."""
ENDLESS = 1_000_000
"""Points that nobody comes to: an episode is so many steps."""
GAMES_SAID = {"jax": "the pure game", "ale": "the Atari 2600 game"}
SEEN_SAID = {"objects": "each object in a channel of its own", "rgb": "in the game's colours"}
COLOURS_SAID = "Red is the opponent, green the own paddle, blue the ball."


@dataclass(frozen=True, kw_only=True)
class GameOptions(Options):
    """What is played, how it is seen, and what its models are."""

    game: Literal["jax", "ale"] = setting(
        "jax", "jax: the pure game, objects exact; ale: the Atari 2600 game, objects by their "
        "colours (the atari extra)", everyday=True,
    )  # fmt: skip
    frames: Literal["objects", "rgb"] = setting(
        "objects", "objects: each object in a channel of its own; rgb: in the game's colours, as "
        "in the paper", everyday=True,
    )  # fmt: skip
    seeds: int = setting(6, "runs of every arm", at_least=1, everyday=True)
    steps: int = setting(200, "steps of an episode", at_least=1, everyday=True)
    scale: int = setting(
        4, "the game's pixels in a pixel of the frame, a side, a divisor of 160: 4 gives 40x40",
        at_least=2,
    )  # fmt: skip
    frame_skip: int = setting(4, "the game's frames in a step", at_least=1)
    serve_delay: int = setting(
        SERVE_DELAY, "the pure game's frames from a point to the next serve (63 in the real game, "
        "which keeps them, are more than four stacked frames can count); with no more than "
        "frame_skip a serve can look like a ball that jumps", at_least=0,
    )  # fmt: skip
    patch: int = setting(4, "pixels a side of the patches that Fig. 4 works on", at_least=1)
    widths: tuple[int, int, int] = setting((32, 32, 32), "channels of its convolutions", at_least=1)
    kernels: tuple[int, int, int] = setting((4, 3, 3), "patches a side of their kernels",
                                            at_least=1)  # fmt: skip
    dense: int = setting(512, "width of its dense layer", at_least=1)
    adversarial_weight: float = setting(
        0.1, "the paper's lambda, beside half the squared error summed over a frame", at_least=0
    )
    hidden: tuple[int, ...] = setting((256, 256), "widths of the perceptrons of our model",
                                      at_least=1)  # fmt: skip
    dropout: float = setting(
        0.1, "share of the features that a gradient step of our model does without",
        at_least=0, below=1,
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.game == "ale" and self.serve_delay != SERVE_DELAY:
            raise SettingError("serve_delay", "is the real game's own: leave it out of --game ale")
        side = game_of(self).frame_shape[0]
        if side % self.patch or sum(self.kernels) - 3 >= side // self.patch:
            raise ValueError(
                f"--patch {self.patch} and --kernels {self.kernels} do not fit frames of {side} "
                "pixels a side: give a divisor of it that leaves more patches than kernels take"
            )


def game_of(options: GameOptions) -> Pong | AtariPong:
    """The game in the colours that it is seen in."""
    kind = AtariPong if options.game == "ale" else Pong
    return kind(options.frame_skip, options.scale, PALETTES[options.frames])


def params_of(options: GameOptions, given: PongParams) -> PongParams:
    """The pure game's: episodes of so many steps, however many points; the rest as given."""
    return replace(
        given, points_to_win=ENDLESS, max_steps=options.steps,
        first_serve_delay=options.serve_delay, serve_delay=options.serve_delay,
    )  # fmt: skip


def paper_model(
    options: GameOptions, weight_decay: float = 0.0, loss: PixelLoss = l2, **more: Any
) -> PixelConfig:
    """Fig. 4 on patches. Frames are in shades, and count as lit from one half on."""
    coder = EncoderDecoder(3 * options.patch**2, options.widths, options.kernels, options.dense)
    network, optimizer = Patched(coder, options.patch), decayed_adam(weight_decay, 0.5)
    shades = {"threshold": 0.5, "reward": None, "shades": True}
    return PixelConfig(network, loss, optimizer=optimizer, **shades | more)


def our_model(options: GameOptions, weight_decay: float, **more: Any) -> RectangleConfig:
    """Categories for the places of each object's edges."""
    fastest = FASTEST * options.frame_skip
    return RectangleConfig(
        (80 // options.scale, fastest // options.scale + 1), hidden=options.hidden,
        dropout=options.dropout, optimizer=decayed_adam(weight_decay), **more,
    )  # fmt: skip


def discriminating(side: int) -> AdversaryConfig:
    """The discriminator, on patches that frames of so many pixels a side divide into."""
    first = next(size for size in (5, 4, 2, 1) if side % size == 0)
    second = 2 if side // first % 2 == 0 else 1
    return AdversaryConfig(Discriminator((first, second)))
