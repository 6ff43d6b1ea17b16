"""Predicting Pong's frames (§4.3, Fig. 9): the paper's models beside one that does not blur."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna import losses, models
from jaxdyna.envs import AtariPong
from jaxdyna.envs.pong_screen import in_channels, mixture_of, shares_of
from jaxdyna.experiments.engine import Arm, Experiment, Record, Runs, Work
from jaxdyna.experiments.frames.report import FrameReport
from jaxdyna.experiments.frames.training import FrameOptions, Training, frame_arms, frame_work
from jaxdyna.experiments.frames.worlds import Asked, Stage, World
from jaxdyna.experiments.pong import world
from jaxdyna.experiments.pong.data import Played, collect, play, screens, states, take
from jaxdyna.experiments.pong.trained import kept
from jaxdyna.experiments.pong.world import OBJECTS, PALETTES
from jaxdyna.experiments.report import frames as pictures, sections as report, tables
from jaxdyna.fields import changed, setting
from jaxdyna.networks import SignedReward
from jaxdyna.types import DynamicsModel, Key, Transition

Policy = Literal["random", "mixed"]
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
class PongFrames(world.GameOptions, FrameOptions):
    """Action-conditional frame prediction in Pong: the paper's Fig. 9 in numbers."""

    decided: ClassVar = FrameOptions.decided | {
        f"{model}.{name}": "the experiment, whose models predict frames alone"
        for model in ("paper", "ours") for name in ("rare_share", "reward_weight")}  # fmt: skip
    dream_from: ClassVar = 10

    arms: tuple[str, ...] = setting(tuple(SAID), "the models that are trained", everyday=True)
    episodes: int = setting(1000, "of each policy, to learn from", at_least=1, everyday=True)
    policies: tuple[Policy, ...] = setting(
        ("random", "mixed"), "whose episodes: random: every action at random; mixed: players of "
        "all strengths, from random ones to one that follows the ball", everyday=True)  # fmt: skip
    steps: int = setting(
        200, "steps of an episode; 21 points take longer", at_least=1, at_most=700, everyday=True
    )
    dreams: int = setting(8, "dreams in each held-out episode", at_least=1, at_most=1000)
    keep: bool = setting(
        False, "whether models predict rewards as well, and are kept in curves.npz, for learning "
        "to play in them (--models)")  # fmt: skip
    paper: Training = setting(factory=lambda: Training(6000, 0, 32, 4e-3, 0.0, None),
                              help="training of Fig. 4")  # fmt: skip
    ours: Training = setting(factory=lambda: Training(6000, 0, 256, 2e-3, 0.1, None),
                             help="training of ours")  # fmt: skip


def arms(options: PongFrames) -> dict[str, Callable[[], Arm]]:
    """Every model, trained on the episodes of each policy."""
    parts = {str(one): (int(one == "mixed"), options.episodes) for one in options.policies}
    trained = {arm: "ours" if arm == "ours" else "paper" for arm in SAID}
    return frame_arms(options, trained, work, lambda arm: parts)


@cache
def work(options: PongFrames, arm: str) -> Work:
    """A model's training: one object, and so one program, for the same settings."""
    batch = (options.ours if arm == "ours" else options.paper).batch

    def adversarial(rate: Any) -> models.AdversarialHParams:
        return models.AdversarialHParams(rate, options.adversarial_weight, rate)

    rates: Any = adversarial if arm == "adversarial" else models.PixelHParams
    made = frame_work(options, world_of(options), *asked(options, arm), batch, rates)
    return kept(made) if options.keep else made


def asked(options: PongFrames, arm: str) -> tuple[DynamicsModel, Asked]:
    """The arm's model, and what is asked of it."""
    game = world.game_of(options)
    palette, actions = game.palette, game.num_actions
    config: Any = world.our_model(options, options.ours.weight_decay)
    if arm != "ours":
        lit = arm == "bce" and options.frames == "objects"
        more: Any = {"threshold": 0.2, "shades": False} if lit else {}
        if options.keep:
            more |= {"reward": SignedReward(), "reward_weight": options.reward_weight}
        loss = {"l1": losses.l1, "bce": losses.bce}.get(arm, losses.l2)
        config = world.paper_model(options, options.paper.weight_decay, loss, **more)
    model = world.model_of(game, config, arm == "adversarial")
    rules = (("lit", model.predict),)
    if arm == "ours":
        knows = models.rectangle_probability(game.frame_shape, actions, config)

        def believe(params: Any, obs: jax.Array, action: jax.Array) -> jax.Array:
            return knows(params, in_channels(obs, palette), action)

        return model, Asked(
            believe, rules, 0.5, options.keep,
            picture=lambda *args: mixture_of(believe(*args), palette) / 255)  # fmt: skip
    frame = models.frame_probability(actions, config)
    return model, Asked(
        lambda *args: shares_of(255 * frame(*args), palette), rules, config.threshold, options.keep,
        picture=frame)  # fmt: skip


