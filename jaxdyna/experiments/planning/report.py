"""What the comparison of planners and policies leaves behind: tables and figures; and the paper's
claim of robustness (§1.1) in numbers: is a policy that learns from sub-optimal dreams more robust
than one that is initialised from a planner? Robust is what loses little with poorer models: all
that imitate or dream are compared with good and with poor models, run by run.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxdyna.experiments.engine import Record, Results
from jaxdyna.experiments.report import plots
from jaxdyna.experiments.report.sections import paragraphs
from jaxdyna.experiments.report.tables import Table, interval, markdown_table, with_interval
from jaxdyna.statistics import mean_of_runs

COLOURS = {"policy": plots.GREEN, "MPC": plots.ORANGE, "MCTS": plots.BLUE,
           "MPC to the goal": plots.VERMILION}  # fmt: skip
ABOUT = (
    "Share: of the most that could be had in the same episodes (the Maze's by value iteration, "
    "CartPole's 200), with its 95% interval over the runs that learned (over the episodes "
    "where there are one or two). Gain: how much more than the policy's share, paired, "
    "likewise. Steps: of the world that is planned in, a decision. Milliseconds: of one call "
    "for one environment, how many times the policy's that is, and a decision's part of a call "
    "for {batch}; a jitted call takes some hundredths of a millisecond whatever it does."
)
GROUNDS = (
    "Policy, values and model come from runs of `dyna` in the `lean` preset, and everybody plays "
    "some episodes with what each run has learned; times are the first run's. MPC is random "
    "shooting. «To the goal» looks ahead half as far again as the goal is and is told nothing; a "
    "planner with learned values looks a few steps ahead and takes the run's Q-values for what "
    "comes after. MCTS is MuZero's search; in CartPole its leaves are worth what a random episode "
    "from them earns."
)
#: real episodes whose return is compared: after every imitation, and every run plays them
LATER = slice(50, 100)
FIRST = "dyna"
ROBUST = (
    "Return: mean of the real episodes 51 to 100, which every run plays and which come after all "
    f"imitation. An arm stands beside `{FIRST}` with as good models; all but "
    "`mpc_clone`, which stays as it is, make at least as many policy updates an episode as "
    f"`{FIRST}`. Differences are paired (the same seeds), intervals are 95% studentised-bootstrap "
    "intervals over the runs."
)


def decisions(record: Record) -> str:
    """What a decision costs, and what it earns."""
    budgets = record.results["budgets"]
    if not budgets:
        return ""
    places = {name: [row for row in budgets if row["environment"] == name]
              for name in dict.fromkeys(row["environment"] for row in budgets)}  # fmt: skip
    figure(record.out / "decisions.png", places)
    return paragraphs(
        "## What a decision costs, and what it earns",
        ABOUT.format(batch=budgets[0]["batch"]),
        *(f"{name}:\n\n{table(here)}" for name, here in places.items()),
        GROUNDS,
        "![share of the return that could be had, against milliseconds a decision](decisions.png)",
    )


def table(rows: list[Results]) -> str:
    """A line a contender of one environment, the policy's first."""
    lines = []
    for row in rows:
        share, gain = (interval(row[f"{name}_ci95"], 3) for name in ("share", "gain"))
        lines.append([
            row["label"], f"{row['steps']:,}", f"{row['share']:.3f} ({share})",
            "-" if row is rows[0] else f"{row['gain']:+.3f} ({gain})",
            f"{row['ms']:.3g} ({row['ms'] / rows[0]['ms']:,.0f})", f"{row['ms_in_batch']:.3g}",
        ])  # fmt: skip
    header = ["who decides", "steps", "share (95% interval)", "gain (95% interval)",
              "ms (times the policy's)", "ms in a batch"]  # fmt: skip
    return markdown_table(header, lines)


def figure(path: Path, places: dict[str, list[Results]]) -> None:
    """Share of what could be had against milliseconds: a panel a place, a line a planner."""
    drawn, panels = plots.laid_out(len(places), sharey=True)
    for panel, (name, here) in zip(panels.flat, places.items(), strict=False):
        for label in dict.fromkeys(row["label"] for row in here):
            own = [row for row in here if row["label"] == label]
            own.sort(key=lambda row: row["steps"])
            share = np.array([row["share"] for row in own])
            ends = np.array([row["share_ci95"] or [row["share"]] * 2 for row in own], float)
            who, true = own[0]["who"], own[0]["world"] == "true"
            told = who.endswith(", learned values")
            colour = COLOURS.get(who.removesuffix(", learned values"), plots.BLACK)
            panel.errorbar(
                [row["ms"] for row in own], share, yerr=np.nan_to_num(abs(ends.T - share)),
                marker="*" if who == "policy" else "s" if told else "o",
                markersize=13 if who == "policy" else 5,
                markerfacecolor="white" if true else colour,
                linestyle=plots.DASHED if true else "-",
                linewidth=1.5, elinewidth=0.8, color=colour, label=label)  # fmt: skip
        panel.set_xscale("log")
        panel.axhline(1, color=plots.FAINT, linewidth=0.8, linestyle=plots.DOTTED)
        plots.finish(panel, name, "ms a decision")
    for panel in panels[:, 0]:
        panel.set_ylabel("share of what could be had\n(bar: 95% interval)")
    plots.legend_above(drawn, panels.flat)
    plots.save(drawn, path)


def describe(options: Any, curves: Mapping[str, np.ndarray]) -> Results:
    """``later_return``, one a run, where so many episodes are played."""
    returns = curves["real_return"][:, LATER]
    whole = returns.shape[1] == LATER.stop - LATER.start and np.isfinite(returns).all()
    return {"later_return": returns.mean(1).tolist()} if whole else {}


def robust(record: Any) -> str:
    """Whether dreams are more robust than imitating a planner; empty where little was played."""
    header, lines = robust_table(record.results["arms"])
    title = "## Sub-optimal trajectories, or an initialisation from MPC? (§1.1)"
    return paragraphs(title, ROBUST, markdown_table(header, lines)) if lines else ""


def robust_table(arms: Results) -> Table:
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
