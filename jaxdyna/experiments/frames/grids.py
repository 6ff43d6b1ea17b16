"""Frame models of small grids that are seen from above: a class a channel, lit or not."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp

from jaxdyna.envs import FrameStack
from jaxdyna.experiments.engine import Arm, Experiment, Work
from jaxdyna.experiments.frames.report import FrameReport
from jaxdyna.experiments.frames.training import FrameOptions, Training, frame_arms, frame_work
from jaxdyna.experiments.frames.worlds import Asked, Stage, World
from jaxdyna.fields import SettingError, setting
from jaxdyna.losses import bce, l1, l2
from jaxdyna.models import PixelConfig, frame_probability, pixels
from jaxdyna.networks import EncoderDecoder, JointReward, LocalDynamics, LocalReward
from jaxdyna.optimizers import decayed_adam
from jaxdyna.replay import frames as frame_replay
from jaxdyna.replay.frames import FrameReplay
from jaxdyna.replay.ring import share_weight
from jaxdyna.rollout import rollout
from jaxdyna.types import Key, Transition

FAINT = 0.05
#: what the models are
SAID = {
    "paper": "Fig. 4 with the multi-label cross-entropy. Not in the paper: the number of channels "
    "(the authors' code has 128), weight decay and the cosine, an action's factor of the product "
    "that starts scattered around 1, nothing nonlinear between the dense layers and the product.",
    "paper_l2": "the same under L2.",
    "paper_l1": "the same under L1.",
    "paper_reward": "the same as `paper` with a reward head.",
    "lean": "ours: convolutions throughout.",
    "lean_l2": "the same under L2.",
    "lean_l1": "the same under L1.",
}
#: as which of them they are trained: ``paper`` or ``lean``
TRAINED = {arm: arm.partition("_")[0] for arm in SAID}


@dataclass(frozen=True, kw_only=True)
class GridOptions(FrameOptions, ABC):
    """Frame models of a grid; a subclass has its `world`."""

    #: the reward head of our models: joint, off the features of stack and action; local, a sum over
    #: cells of the predicted frame
    own_head: ClassVar[Literal["joint", "local"]] = "local"
    channels: ClassVar[tuple[int, ...]] = (0, 1, 2)  #: see `World`

    arms: tuple[str, ...] = setting(("paper", "lean"), "the models that are trained", everyday=True)
    episodes: int = setting(300, "episodes of the random policy at the most", at_least=1,
                            everyday=True)  # fmt: skip
    stages: tuple[int, ...] = setting(
        (10, 30, 100, 300), "after how many of them a model is trained, from scratch, and judged; "
        "those above --episodes are left out", at_least=1, everyday=True)  # fmt: skip
    ablation_stage: int = setting(
        100, "the stage at which losses are compared, the only one of models with another loss",
        at_least=1, everyday=True)  # fmt: skip
    widths: tuple[int, int, int] = setting((32, 32, 32), "channels of the paper's convolutions",
                                           at_least=1)  # fmt: skip
    kernels: tuple[int, int, int] = setting((5, 4, 4), "cells a side of their kernels", at_least=1)
    dense: int = setting(1024, "width of the paper's dense layer", at_least=1)
    lean_widths: tuple[int, ...] = setting((32, 32, 32), "channels of our 3x3 convolutions",
                                           at_least=1)  # fmt: skip
    paper: Training = setting(factory=lambda: Training(8000, 40, 32, 3e-3, 0.4, None),
                              help="of the paper's model")  # fmt: skip
    lean: Training = setting(factory=Training, help="of ours")

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(set(self.stages)) < len(self.stages):
            raise SettingError("stages", "names one twice: name each once")
        if not self.played:
            said = f"--episodes is {self.episodes}, less than the first of --stages: raise it"
            raise ValueError(said)
        env, params = self.world()
        side = min(env.observation_space(params).shape[:2])
        if any(arm.startswith("paper") for arm in self.arms) and sum(self.kernels) - 3 >= side:
            raise ValueError(
                f"--kernels {self.kernels} leave nothing of a world of {side} cells a side: "
                "give smaller ones, or a larger world"
            )

    @property
    def played(self) -> list[int]:
        """The stages within ``episodes``, in order."""
        return sorted({stage for stage in self.stages if stage <= self.episodes})

    @abstractmethod
    def world(self) -> tuple[FrameStack, Any]:
        """The environment, its frames stacked, and its params: what ends in ``_reward`` is one."""


def experiment(
    title: str, presets: Mapping[str, GridOptions], quick: Mapping[str, Any], **report: Any
) -> Experiment:
    """A grid's experiment; ``report`` is what it says of itself, see `FrameReport`."""
    rules = {"lit": "threshold", "drawn": "drawing"}
    said = FrameReport(said=SAID, prefer=near, rules=rules, **report)
    return Experiment(
        name="frames", title=title, presets=presets, arms=arms, quick=quick,
        describe=(said.describe,), sections=said.sections)  # fmt: skip


