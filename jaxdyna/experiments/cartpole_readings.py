"""What the paper leaves open on CartPole, one detail at a time: which reading gives its effect?

``python -m jaxdyna.experiments.cartpole_readings`` plays the ``dyna`` arm of the ``paper`` preset
with one detail changed in each row, beside the model-free arm under several learning rates.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Any

from jaxdyna.agents.reinforce import over_batch, within_episode
from jaxdyna.experiments import cartpole_options as cartpole
from jaxdyna.experiments.cartpole import make_arms
from jaxdyna.experiments.run import Arm
from jaxdyna.experiments.variants import VariantOptions, Variants

PRESET = "dyna (paper preset)"


def readings(options: VariantOptions) -> dict[str, Arm]:
    """Every reading by name, the preset itself first."""
    base = replace(
        cartpole.PAPER,
        seeds=options.seeds,
        episodes=options.episodes,
    )
    literal = replace(base.model, delta=False, normalise=False)

    def model(**changes: Any) -> cartpole.Options:
        return replace(base, model=replace(base.model, **changes))

    def agent(advantage: Any) -> cartpole.Options:
        return replace(base, agent=replace(base.agent, advantage=advantage))

    def threshold(value: float) -> cartpole.Options:
        return replace(base, hparams=replace(base.hparams, termination_threshold=value))

    variants = {
        PRESET: base,
        "returns standardised within an episode": agent(within_episode),
        "returns standardised over the batch": agent(over_batch),
        "2 updates on 1 fake episode each": replace(base, dream_episodes=1),
        "16 updates on 1 fake episode each": replace(base, dream_updates=16, dream_episodes=1),
        "4 fake episodes an update": replace(base, dream_episodes=4),
        "4 updates on dreams": replace(base, dream_updates=4),
        "targets are next states": model(delta=False),
        "scaled by 1 standard deviation, not 3": model(spread=1.0),
        "no normalisation": model(normalise=False),
        "no normalisation, next states": replace(base, model=literal),
        "no normalisation, next states, mean of the batch": replace(
            base, model=replace(literal, sum_loss=False)
        ),
        "Eq. 1 as a mean of the batch": model(sum_loss=False),
        "the same, scaled by 1, next states": model(sum_loss=False, spread=1.0, delta=False),
        "batch of 5": replace(base, model_batch=5),
        "LeCun initial weights": model(weight_variance=1.0),
        "20 model updates": replace(base, model_updates=20),
        "fake episode ends at p > 0.03": threshold(0.03),
        "fake episode ends at p > 0.5": threshold(0.5),
        "dreams start uniform ±0.1": replace(base, dream_start="uniform"),
        "replay emptied every 20 episodes": replace(base, forget_every=20),
        "authors' slip: angle overwritten": replace(base, authors_bug=True),
    }
    arms = {name: _without_diagnosis(variant) for name, variant in variants.items()}
    return arms | _controls(base)


def _controls(base: cartpole.Options) -> dict[str, Arm]:
    """The true environment in the model's place, and no model at several learning rates."""
    arms = {
        "true environment as the model": make_arms(base)["oracle"],
        "true environment, 2 updates on 1 fake episode each": make_arms(
            replace(base, dream_episodes=1)
        )["oracle"],
    }
    alone = make_arms(base)["model_free"]
    for rate in (0.005, 0.01, 0.015, 0.02):
        agent = replace(alone.hparams.agent, learning_rate=rate)
        hparams = replace(alone.hparams, agent=agent)
        arms[f"model-free, learning rate {rate:g}"] = alone._replace(hparams=hparams)
    return arms


def _without_diagnosis(options: cartpole.Options) -> Arm:
    """The ``dyna`` arm without the running judgement of its model, which no table here needs."""
    arm = make_arms(options)["dyna"]
    return arm._replace(dyna=arm.dyna._replace(diagnose=None))


READINGS = Variants(
    experiment="cartpole_readings",
    title="Which reading of the paper gives its effect on CartPole?",
    default=VariantOptions(),
    make=readings,
    rule=cartpole.PAPER.rule,
    real_first=cartpole.PAPER.real_first,
)

if __name__ == "__main__":
    sys.exit(READINGS.main())
