"""What makes the ``lean`` preset lean: each of its levers taken away alone.

``python -m jaxdyna.experiments.cartpole_levers``
"""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from typing import Any

from jaxdyna.agents.reinforce import within_episode
from jaxdyna.experiments.cartpole import make_arms
from jaxdyna.experiments.cartpole_options import LEAN, Options
from jaxdyna.experiments.run import Arm
from jaxdyna.experiments.variants import VariantOptions, Variants


def levers(options: VariantOptions) -> dict[str, Arm]:
    """Every variant by name, the preset itself first."""
    base = replace(LEAN, seeds=options.seeds, episodes=options.episodes)

    def hparams(**changes: Any) -> Options:
        return replace(base, hparams=replace(base.hparams, **changes))

    def model(**changes: Any) -> Options:
        return replace(base, model=replace(base.model, **changes))

    variants = {
        "dyna (lean preset)": base,
        "N = 1": replace(base, real_first=1),
        "N = 10": replace(base, real_first=10),
        "one network, no disagreement": model(ensemble=1),
        "3 networks, disagreement ignored": hparams(disagreement_threshold=math.inf),
        "fake episode ends at p > 0.5": hparams(termination_threshold=0.5),
        "ends drawn as rarely as they come": replace(base, terminal_share=None),
        "targets are next states": model(delta=False),
        "20 model updates": replace(base, model_updates=20),
        "5 updates on dreams": replace(base, dream_updates=5),
        "4 fake episodes an update": replace(base, dream_episodes=4),
        "returns standardised within an episode": replace(
            base, agent=replace(base.agent, advantage=within_episode)
        ),
        "learns from real episodes too": hparams(real_weight=1.0),
        "never rests": replace(base, rest_when_safe=False),
        "dreams branch off real states, 50 steps": replace(
            base, dream_start="branched", dream_steps=50
        ),
    }
    arms = {name: make_arms(variant)["dyna"] for name, variant in variants.items()}
    arms = {name: arm._replace(dyna=arm.dyna._replace(diagnose=None)) for name, arm in arms.items()}
    controls = make_arms(base)
    return arms | {
        "true environment as the model": controls["oracle"],
        "untrained model (placebo)": controls["placebo"],
        "model-free": controls["model_free"],
    }


LEVERS = Variants(
    experiment="cartpole_levers",
    title="What makes the lean preset lean on CartPole?",
    default=VariantOptions(preset="lean", seeds=20, episodes=150),
    make=levers,
    rule=LEAN.rule,
    real_first=LEAN.real_first,
    column="first_solved",
    block=LEAN.block,
)

if __name__ == "__main__":
    sys.exit(LEVERS.main())
