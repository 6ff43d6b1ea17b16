"""Does sample efficiency grow with the model's accuracy? Models degraded on purpose (§5).

``python -m jaxdyna.experiments.cartpole_accuracy``
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from jaxdyna.experiments import plots_studies
from jaxdyna.experiments.cartpole import make_arms
from jaxdyna.experiments.cartpole_options import PAPER
from jaxdyna.experiments.report import Results
from jaxdyna.experiments.run import Arm
from jaxdyna.experiments.variants import Curves, VariantOptions, Variants, VariantsReport
from jaxdyna.statistics import r_squared, rank_correlation

SHORT = "fake episodes of at most"
JUDGED_EPISODES = 100


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
    return arms | {
        "true environment as the model": controls["oracle"],
        "untrained model (placebo)": controls["placebo"],
        "model-free": controls["model_free"],
    }


class AccuracyReport(VariantsReport):
    """The table of variants, and solving against the model's error."""

    def describe(self, curves: Curves) -> Results:
        """With ``model_error``, one a seed: the share of the variance of a step's change that the
        model does not explain, one step ahead on real episodes that it was not yet trained on,
        over the first `JUDGED_EPISODES` with dreams, averaged over the state's variables.
        """
        described = super().describe(curves)
        if "state_error" in curves:
            described["model_error"] = self._errors(curves).tolist()
        return described

    def figures(self, out: Path, curves: Mapping[str, Curves]) -> None:
        """``variants.png`` and ``accuracy.png``."""
        super().figures(out, curves)
        judged = {name: values for name, values in curves.items() if "state_error" in values}
        lines = {
            name: np.minimum(self.solved_at(curves[name]), self.limit).mean()
            for name in ("true environment as the model", "model-free")
            if name in curves
        }
        plots_studies.error_scatter(
            out / "accuracy.png",
            {name: self._errors(values) for name, values in judged.items()},
            {
                name: np.minimum(self.solved_at(values), self.limit)
                for name, values in judged.items()
            },
            lines,
            self.limit,
        )

    def markdown(self, results: Results) -> str:
        """The report."""
        errors, solved = [], []
        for name, arm in results["arms"].items():
            if "model_error" in arm and not name.startswith(SHORT):
                errors.append(arm["model_error"])
                solved.append(self._bounded(arm))
        if len(errors) < 3:
            return super().markdown(results)
        rank, low, high = rank_correlation(np.array(errors), np.array(solved))
        text = f"""
## Solving against the model's error

![episodes to solve against the model's error](accuracy.png)

The error is the share of the variance of a step's change that the model leaves unexplained, one
step ahead, on real episodes that it was not yet trained on, over the first {JUDGED_EPISODES}
episodes with dreams. Rank correlation of mean error and mean episodes to solve over {len(errors)}
models (shorter dreams apart, which are no error): {rank:.2f} (95% interval over seeds {low:.2f} to
{high:.2f}). 1 would be the paper's claim without exception.
"""
        return super().markdown(results) + text

    def _errors(self, curves: Curves) -> np.ndarray:
        after = slice(self.variants.real_first, self.variants.real_first + JUDGED_EPISODES)
        names = ("state_error", "change_sum", "change_square", "count")
        sums = [curves[name][:, after].sum(1) for name in names]
        return (1 - r_squared(*sums)).mean(-1)


ACCURACY = Variants(
    experiment="cartpole_accuracy",
    title="Does sample efficiency grow with the model's accuracy?",
    default=VariantOptions(episodes=500),
    make=degradations,
    rule=PAPER.rule,
    real_first=PAPER.real_first,
    report=AccuracyReport,
)

if __name__ == "__main__":
    sys.exit(ACCURACY.main())
