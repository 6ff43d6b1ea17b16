"""Training a frame model: its settings, and the work, whose unit is a gradient step."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from flax import struct

from jaxdyna.dyna.conditional import unknown
from jaxdyna.dyna.loop import DIVERGED
from jaxdyna.experiments.engine import Arm, Options, Work
from jaxdyna.experiments.frames import judging
from jaxdyna.experiments.frames.worlds import Asked, Stage, World
from jaxdyna.fields import Checked, SettingError, changed, setting
from jaxdyna.models import PixelHParams
from jaxdyna.trees import finite, where_needed
from jaxdyna.types import DynamicsModel, Key

PIECE = 100
LOOKED_AT = 16  #: steps of each new episode whose loss is looked at
LOOKS = 2**32 - 1  #: folded into a run's key: no gradient step has this number


@dataclass(frozen=True)
class Training(Checked):
    """How a model is trained, from scratch at each stage."""

    updates: int = setting(5000, "gradient steps, however few the episodes", at_least=1)
    updates_per_episode: float = setting(0.0, "gradient steps more for each episode of data",
                                         at_least=0)  # fmt: skip
    batch: int = setting(32, "transitions in a gradient step", at_least=1)
    learning_rate: float = setting(5e-3, "Adam's at the start; it falls to 0 along half a cosine",
                                   above=0)  # fmt: skip
    weight_decay: float = setting(0.0, "of AdamW (Loshchilov and Hutter 2019); 0 is Adam",
                                  at_least=0)  # fmt: skip
    rare_share: float | None = setting(
        0.5, "at least this share of a batch are steps with a reward below or above 0, half each "
        "where there are both; None: as they come", at_least=0, at_most=1)  # fmt: skip
    reward_weight: float = setting(1.0, "of the reward's squared error beside the frame's loss",
                                   at_least=0)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class FrameOptions(Options):
    """What every experiment on frames can be told."""

    decided: ClassVar = {"stop_after_solved": "the model's updates"}
    dream_from: ClassVar[int] = 0  #: step of a held-out episode from which models dream

    steps: int = setting(200, "steps of an episode", at_least=1, everyday=True)
    stop_after_solved: int | None = setting(None, "nothing is solved")
    held_out: int = setting(20, "new episodes that models are judged on", at_least=1, everyday=True)
    loss_every: int = setting(
        0, "gradient steps from one look at the loss, on new and on old episodes, to the next; 0 "
        "never looks", at_least=0)  # fmt: skip
    horizon: int = setting(50, "steps of an open-loop dream", at_least=1, everyday=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.dream_from + self.horizon > self.steps:
            raise SettingError(
                "horizon", f"is {self.horizon}: {self.dream_from} steps and it, where dreams end, "
                f"must be at most an episode's {self.steps} steps")  # fmt: skip


@struct.dataclass
class Learner:
    """A run between two gradient steps: the key that all of them use, and the model's state."""

    key: Key
    model: Any


def frame_work(
    options: FrameOptions, world: World, model: DynamicsModel, asked: Asked, batch: int,
    hparams_of: Callable[[Any], Any] = PixelHParams,
) -> Work:  # fmt: skip
    """A model's training on batches of so many transitions, and its judging on new episodes. A
    run's key gives all models and stages the same episodes; ``hparams_of`` makes the model's
    hparams of a learning rate. Every ``options.loss_every`` gradient steps, if any, ``new_loss``
    and ``old_loss`` are those of a frame on as many transitions that are never trained on, and that
    are, the same ones each time; NaN between.
    """

    def init(key: Key, stage: Stage) -> Learner:
        key, key_init = jax.random.split(key)
        return Learner(jax.random.split(key)[0], model.init(key_init, hparams_of(0.0)))

    def data(key: Key, stage: Stage) -> Any:
        key, _, key_data = jax.random.split(key, 3)
        key_new = jax.random.split(jax.random.split(key)[1])[0]
        return world.data(key_data, key_new, stage)  # type: ignore[misc]

    def step(learner: Learner, data: Any, number: jax.Array, stage: Stage) -> Any:
        key = jax.random.fold_in(jax.random.clone(learner.key), number)
        key_sample, key_update = jax.random.split(key)
        transitions = world.sample(data, key_sample, stage, batch)
        looked = {}
        if options.loss_every:
            look = partial(losses_of, learner, data, stage)
            due = (number + 1) % options.loss_every == 0
            looked = where_needed(due, look, unknown(jax.eval_shape(look)))
        rate = 0.5 * (1 + jnp.cos(jnp.pi * number / stage.updates)) * stage.learning_rate
        state, losses = model.update(learner.model, transitions, key_update, hparams_of(rate))
        broken = jnp.where(finite(losses["loss"]), 0.0, 1.0 + DIVERGED.index("model"))
        return replace(learner, model=state), looked | {
            "show_frame_loss": losses["frame_loss"], "diverged": broken}  # fmt: skip

    def losses_of(learner: Learner, data: Any, stage: Stage) -> dict[str, jax.Array]:
        keys = jax.random.split(jax.random.fold_in(jax.random.clone(learner.key), LOOKS), 4)
        shape = (world.episodes, LOOKED_AT)
        times = jax.random.randint(keys[0], shape, 0, world.steps)
        new = jax.vmap(partial(world.take, data))(jnp.arange(world.episodes), times)
        old = world.sample(data, keys[1], stage, times.size)

        def loss(of: Any, key: Key) -> jax.Array:
            return model.update(learner.model, of, key, hparams_of(0.0))[1]["frame_loss"]

        return {"new_loss": loss(new, keys[2]), "old_loss": loss(old, keys[3])}

    def ask(about: Callable[..., judging.Judgement]) -> Any:
        return lambda learner, data, key, _: about(world, asked, learner.model.params, data, key)

    return Work(
        init, step, data if world.data else None, world.collect, ask(judging.judge),
        ask(judging.show), PIECE, options.block)  # fmt: skip


def frame_arms(
    options: Any, models: Mapping[str, str], work: Callable[[Any, str], Work],
    parts: Callable[[str], Mapping[str, tuple[int, int]]],
) -> dict[str, Callable[[], Arm]]:  # fmt: skip
    """Every model at each of its stages: ``models`` says by name which of the options is their
    `Training`, ``work`` makes it of the options, without what `Stage` holds of them, and ``parts``
    says of a model by stage `Stage.part` and how many episodes that are.
    """
    alike = {"updates": 1, "updates_per_episode": 0.0, "learning_rate": 1.0}
    overrides = {f"{of}.{name}": alike[name] for of in models.values() for name in alike}
    program = changed(options, overrides)

    def arm(model: str, part: int, episodes: int) -> Arm:
        training: Training = getattr(options, models[model])
        updates = training.updates + round(training.updates_per_episode * episodes)
        return Arm(work(program, model), Stage(part, updates, training.learning_rate), updates)

    return {
        f"{model}@{stage}": partial(arm, model, *part)
        for model in models for stage, part in parts(model).items()}  # fmt: skip
