"""Whether sample efficiency grows with a model's accuracy, over models made worse on purpose (§5).

A world has an option ``judged_on: Literal["own", "common"]``, and where it is ``"common"`` its
models are judged `on_common` transitions; a study sets it for all of its rows.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxdyna.dyna import Dyna
from jaxdyna.experiments.report import plots
from jaxdyna.experiments.report.rows import limit
from jaxdyna.experiments.report.sections import paragraphs, told
from jaxdyna.experiments.report.summaries import Curves, restricted
from jaxdyna.statistics import rank_correlation
from jaxdyna.types import Transition


class Measure(NamedTuple):
    """How wrong a model is."""

    curve: str  #: its name: the model's error in each real episode
    episodes: int  #: so many with dreams are judged, or as many as a run plays
    axis: str  #: the figure's
    said: str  #: what it is, in sentences
    lines: tuple[str, ...]  #: rows without a model, drawn as lines
    hollow: str  #: what the names of rows begin with that are no worse, but otherwise handicapped


def on_common(dyna: Dyna, common: Transition) -> Dyna:
    """With its model judged on the common transitions instead of on its own episodes."""
    judge = dyna.diagnose
    assert judge is not None
    return dyna._replace(diagnose=lambda params, _, key: judge(params, common, key))


def describe(measure: Measure) -> Callable[[Any, Curves], dict[str, Any]]:
    """``model_error`` of an arm with a model, one a run: the mean over the episodes judged."""

    def described(options: Any, curves: Curves) -> dict[str, Any]:
        if measure.curve not in curves:
            return {}
        start = max(options.dyna.num_real_first - 1, 0)
        judged = curves[measure.curve][:, start : start + measure.episodes]
        played = np.isfinite(curves["real_return"][:, start : start + measure.episodes])
        total = np.where(played, judged, 0).sum(1, dtype=float)
        return {"model_error": (total / np.maximum(played.sum(1), 1)).tolist()}

    return described


@told
def accuracy(record: Any, measure: Measure, column: str = "episodes_to_solve") -> str:
    """Solving against the model's error; empty with fewer than three models to compare."""
    arms, axis = record.results["arms"], column.replace("_", " ")
    errors = {name: np.array(arm.get("model_error", np.nan), float) for name, arm in arms.items()}
    errors = {name: error for name, error in errors.items() if np.isfinite(error).all()}
    solved = {name: restricted(arm[column]) for name, arm in arms.items()}
    hollow = [name for name in errors if name.startswith(measure.hollow)]
    compared = [name for name in errors if name not in hollow]
    if len(compared) < 3:
        return ""
    plots.error_scatter(
        record.out / "accuracy.png", errors, solved,
        {name: solved[name].mean() for name in measure.lines if name in solved}, measure.axis,
        f"{axis} (unsolved counted as {limit(arms, column)})", hollow)  # fmt: skip
    rank, low, high = rank_correlation(
        *(np.stack([values[name] for name in compared]) for values in (errors, solved))
    )
    return paragraphs(
        "## Solving against the model's error",
        f"![{axis} against the model's error](accuracy.png)",
        f"{measure.said} Mean over the first {measure.episodes} episodes with dreams. Rank "
        f"correlation of mean error and mean {axis} over {len(compared)} models (those that are "
        f"hollow in the figure, which are no worse, apart): {rank:.2f} (95% percentile bootstrap "
        f"over seeds {low:.2f} to {high:.2f}). 1 would be the paper's claim without exception.",
    )
