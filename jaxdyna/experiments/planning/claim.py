"""The paper's claim of robustness (§1.1) in numbers: is a policy that learns from sub-optimal
dreams more robust than one that is initialised from a planner?

Robust is what loses little with poorer models. All that imitate or dream are compared with good
and with poor models, run by run.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxdyna.experiments.report.sections import paragraphs
from jaxdyna.experiments.report.tables import Results, Table, markdown_table, with_interval
from jaxdyna.statistics import mean_of_runs

#: real episodes whose return is compared: after every imitation, and every run plays them
LATER = slice(50, 100)
FIRST = "dyna"
SAID = (
    "Return: mean of the real episodes 51 to 100, which every run plays and which come after all "
    f"imitation. An arm stands beside `{FIRST}` with as good models; all but "
    "`mpc_clone`, which stays as it is, make at least as many policy updates an episode as "
    f"`{FIRST}`. Differences are paired (the same seeds), intervals are 95% studentised-bootstrap "
    "intervals over the runs."
)


def describe(options: Any, curves: Mapping[str, np.ndarray]) -> Results:
    """``later_return``, one a run, where so many episodes are played."""
    returns = curves["real_return"][:, LATER]
    whole = returns.shape[1] == LATER.stop - LATER.start and np.isfinite(returns).all()
    return {"later_return": returns.mean(1).tolist()} if whole else {}


def robust(record: Any) -> str:
    """Whether dreams are more robust than an initialisation from a planner; empty where too little
    was played.
    """
    header, lines = table(record.results["arms"])
    title = "## Sub-optimal trajectories, or an initialisation from MPC? (§1.1)"
    return paragraphs(title, SAID, markdown_table(header, lines)) if lines else ""


def table(arms: Results) -> Table:
    """A row an arm that imitates or dreams: its return, what it loses with poorer models, and how
    much more both are than the dreams'; no rows where too little was played.
    """
    kinds = {name: name.partition(",")[0] for name in arms if "later_return" in arms[name]}
    kinds = {name: kind for name, kind in kinds.items() if kind.startswith((FIRST, "mpc_"))}
    later = {name: np.array(arms[name]["later_return"], float) for name in kinds}
    lost = {name: later[kind] - later[name] for name, kind in kinds.items()
            if kind in later and kind != name}  # fmt: skip

    def less(values: Mapping[str, np.ndarray], name: str) -> str:
        first = f"{FIRST}{name.removeprefix(kinds[name])}"
        both = name in values and first in values and name != first
        return _mean(values[name] - values[first], "+") if both else "-"

    rows = [
        [name, _mean(values), less(later, name), _mean(lost[name]) if name in lost else "-",
         less(lost, name)]
        for name, values in later.items()]  # fmt: skip
    return ["arm", "return", f"less `{FIRST}`'s", "lost by poorer models",
            f"more than `{FIRST}` loses"], rows  # fmt: skip


def _mean(values: np.ndarray, sign: str = "") -> str:
    return with_interval(mean_of_runs(values), sign=sign)
