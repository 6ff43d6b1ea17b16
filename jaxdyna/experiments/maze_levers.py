"""The ``lean`` preset in the Maze, one thing changed at a time: what it needs, what a worse model
costs, and whether sample efficiency grows with the model's accuracy (§5).

``python -m jaxdyna.experiments.maze_levers``
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna.envs import FrameStack, Maze, MazeParams
from jaxdyna.envs.maze import MOVES
from jaxdyna.experiments.accuracy import AccuracyReport, Measure, judged_on
from jaxdyna.experiments.maze_train import make_arms
from jaxdyna.experiments.maze_train_options import LEAN, Options
from jaxdyna.experiments.run import Arm
from jaxdyna.experiments.variants import Curves, VariantOptions, Variants
from jaxdyna.rollout import rollout
from jaxdyna.types import Key, Transition

OTHER = "agent: "
DRIFT = (0.1, 0.35, 0.35, 0.1, 0.1)
JUDGED = 2


@dataclass(frozen=True)
class LeverOptions(VariantOptions):
    """Many variants of one setup, each beside the setup itself, on a smaller board that carries
    them all in two hours; the Maze's own has --size 16 --obstacles 5 --steps 200."""

    size: int = 8
    """Cells a side of the board."""
    obstacles: int = 3
    """How many obstacles."""
    steps: int = 60
    """Steps of a real episode."""


def levers(options: LeverOptions) -> dict[str, Arm]:
    """Every variant by name, the preset itself first."""
    board = {name: getattr(options, name) for name in ("size", "obstacles", "steps")}
    base = replace(LEAN, seeds=options.seeds, episodes=options.episodes, **board)
    common = common_transitions(base)
    models = {"dyna (lean preset)": base, **worse_models(base)}
    arms = {name: make_arms(variant)["dyna"] for name, variant in models.items()}
    for name, variant in other_dreams(base).items():
        arms[OTHER + name] = make_arms(variant)["dyna"]
    controls = make_arms(base)
    arms |= {
        "untrained model (placebo)": controls["placebo"],
        "true environment as the model": controls["oracle"],
        "model-free": controls["model_free"],
        "model-free, as many updates": controls["more_updates"],
    }
    return judged_on(common, arms)


def worse_models(base: Options) -> dict[str, Options]:
    """What changes the model alone."""
    variants = {
        "model: L2 loss": replace(base, model_loss="l2"),
        "model: L1 loss": replace(base, model_loss="l1"),
        "model: rare steps as they come": replace(base, rare_share=None),
    }
    for widths in ((4, 4), (32,)):
        variants[f"model: layers of {widths}"] = replace(base, model_widths=widths)
    for updates in (10, 3):
        variants[f"model: {updates} updates an episode"] = replace(base, model_updates=updates)
    return variants


def other_dreams(base: Options) -> dict[str, Options]:
    """What changes how dreams are used, or the agent, with the same model."""
    steps = base.dream_episodes * base.dream_steps
    variants = {f"N = {first}": replace(base, real_first=first) for first in (5, 30)}
    for length in (1, 20):
        changed = replace(base, dream_steps=length, dream_episodes=steps // length)
        variants[f"dreams of {length} step(s), as many steps"] = changed
    for count in (100, 1600):
        name = f"{count} dreams an episode, not {base.dream_episodes}"
        kept = base.agent.fake_capacity * count // base.dream_episodes
        variants[name] = replace(_agent(base, fake_capacity=kept), dream_episodes=count)
    for share in (0.25, 0.9):
        variants[f"{share:.0%} of a batch dreamed"] = _agent_hparams(base, fake_share=share)
    for updates in (100, 800):
        name = f"{updates} updates on dreams to {base.agent.updates} on real steps"
        variants[name] = _agent(base, fake_updates=updates)
    doubt = replace(base.hparams, disagreement_threshold=0.5)
    return variants | {
        "dreams broken off where half a pixel is in doubt": replace(base, hparams=doubt),
        "the agent learns from the newest 10 real episodes only": _agent(
            base, capacity=10 * base.steps
        ),
        "model and dreams know the newest 10 real episodes only": replace(
            base, replay_capacity=10 * base.steps
        ),
        "dreams of the newest 2 real episodes only": _agent(
            base, fake_capacity=2 * base.dream_episodes * base.dream_steps
        ),
    }


def _agent(base: Options, **changes: Any) -> Options:
    return replace(base, agent=replace(base.agent, **changes))


def _agent_hparams(base: Options, **changes: Any) -> Options:
    agent = replace(base.hparams.agent, **changes)
    return replace(base, hparams=replace(base.hparams, agent=agent))


def common_transitions(options: Options) -> Transition:
    """The same new transitions for every model, ``[2 * JUDGED, T]``: episodes of a uniformly random
    policy, and of one that drifts to the goal.
    """
    env = FrameStack(Maze(options.size, options.obstacles))
    params = MazeParams(max_steps=options.steps)

    def play(key: Key, odds: jax.Array) -> Transition:
        def act(obs: jax.Array, key: Key) -> jax.Array:
            return jax.random.categorical(key, jnp.log(odds))

        return rollout(env, act, key, params, JUDGED, num_steps=options.steps)

    keys = jax.random.split(jax.random.key(2**20), 2)
    odds = jnp.array([len(MOVES) * [1 / len(MOVES)], DRIFT])
    played = jax.jit(jax.vmap(play))(keys, odds)
    return jax.tree.map(lambda leaf: np.asarray(leaf).reshape(-1, *leaf.shape[2:]), played)


def wrong_frames(metrics: Curves, judged: slice) -> np.ndarray | None:
    """The share of frames predicted wrong, ``[seeds]``; None without a model."""
    return metrics["wrong_frames"][:, judged].mean(1) if "wrong_frames" in metrics else None


MEASURE = Measure(
    error=wrong_frames,
    episodes=35,
    axis="share of frames predicted wrong (logarithmic)",
    said="The error is the share of frames that are predicted wrong anywhere, one step ahead. "
    "Every model is judged on the same new episodes: half of a uniformly random policy, half of "
    "one that drifts to the goal.",
    lines=("true environment as the model", "model-free", "model-free, as many updates"),
    hollow=OTHER,
)
LEVERS = Variants(
    experiment="maze_levers",
    title="What does lean need in the Maze, and how good must its model be?",
    default=LeverOptions(preset="lean", seeds=4, episodes=100),
    make=levers,
    rule=LEAN.rule,
    real_first=LEAN.real_first,
    column="first_solved",
    block=1,
    piece=10,
    report=partial(AccuracyReport, measure=MEASURE),
)

if __name__ == "__main__":
    sys.exit(LEVERS.main())
