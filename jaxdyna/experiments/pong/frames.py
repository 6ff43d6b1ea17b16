"""Predicting Pong's frames (§4.3, Fig. 9): the paper's models beside one that does not blur."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna.envs import AtariPong, PongParams
from jaxdyna.envs.pong_screen import mixture_of, shares_of
from jaxdyna.experiments.engine import Arm, Experiment, Record, Runs, Work
from jaxdyna.experiments.frames.options import FrameOptions, Training, without_stages
from jaxdyna.experiments.frames.report import FrameReport
from jaxdyna.experiments.frames.training import frame_work, stages
from jaxdyna.experiments.frames.worlds import Asked, Stage, World
from jaxdyna.experiments.pong import atari
from jaxdyna.experiments.pong.colours import in_channels, in_colours
from jaxdyna.experiments.pong.data import Played, View, play, sample, take, view_of
from jaxdyna.experiments.pong.world import (
    COLOURS_SAID,
    GAMES_SAID,
    NUM_FRAMES,
    OBJECTS,
    PALETTES,
    SEEN_SAID,
    GameOptions,
    discriminating,
    game_of,
    our_model,
    paper_model,
    params_of,
)
from jaxdyna.experiments.report import frames as pictures
from jaxdyna.experiments.report import sections as report
from jaxdyna.experiments.report.tables import markdown_table
from jaxdyna.experiments.report.tables import runs as counted
from jaxdyna.fields import SettingError, changed, setting
from jaxdyna.losses import bce, l1, l2
from jaxdyna.models import (
    AdversarialHParams,
    PixelHParams,
    discriminator,
    frame_probability,
    pixels,
    rectangle_probability,
    rectangles,
)
from jaxdyna.types import DynamicsModel, Key, Transition

DREAM_FROM = 10
"""Step of a held-out episode from which the first dream begins."""
Policy = Literal["random", "mixed"]
POLICIES: tuple[Policy, ...] = ("random", "mixed")
SAID = {
    "l2": "Fig. 4 on patches, squared error, in shades, lit from one half on.",
    "l1": "the same under L1.",
    "bce": "the same under the cross-entropy, lit above 0.2 as in the paper; in the game's colours "
    "in shades like the others.",
    "adversarial": "`l2` and the adversarial loss (the paper's), in its non-saturating form (the "
    "printed sign would reward being seen through).",
    "ours": "categories for the rows and columns at which each object may begin and end; the "
    "paddles first, then the ball, told where they have gone; dreams take the likeliest places.",
}


@dataclass(frozen=True, kw_only=True)
class PongFrames(GameOptions, FrameOptions):
    """Action-conditional frame prediction in Pong: the paper's Fig. 9 in numbers."""

    decided: ClassVar = FrameOptions.decided | {
        f"{model}.{name}": "the experiment, whose models predict frames alone"
        for model in ("paper", "ours")
        for name in ("rare_share", "reward_weight")
    }

    arms: tuple[str, ...] = setting(
        ("l2", "l1", "bce", "adversarial", "ours"), "the models that are trained", everyday=True
    )
    episodes: int = setting(
        1000, "episodes of each policy that a model is trained on", at_least=1, everyday=True
    )
    policies: tuple[Policy, ...] = setting(
        POLICIES, "whose episodes: random: every action at random; mixed: players of all "
        "strengths, from random ones to one that follows the ball", everyday=True,
    )  # fmt: skip
    horizon: int = setting(30, "steps of an open-loop dream", at_least=1, everyday=True)
    dreams: int = setting(8, "dreams in each held-out episode", at_least=1)
    paper: Training = setting(
        factory=lambda: Training(6000, 0, 32, 4e-3, 0.0, None), help="training of Fig. 4"
    )
    ours: Training = setting(
        factory=lambda: Training(6000, 0, 256, 2e-3, 0.1, None), help="training of ours"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if DREAM_FROM + self.horizon > self.steps:
            raise SettingError(
                "horizon", f"is {self.horizon}: {DREAM_FROM} steps and it, where the first dream "
                f"ends, must be at most the {self.steps} of an episode",
            )  # fmt: skip

    @property
    def dream_starts(self) -> tuple[int, ...]:
        """Steps of a held-out episode that dreams begin at."""
        room, gaps = self.steps - self.horizon - DREAM_FROM, max(self.dreams - 1, 1)
        return tuple(DREAM_FROM + room * number // gaps for number in range(self.dreams))


def arms(options: PongFrames) -> dict[str, Callable[[], Arm]]:
    """Every model, trained on the episodes of each policy."""
    program = without_stages(options, ("paper", "ours"))
    parts: dict[str, tuple[int, int]] = {
        policy: (POLICIES.index(policy), options.episodes)
        for policy in dict.fromkeys(options.policies)
    }
    made: dict[str, Callable[[], Arm]] = {}
    for arm in SAID:
        training = options.ours if arm == "ours" else options.paper
        made |= stages(arm, partial(work, program, arm), training, parts)
    return made


@cache
def work(options: PongFrames, arm: str) -> Work:
    """A model's training: one object, and so one program, for the same settings."""
    training = options.ours if arm == "ours" else options.paper
    world = real_world(options) if options.game == "ale" else pure_world(options)

    def adversarial(rate: Any) -> AdversarialHParams:
        return AdversarialHParams(rate, options.adversarial_weight, rate)

    rates: Any = adversarial if arm == "adversarial" else PixelHParams
    return frame_work(world, *model_of(options, arm), training.batch, options.block, rates)


def model_of(options: PongFrames, arm: str) -> tuple[DynamicsModel, Asked]:
    """The arm's model, and what is asked of it."""
    game = game_of(options)
    shape, actions, palette = game.frame_shape, game.num_actions, game.palette
    if arm == "ours":
        ours = our_model(options, options.ours.weight_decay)
        knows = rectangle_probability(shape, actions, ours)
        model = in_colours(rectangles(shape, actions, ours), palette)

        def believe(params: Any, obs: jax.Array, action: jax.Array) -> jax.Array:
            return knows(params, in_channels(obs, palette), action)

        def expect(*args: Any) -> jax.Array:
            return mixture_of(believe(*args), palette) / 255

        return model, Asked(believe, (("lit", model.predict),), 0.5, picture=expect)
    lit = arm == "bce" and options.frames == "objects"
    more: Any = {"threshold": 0.2, "shades": False} if lit else {}
    loss = {"l1": l1, "bce": bce}.get(arm, l2)
    config = paper_model(options, options.paper.weight_decay, loss, **more)
    judge = discriminator(shape, discriminating(shape[0])) if arm == "adversarial" else None
    model = pixels(shape, actions, config, adversary=judge)
    frame = frame_probability(actions, config)

    def seen(*args: Any) -> jax.Array:
        return shares_of(255 * frame(*args), palette)

    return model, Asked(seen, (("lit", model.predict),), config.threshold or 0.5, picture=frame)


@cache
def pure_world(options: PongFrames) -> World:
    """The pure game's episodes. A key gives every arm the same ones."""
    game: Any = game_of(options)
    params = params_of(options, PongParams())

    def data(key: Key, _: Key, stage: Stage) -> tuple[Played, Played]:
        key_random, key_mixed, key_new = jax.random.split(key, 3)
        mixed, steps = stage.part == POLICIES.index("mixed"), options.steps
        key_learn = jax.random.clone(jnp.where(mixed, key_mixed, key_random))  # used once only
        learned = play(game, params, steps, options.episodes, mixed, key_learn)
        return learned, play(game, params, steps, options.held_out, True, key_new)

    return _world(options, view_of(game))._replace(data=data)


@cache
def real_world(options: PongFrames) -> World:
    """The real game's episodes, which a host collects once for all arms."""
    game = AtariPong(options.frame_skip, options.scale)
    episodes = atari.Episodes(game, options.steps, options.episodes, options.held_out)

    def collect(runs: Runs) -> tuple[Played, Played]:
        mixed = runs.hparams.part == POLICIES.index("mixed")
        each = zip(runs.seed.tolist(), mixed.tolist(), strict=True)
        return atari.collected(episodes, tuple(each), runs.base)

    return _world(options, atari.view_in(PALETTES[options.frames]))._replace(collect=collect)


def _world(options: PongFrames, view: View) -> World:
    """The parts that both games share."""

    def draw(data: Any, key: Key, stage: Stage, size: int) -> Transition:
        return sample(view, data[0], key, size)

    def look(data: Any, episode: Any, times: jax.Array) -> Transition:
        return take(view, data[1], jnp.full(times.shape, episode), times)

    def truth(data: Any, episode: Any, times: jax.Array) -> jax.Array:
        there = jax.tree.map(lambda leaf: leaf[episode, times + 1], data[1].world)
        return jax.vmap(view.objects)(there)

    return World(
        None, draw, look, truth, options.held_out, options.steps, options.dream_starts,
        options.horizon, tuple(OBJECTS.values()),
        lambda data: _example(options, truth, data),
        shares=lambda frames: shares_of(frames, PALETTES[options.frames]),
        apart=lambda truth: unserved(truth[..., OBJECTS["ball"]]),
        film=_longest_flight,
    )  # fmt: skip


def unserved(ball: jax.Array) -> jax.Array:
    """Whether no new ball has been served up to a step, bool ``[episodes, T]``, from where the ball
    is, bool ``[episodes, T + 1, H, W]``: a new one has not been there, or is an eighth of the field
    away.
    """
    there, columns = ball.any((2, 3)), ball.any(2)
    column = columns.argmax(-1)
    away = jnp.abs(column[:, 1:] - column[:, :-1]) > columns.shape[-1] // 8
    served = there[:, 1:] & (~there[:, :-1] | away)
    return jnp.cumsum(served, axis=1) == 0


def _longest_flight(truth: jax.Array) -> jax.Array:
    """The dream in which a ball flies longest before one is served."""
    ball = truth[..., OBJECTS["ball"]]
    return (ball[:, 1:].any((2, 3)) & unserved(ball)).sum(1).argmax()


def _example(options: PongFrames, truth: Callable[..., jax.Array], data: Any) -> tuple[Any, Any]:
    """The step of the last episode in which the own paddle moves most while all objects are in
    sight.
    """
    episode = options.held_out - 1
    there = truth(data, episode, jnp.arange(-1, options.steps))
    after, before = there[1:], there[:-1]
    whole = (after.sum((1, 2)) >= jnp.median(after.sum((1, 2)), axis=0)).all(-1)
    moved = (after ^ before)[..., OBJECTS["own paddle"]].sum((1, 2))
    return episode, jnp.argmax(jnp.where(whole & before.any((1, 2)).all(-1), moved, -1))


def seen(options: PongFrames, stack: np.ndarray) -> np.ndarray:
    """A stack as one picture in [0, 1], the older frames fainter."""
    palette = PALETTES[options.frames]
    shares = [shares_of(jnp.asarray(frame), palette) for frame in np.split(stack, NUM_FRAMES, -1)]
    faint = pictures.trail(np.concatenate(shares, axis=-1))
    return np.asarray(mixture_of(jnp.asarray(faint), palette)) / 255


def about(record: Record) -> str:
    """What was done."""
    options: PongFrames = record.options
    height, width, _ = game_of(options).frame_shape
    game = {
        "jax": f", a ball served {options.serve_delay} of its frames after a point; where objects "
        "are is exact.",
        "ale": " (`ALE/Pong-v5`, no action repeated at random), its screen reduced to the field; "
        "objects are told by their colours.",
    }[options.game]
    shades = (
        " A predicted pixel is taken for a mixture of the background and that object with which it "
        "comes closest, and is lit from one half on. Our model sees the same frames; what it takes "
        "from them is where each colour is."
    )
    return (
        f"{counted(options.seeds)} of {GAMES_SAID[options.game]}{game} Frames of {height}x{width}, "
        f"{SEEN_SAID[options.frames]}. A model, four frames and the action in, the next frame out, "
        f"is trained on {options.episodes} episodes of {options.steps} steps of one policy. The "
        "mixed one is of players that follow the ball with a share of their actions that is drawn "
        "for each episode, and act at random with the others. All are judged on "
        f"{options.held_out} new episodes of the mixed policy: the share of an object's pixels "
        "that are predicted to be lit (recall), and of the pixels lit as its that are its "
        f"(precision; - where none is lit).{shades if options.frames == 'rgb' else ''} Mean over "
        "runs and 95% interval."
    )


REPORT = FrameReport(
    about=about, said=SAID, stage="policy", classes=tuple(OBJECTS), scores=("recall", "precision"),
    prefer=lambda options, stages: "mixed" if "mixed" in stages else stages[0],
    filmed=("ours", "adversarial", "l2"), seen=seen,
)  # fmt: skip


def blur(record: Record) -> str:
    """How sharp the beliefs are, and Fig. 9 by policy."""
    models, main = REPORT.models(record), REPORT.compared(record)[0]
    drawn = [
        REPORT.grid(
            record, "fig9.png" if policy == main else f"fig9_{policy}.png",
            {arm: stages[policy] for arm, stages in models.items() if policy in stages},
            f"Fig. 9 after the {policy} policy: input, truth, belief and error of a step",
        )
        for policy in dict.fromkeys([main, *(policy for arm in models.values() for policy in arm)])
    ]  # fmt: skip
    return report.paragraphs(
        "## Blur",
        "Believed: how sure the model is of a pixel that shows the object, 1 at best. Spilled: "
        "what it believes of the object anywhere else in the frame, for each such pixel, 0 at "
        "best.",
        markdown_table(*REPORT.score_table(record, ("believed", "spilled"))),
        *drawn,
        COLOURS_SAID if record.options.frames == "objects" else "Errors are on black.",
    )


def before_serves(record: Record) -> str:
    """Scores of the dreams within which nothing is random."""
    return report.paragraphs(
        "Which way a ball is served is random: where a serve lies within the dream, no model can "
        "know the rest. The same of those dreams within which no ball is served up to that step:",
        markdown_table(*REPORT.dream_table(record, "_apart")),
    )


TUNED = PongFrames()
LEAN = changed(TUNED, {"preset": "lean", "arms": ("ours",)})
QUICK = {
    "seeds": 2, "episodes": 20, "steps": 100, "widths": (8, 8, 8), "dense": 64,
    "hidden": (128, 128), "held_out": 5, "horizon": 20, "dreams": 3,
    "paper": Training(200, 0, 16, 2e-3, 0.0, None), "ours": Training(1000, 0, 64, 2e-3, 0.1, None),
}  # fmt: skip
FRAMES = Experiment(
    name="frames",
    title="Pong: predicting frames (Fig. 9)",
    presets={"tuned": TUNED, "lean": LEAN},
    quick=dict.fromkeys(("tuned", "lean"), QUICK),
    arms=arms,
    describe=(REPORT.describe,),
    sections=(
        REPORT.opening, blur, REPORT.dreams, before_serves, report.arms_said(SAID),
        report.settings, report.spent,
    ),
    summary=REPORT.summary,
)  # fmt: skip