def arms(options: GridOptions) -> dict[str, Callable[[], Arm]]:
    """Every model at every stage; one with another loss at that of the ablation alone."""

    def parts(arm: str) -> dict[str, tuple[int, int]]:
        played = options.played if arm == TRAINED[arm] else [near(options, options.played)]
        return {str(stage): (stage, stage) for stage in played}

    return frame_arms(options, TRAINED, work, parts)


def near(options: GridOptions, stages: Any) -> Any:
    """The stage nearest to that at which losses are compared."""
    at = options.ablation_stage
    return min(stages, key=lambda stage: abs(int(str(stage).split(",")[0]) - at))


@cache
def work(options: GridOptions, arm: str) -> Work:
    """A model's training: one object, and so one program, for the same settings."""
    env, params = options.world()
    config, shape = config_of(options, arm), env.env.observation_space(params).shape
    model, drawing = (
        pixels(shape, env.num_actions, each) for each in (config, replace(config, threshold=None))
    )
    believe = frame_probability(env.num_actions, config)
    rules = (("lit", model.predict), ("drawn", drawing.predict))
    asked = Asked(believe, rules, config.threshold or 0.5, config.reward is not None)
    training: Training = getattr(options, TRAINED[arm])
    world = random_episodes(options, training.rare_share)
    return frame_work(options, world, model, asked, training.batch)


def config_of(options: GridOptions, arm: str) -> PixelConfig:
    """The model of this arm. The paper's threshold of 0.2 serves its cross-entropy; 0.5 serves
    ours, and L1 and L2, whose outputs are no probabilities.
    """
    papers, training = TRAINED[arm] == "paper", getattr(options, TRAINED[arm])
    loss = {"l1": l1, "l2": l2}.get(arm.partition("_")[2], bce)
    network: Any = LocalDynamics(3, options.lean_widths)
    head: Any = JointReward() if options.own_head == "joint" else LocalReward()
    if papers:
        network = EncoderDecoder(3, options.widths, options.kernels, options.dense)
        head = JointReward() if arm == "paper_reward" else None
    return PixelConfig(
        network, loss, 0.2 if papers and loss is bce else 0.5, head, training.reward_weight,
        optimizer=decayed_adam(training.weight_decay))  # fmt: skip


@cache
def random_episodes(options: GridOptions, rare_share: float | None) -> World:
    """A uniformly random policy's episodes, all of which last ``options.steps``; a stage's part is
    how many of them, the first, are learned from.
    """
    env, params = options.world()
    smallest = [abs(value) for name, value in vars(params).items() if name.endswith("_reward")]

    def act(obs: jax.Array, key: Key) -> jax.Array:
        return jax.random.randint(key, (), 0, env.num_actions)

    def play(key: Key, episodes: int) -> Transition:
        return rollout(env, act, key, params, episodes, num_steps=options.steps)

    def data(key: Key, key_new: Key, stage: Stage) -> Any:
        whole = collected(lambda key: play(key, 1), key, options.episodes, options.steps)
        count = jnp.asarray(stage.part, jnp.int32)  # all last to their horizon
        held = replace(whole, added=count * options.steps, episodes_added=count)
        reward = held.rest["reward"]
        weight = share_weight(held.held, jnp.stack([reward < 0, reward > 0]), rare_share)
        return held, weight, play(key_new, options.held_out)

    def sample(data: Any, key: Key, stage: Stage, size: int) -> Transition:
        return frame_replay.sample(data[0], key, (size,), data[1])

    def take(data: Any, episode: Any, times: jax.Array) -> Transition:
        return jax.tree.map(lambda leaf: leaf[episode, times], data[2])

    def truth(data: Any, episode: Any, times: jax.Array) -> jax.Array:
        return take(data, episode, times).next_obs[..., -3:] > 0

    return World(
        data, sample, take, truth, options.held_out, options.steps, (options.dream_from,),
        options.horizon, options.channels, lambda data: (0, max(options.dream_from - 1, 0)),
        faint=FAINT, tolerance=min(filter(None, smallest), default=1.0) / 2)  # fmt: skip


def collected(play: Callable[[Key], Any], key: Key, episodes: int, steps: int) -> FrameReplay:
    """A replay of so many episodes, which ``play`` makes one by one."""
    shapes = jax.eval_shape(play, key)
    example = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[2:], leaf.dtype), shapes)
    empty = frame_replay.init(episodes * steps, episodes, example)

    def more(carry: tuple[FrameReplay, Key], _: None) -> tuple[tuple[FrameReplay, Key], None]:
        held, key = carry
        key, key_play = jax.random.split(key)
        return (frame_replay.add(held, play(key_play)), key), None

    return jax.lax.scan(more, (empty, key), length=episodes)[0][0]
