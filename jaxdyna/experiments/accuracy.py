"""Whether sample efficiency grows with a model's accuracy, over models made worse on purpose."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from jaxdyna.dyna import Dyna
from jaxdyna.experiments import plots_studies
from jaxdyna.experiments.report import Results
from jaxdyna.experiments.run import Arm, ArmRun
from jaxdyna.experiments.variants import Curves, VariantsReport
from jaxdyna.statistics import rank_correlation
from jaxdyna.types import Transition


def judged_on(common: Transition, arms: Mapping[str, Arm]) -> dict[str, Arm]:
    """The arms, each model judged on the common transitions instead of on its own episodes. Arms of
    one program stay so.
    """
    judged: dict[int, Dyna] = {}

    def on_common(dyna: Dyna) -> Dyna:
        judge = dyna.diagnose
        if judge is None:
            return dyna
        new = dyna._replace(diagnose=lambda params, _, key: judge(params, common, key))
        return judged.setdefault(id(dyna), new)

    return {name: arm._replace(dyna=on_common(arm.dyna)) for name, arm in arms.items()}


class Measure(NamedTuple):
    """How wrong a model is.

    Attributes:
        error: ``(metrics, episodes) -> [seeds]``: mean over such a slice of the real episodes;
            None for an arm without a model.
        episodes: so many with dreams are judged, no more than every arm plays.
        axis: the figure's.
        said: what it is, in sentences.
        lines: variants without a model, drawn as lines.
        hollow: what the names of variants begin with that are no worse, but otherwise handicapped.
    """

    error: Callable[[Curves, slice], np.ndarray | None]
    episodes: int
    axis: str
    said: str
    lines: tuple[str, ...]
    hollow: str


@dataclass(frozen=True)
class AccuracyReport(VariantsReport):
    """The table of variants, and solving against the model's error."""

    measure: Measure

    def analyse(self, arm: Arm, run: ArmRun, key: jax.Array) -> Curves:
        """``judged_error``, one a seed, over `Measure.episodes`."""
        start = max(self.variants.real_first - 1, 0)
        error = self.measure.error(run.metrics, slice(start, start + self.measure.episodes))
        return {} if error is None else {"judged_error": error}

    def describe(self, curves: Curves) -> Results:
        """With ``model_error``, one a seed, see `analyse`."""
        described = super().describe(curves)
        if "judged_error" in curves:
            described["model_error"] = curves["judged_error"].tolist()
        return described

    def figures(self, out: Path, curves: Mapping[str, Curves], results: Results) -> None:
        """``variants.png`` and ``accuracy.png``."""
        super().figures(out, curves, results)
        judged = {name: values for name, values in curves.items() if "judged_error" in values}
        solved = {name: np.minimum(self.solved_at(arm), self.limit) for name, arm in curves.items()}
        plots_studies.error_scatter(
            out / "accuracy.png",
            {name: values["judged_error"] for name, values in judged.items()},
            {name: solved[name] for name in judged},
            {name: solved[name].mean() for name in self.measure.lines if name in curves},
            self.limit,
            self.measure.axis,
            self.variants.column.replace("_", " "),
            hollow=[name for name in judged if name.startswith(self.measure.hollow)],
        )

    def markdown(self, results: Results) -> str:
        """The report."""
        errors, solved = [], []
        for name, arm in results["arms"].items():
            if "model_error" in arm and not name.startswith(self.measure.hollow):
                errors.append(arm["model_error"])
                solved.append(self.bounded(arm))
        if len(errors) < 3:
            return super().markdown(results)
        rank, low, high = rank_correlation(np.array(errors), np.array(solved))
        axis = self.variants.column.replace("_", " ")
        text = f"""
## Solving against the model's error

![{axis} against the model's error](accuracy.png)

{self.measure.said} Mean over the first {self.measure.episodes} episodes with dreams.
Rank correlation of mean error and mean {axis} over {len(errors)} models (those that are hollow in
the figure, which are no worse, apart): {rank:.2f} (95% percentile bootstrap over seeds {low:.2f}
to {high:.2f}). 1 would be the paper's claim without exception.
"""
        return super().markdown(results) + text