@cache
def world_of(options: PongFrames) -> World:
    """The game's episodes, by a key the same in all arms; the real game's are collected once."""
    real, game = options.game == "ale", world.game_of(options)
    steps, palette = options.steps, PALETTES[options.frames]
    rules = replace(world.RULES, max_steps=steps)
    source = screens(game, steps) if isinstance(game, AtariPong) else states(game, rules)

    def of_a_run(play: Callable[..., Played], mixed: Any, key: Key) -> tuple[Played, Played]:
        key_random, key_mixed, key_new = jax.random.split(key, 3)
        key_learn = jax.random.clone(jnp.where(mixed, key_mixed, key_random))  # used once only
        learned = play(source, steps, options.episodes, mixed, key_learn)
        return learned, play(source, steps, options.held_out, True, key_new)

    @cache
    def of_runs(runs: tuple[tuple[int, bool], ...], base: int) -> tuple[Played, Played]:
        first = jax.random.key(base)
        each = [of_a_run(collect, mixed, jax.random.fold_in(first, seed)) for seed, mixed in runs]
        return jax.tree.map(lambda *leaves: np.stack(leaves), *each)

    def gather(runs: Runs) -> tuple[Played, Played]:
        mixed = map(bool, runs.hparams.part.tolist())
        return of_runs(tuple(zip(runs.seed.tolist(), mixed, strict=True)), runs.base)

    def data(key: Key, _: Key, stage: Stage) -> tuple[Played, Played]:
        return of_a_run(play, stage.part == 1, key)

    def draw(data: Any, key: Key, stage: Stage, size: int) -> Transition:
        key_episode, key_time = jax.random.split(key)
        episode = jax.random.randint(key_episode, (size,), 0, options.episodes)
        return take(source, data[0], episode, jax.random.randint(key_time, (size,), 0, steps))

    def look(data: Any, episode: Any, times: jax.Array) -> Transition:
        return take(source, data[1], jnp.full(times.shape, episode), times)

    def truth(data: Any, episode: Any, times: jax.Array) -> jax.Array:
        there = jax.tree.map(lambda leaf: leaf[episode, times + 1], data[1].world)
        return jax.vmap(source.objects)(there)

    room, gaps = steps - options.horizon - options.dream_from, max(options.dreams - 1, 1)
    return World(
        None if real else data, draw, look, truth, options.held_out, steps,
        tuple(options.dream_from + room * number // gaps for number in range(options.dreams)),
        options.horizon, tuple(OBJECTS.values()), lambda data: _example(options, truth, data),
        shares=lambda frames: shares_of(frames, palette),
        apart=lambda truth: unserved(truth[..., OBJECTS["ball"]]),
        film=_longest_flight, collect=gather if real else None)  # fmt: skip


def unserved(ball: jax.Array) -> jax.Array:
    """Whether no new ball has been served up to a step, bool ``[episodes, T]``, from where the ball
    is, bool ``[episodes, T + 1, H, W]``: a new one was not there, or is an eighth of the field off.
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
    """The step of the last episode in which the own paddle moves most, all objects in sight."""
    episode = options.held_out - 1
    there = truth(data, episode, jnp.arange(-1, options.steps))
    after, before = there[1:], there[:-1]
    whole = (after.sum((1, 2)) >= jnp.median(after.sum((1, 2)), axis=0)).all(-1)
    moved = (after ^ before)[..., OBJECTS["own paddle"]].sum((1, 2))
    return episode, jnp.argmax(jnp.where(whole & before.any((1, 2)).all(-1), moved, -1))


def seen(options: PongFrames, stack: np.ndarray) -> np.ndarray:
    """A stack as one picture in [0, 1], the older frames fainter."""
    palette = PALETTES[options.frames]
    channels = in_channels(jnp.asarray(stack), palette)
    faint = jnp.asarray(pictures.trail(np.asarray(channels) / 255))
    return np.asarray(mixture_of(faint, palette)) / 255


def about(record: Record) -> str:
    """What was done."""
    options: PongFrames = record.options
    serves = f", a ball served {world.SERVE_DELAY} of its frames after a point"
    shades = (
        " A predicted pixel is taken for a mixture of the background and that object with which it "
        "comes closest, and is lit from one half on. Our model sees the same frames; what it takes "
        "from them is where each colour is."
    )
    return (
        f"{tables.runs(options.seeds)} of {world.GAMES_SAID[options.game]}"
        f"{serves if options.game == 'jax' else ''}. Frames are {world.seen_said(options)}. A "
        "model, four frames and the action in, the next frame out, is trained on "
        f"{options.episodes} episodes of {options.steps} steps of one policy. The mixed one is of "
        "players that follow the ball with a share of their actions that is drawn for each "
        f"episode, and act at random with the others. All are judged on {options.held_out} new "
        "episodes of the mixed policy: the share of an object's pixels that are predicted to be "
        "lit (recall), and of the pixels lit as its that are its (precision; - where none is "
        f"lit).{shades if options.frames == 'rgb' else ''} Mean over runs and 95% interval."
    )


REPORT = FrameReport(
    about=about, said=SAID, stage="policy", classes=tuple(OBJECTS), scores=("recall", "precision"),
    kinds=("point lost", "point won", "neither"),
    prefer=lambda options, stages: "mixed" if "mixed" in stages else stages[0],
    filmed=("ours", "adversarial", "l2"), seen=seen)  # fmt: skip


def blur(record: Record) -> str:
    """How sharp the beliefs are, and Fig. 9 by policy."""
    by_policy, main = report.grouped(record, "setting", "arm"), REPORT.compared(record)[0]
    drawn = [
        REPORT.grid(record, "fig9.png" if policy == main else f"fig9_{policy}.png",
                    by_policy[policy],
                    f"Fig. 9 after the {policy} policy: input, truth, belief and error of a step")
        for policy in sorted(by_policy, key=lambda policy: policy != main)]  # fmt: skip
    return report.paragraphs(
        "## Blur",
        "Believed: how sure the model is of a pixel that shows the object, 1 at best. Spilled: "
        "what it believes of the object anywhere else in the frame, for each such pixel, 0 at "
        "best.",
        tables.markdown_table(*REPORT.score_table(record, ("believed", "spilled"))),
        *drawn,
        world.COLOURS_SAID if record.options.frames == "objects" else "Errors are on black.",
    )


def rewards(record: Record) -> str:
    """How many are predicted right; empty where none are."""
    return REPORT.rewards(record) if record.options.keep else ""


def before_serves(record: Record) -> str:
    """Scores of the dreams within which nothing is random."""
    return report.paragraphs(
        "Which way a ball is served is random: where a serve lies within the dream, no model can "
        "know the rest. The same of those dreams within which no ball is served up to that step:",
        tables.markdown_table(*REPORT.dream_table(record, "_apart")),
    )


TUNED = PongFrames(horizon=30)
LEAN = changed(TUNED, {"preset": "lean", "arms": ("ours",)})
QUICK = {
    "seeds": 2, "episodes": 20, "steps": 100, "widths": (8, 8, 8), "dense": 64,
    "hidden": (128, 128), "held_out": 5, "horizon": 20, "dreams": 3,
    "paper": Training(200, 0, 16, 2e-3, 0.0, None), "ours": Training(1000, 0, 64, 2e-3, 0.1, None),
}  # fmt: skip
FRAMES = Experiment(
    name="frames", title="Pong: predicting frames (Fig. 9)", arms=arms,
    presets={"tuned": TUNED, "lean": LEAN}, quick=dict.fromkeys(("tuned", "lean"), QUICK),
    describe=(REPORT.describe,),
    sections=(REPORT.opening, REPORT.training, blur, REPORT.dreams, before_serves, rewards,
              report.arms_said(SAID), report.settings, report.spent))  # fmt: skip
