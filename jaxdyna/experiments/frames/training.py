"""Training a frame model as work, whose unit is a gradient step."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from jaxdyna.dyna.conditional import unknown
from jaxdyna.dyna.loop import DIVERGED
from jaxdyna.experiments.engine import Arm, Work
from jaxdyna.experiments.frames import judging
from jaxdyna.experiments.frames.options import Training
from jaxdyna.experiments.frames.worlds import Asked, Stage, World
from jaxdyna.fields import changed
from jaxdyna.models import PixelHParams
from jaxdyna.trees import finite, where_needed
from jaxdyna.types import DynamicsModel, Key

PIECE = 100
LOOKED_AT = 16  #: steps of each new episode whose loss is looked at
LOOKS = 2**32 - 1  #: folded into a run's key: no gradient step has this number


@struct.dataclass
class Learner:
    """A run between two gradient steps: the key that all of them use, and the model's state."""

    key: Key
    model: Any


@cache
def frame_work(
    world: World, model: DynamicsModel, asked: Asked, batch: int, block: int = 1,
    hparams_of: Callable[[Any], Any] = PixelHParams, loss_every: int = 0,
) -> Work:  # fmt: skip
    """A model's training on batches of so many transitions, and its judging on new episodes. A
    run's key gives all models and stages the same episodes; ``hparams_of`` makes the model's
    hparams of a learning rate. Every ``loss_every`` gradient steps, if any, ``new_loss`` and
    ``old_loss`` are those of a frame on as many transitions that are never trained on, and that
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
        if loss_every:
            look = partial(losses_of, learner, data, stage)
            due = (number + 1) % loss_every == 0
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
        ask(judging.show), PIECE, block)  # fmt: skip


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
