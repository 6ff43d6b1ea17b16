"""The game as both parts play and see it, and the models of its frames."""

from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp

from jaxdyna import models
from jaxdyna.envs import CHANNELS, AtariPong, Palette, Pong, PongParams
from jaxdyna.envs.pong_rules import FASTEST, FIELD
from jaxdyna.envs.pong_screen import in_channels, picture_of
from jaxdyna.experiments.engine import Options
from jaxdyna.fields import setting
from jaxdyna.losses import PixelLoss, l2
from jaxdyna.networks import Discriminator, EncoderDecoder, Patched, Resolution
from jaxdyna.optimizers import decayed_adam
from jaxdyna.types import DynamicsModel, Key, Prediction, Transition

PALETTES = {"objects": CHANNELS, "rgb": Palette()}  #: the colours of each kind of frame
OBJECTS = {"ball": 2, "own paddle": 1, "opponent": 0}  #: their channels in `CHANNELS`
NUM_FRAMES = 4
FRAME_SKIP = 4  #: the game's frames in a step
#: of the pure game's frames: the real one's 63 are more than four stacked frames can count, and
#: with no more than `FRAME_SKIP` a serve can look like a ball that jumps
SERVE_DELAY = 5
#: the pure game's, where nothing else is said. Nobody wins: an episode is so many steps.
RULES = PongParams(points_to_win=1_000_000, first_serve_delay=SERVE_DELAY, serve_delay=SERVE_DELAY)
#: pixels a side of the patches that Fig. 4 works on, and patches a side of its convolutions
PATCH, KERNELS = 4, (4, 3, 3)
GAMES_SAID = {"jax": "the pure game", "ale": "the Atari 2600 game (ALE/Pong-v5, no sticky actions)"}
FRAMES_SAID = {"objects": "each object in a channel of its own", "rgb": "in the game's colours"}
COLOURS_SAID = "Red is the opponent, green the own paddle, blue the ball."


@dataclass(frozen=True, kw_only=True)
class GameOptions(Options):
    """What is played, how it is seen, and what its models are."""

    game: Literal["jax", "ale"] = setting(
        "jax", "jax: the pure game; ale: the Atari 2600 game (the atari extra)", everyday=True
    )
    frames: Literal["objects", "rgb"] = setting(
        "objects", "objects: each in its own channel; rgb: the game's colours", everyday=True
    )
    seeds: int = setting(6, "runs of every arm", at_least=1, everyday=True)
    steps: int = setting(200, "steps of an episode", at_least=1, everyday=True)
    scale: Literal[4, 2] = setting(4, "the game's pixels a pixel, a side")
    widths: tuple[int, int, int] = setting((32, 32, 32), "of Fig. 4's convolutions", at_least=1)
    dense: int = setting(512, "width of its dense layer", at_least=1)
    adversarial_weight: float = setting(
        0.1, "the paper's lambda, beside half the squared error summed over a frame", at_least=0
    )
    reward_weight: float = setting(5.0, "of the reward's error in the paper's models", at_least=0)
    hidden: tuple[int, ...] = setting((256, 256), "widths of our model's perceptrons", at_least=1)
    dropout: float = setting(0.1, "share of our model's features that a gradient step does without",
                             at_least=0, below=1)  # fmt: skip


def game_of(options: GameOptions) -> Pong | AtariPong:
    """The game in the colours that it is seen in."""
    kind = AtariPong if options.game == "ale" else Pong
    return kind(FRAME_SKIP, options.scale, PALETTES[options.frames])


def seen_said(options: GameOptions) -> str:
    """How it is seen, in words."""
    side = FIELD // options.scale
    told = ", objects told by their colours" if options.game == "ale" else ""
    return f"{side}x{side} pixels of the field, {FRAMES_SAID[options.frames]}{told}"


def paper_model(
    options: GameOptions, weight_decay: float = 0.0, loss: PixelLoss = l2, **more: Any
) -> models.PixelConfig:
    """Fig. 4 on patches. Frames are in shades, and count as lit from one half on."""
    coder = EncoderDecoder(3 * PATCH**2, options.widths, KERNELS, options.dense)
    network, optimizer = Patched(coder, PATCH), decayed_adam(weight_decay, 0.5)
    shades = {"threshold": 0.5, "reward": None, "shades": True}
    return models.PixelConfig(network, loss, optimizer=optimizer, **shades | more)


def our_model(options: GameOptions, weight_decay: float, **more: Any) -> models.RectangleConfig:
    """Categories for the places of each object's edges."""
    reach = (80 // options.scale, FASTEST * FRAME_SKIP // options.scale + 1)
    return models.RectangleConfig(Resolution(reach), hidden=options.hidden, dropout=options.dropout,
                                  optimizer=decayed_adam(weight_decay), **more)  # fmt: skip


def model_of(game: Pong | AtariPong, config: Any, opposed: bool = False) -> DynamicsModel:
    """The model of this game's frames; the paper's ``opposed`` by a discriminator on patches."""
    shape, actions = game.frame_shape, game.num_actions
    if isinstance(config, models.RectangleConfig):
        return in_colours(models.rectangles(shape, actions, config), game.palette)
    patches = models.AdversaryConfig(Discriminator((5, 2)))
    judge = models.discriminator(shape, patches) if opposed else None
    return models.pixels(shape, actions, config, adversary=judge)


def in_colours(model: DynamicsModel, palette: Palette) -> DynamicsModel:
    """A model of objects in channels of their own, in a world of these colours."""
    if palette == CHANNELS:
        return model

    def seen(stack: jax.Array) -> jax.Array:
        return in_channels(stack, palette)

    def predict(params: Any, obs: jax.Array, action: jax.Array, key: Key) -> Prediction:
        said = model.predict(params, seen(obs), action, key)
        frame = picture_of(said.next_obs[..., -3:] > 127, palette)
        return said._replace(next_obs=jnp.concatenate([obs[..., 3:], frame], axis=-1))

    def update(state: Any, transitions: Transition, key: Key, hparams: Any) -> Any:
        obs, next_obs = map(seen, (transitions.obs, transitions.next_obs))
        return model.update(state, transitions._replace(obs=obs, next_obs=next_obs), key, hparams)

    return DynamicsModel(model.init, predict, update)
