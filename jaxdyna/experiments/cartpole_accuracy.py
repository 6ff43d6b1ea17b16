"""Does sample efficiency grow with the model's accuracy? Models degraded on purpose (§5).

``python -m jaxdyna.experiments.cartpole_accuracy``
"""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna import rollout
from jaxdyna.envs import CartPole
from jaxdyna.experiments.accuracy import AccuracyReport, Measure, judged_on
from jaxdyna.experiments.cartpole import make_arms
from jaxdyna.experiments.cartpole_options import PAPER
from jaxdyna.experiments.run import Arm
from jaxdyna.experiments.variants import Curves, VariantOptions, Variants
from jaxdyna.statistics import r_squared
from jaxdyna.types import Key, Transition

SHORT = "fake episodes of at most"
COMMON = (0.0, 0.3, 1.0)


def degradations(options: VariantOptions) -> dict[str, Arm]:
    """Every setting by name, the preset itself first."""
    base = replace(PAPER, seeds=options.seeds, episodes=options.episodes)
    variants = {"dyna (paper preset)": base}
    for noise in (0.01, 0.03, 0.1, 0.3):
        name = f"noise of {noise:g} standard deviations on predictions"
        variants[name] = replace(base, dream_noise=noise)
    for width in (64, 16, 4):
        model = replace(base.model, hidden=(width, width))
        variants[f"hidden layers of {width}"] = replace(base, model=model)
    for updates in (20, 5, 2):
        variants[f"{updates} model updates an episode"] = replace(base, model_updates=updates)
    variants["the newest 200 transitions only"] = replace(base, replay_capacity=200)
    for steps in (100, 50, 25):
        variants[f"{SHORT} {steps} steps"] = replace(base, dream_steps=steps)
    arms = {name: make_arms(variant)["dyna"] for name, variant in variants.items()}
    controls = make_arms(base)
    common = common_transitions()
    arms["untrained model (placebo)"] = controls["placebo"]
    return judged_on(common, arms) | {
        "true environment as the model": controls["oracle"],
        "model-free": controls["model_free"],
    }


def common_transitions(count: int = 400) -> Transition:
    """The same new transitions for every model, ``[count, 1]``: of a controller that balances the
    pole with none, some and all of its actions (`COMMON`) at random.
    """
    env = CartPole()

    def play(share: float, key: Key) -> Transition:
        def act(obs: jax.Array, key: Key) -> jax.Array:
            key_which, key_random = jax.random.split(key)
            balance = obs @ jnp.array([0.02, 0.05, 1.0, 0.5]) > 0
            at_random = jax.random.bernoulli(key_random)
            return jnp.where(jax.random.bernoulli(key_which, share), at_random, balance).astype(int)

        return rollout(env, act, key, env.default_params, 20)

    keys = jax.random.split(jax.random.key(2**20), len(COMMON))
    play_jitted = jax.jit(play)
    parts = [play_jitted(share, key) for share, key in zip(COMMON, keys, strict=True)]
    parts = [jax.tree.map(lambda leaf, p=part: np.asarray(leaf)[np.asarray(p.mask)], part)
             for part in parts]  # fmt: skip
    chosen = np.random.default_rng(0)
    each = [count // len(parts) + (number < count % len(parts)) for number in range(len(parts))]
    rows = [chosen.choice(len(part.mask), size, replace=False)
            for part, size in zip(parts, each, strict=True)]  # fmt: skip
    drawn = [jax.tree.map(lambda leaf, at=row: leaf[at, None], part)
             for part, row in zip(parts, rows, strict=True)]  # fmt: skip
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *drawn)


def unexplained(metrics: Curves, judged: slice) -> np.ndarray | None:
    """The share of the variance of a step's change that a model leaves unexplained one step ahead,
    averaged over the state's variables, ``[seeds]``; None without a model.
    """
    if "state_error" not in metrics:
        return None
    names = ("state_error", "change_sum", "change_square", "count")
    sums = [metrics[name][:, judged].sum(1) for name in names]
    return (1 - r_squared(*sums)).mean(-1)


MEASURE = Measure(
    error=unexplained,
    episodes=100,
    axis="unexplained share of a step's change (logarithmic)",
    said="The error is the share of the variance of a step's change that the model leaves "
    "unexplained, one step ahead. Every model is judged on the same new transitions: a third each "
    "from a controller that balances the pole, from one with 30% of its actions at random, and "
    "from random actions alone.",
    lines=("true environment as the model", "model-free"),
    hollow=SHORT,
)

ACCURACY = Variants(
    experiment="cartpole_accuracy",
    title="Does sample efficiency grow with the model's accuracy?",
    default=VariantOptions(episodes=500),
    make=degradations,
    rule=PAPER.rule,
    real_first=PAPER.real_first,
    report=partial(AccuracyReport, measure=MEASURE),
)

if __name__ == "__main__":
    sys.exit(ACCURACY.main())
