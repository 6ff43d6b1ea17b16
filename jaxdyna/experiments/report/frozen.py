"""What policies are worth as they stand: greedy, in new episodes that nothing is learned of, after
so many real steps (`jaxdyna.dyna.DynaConfig.eval_every`). No window stands in these figures.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from jaxdyna.experiments.report import plots, tables
from jaxdyna.experiments.report.sections import Rule, drawn, told
from jaxdyna.experiments.report.summaries import Curves
from jaxdyna.experiments.report.tables import Results, markdown_table, paragraphs, per_seed
from jaxdyna.statistics import SolveRule, mean_of_runs, summarise

#: real steps before the first snapshot; each other one comes after twice as many as the last
FIRST = 50
SHOWN = 5  #: snapshots in a table, the last ones
POINTS = 200  #: of the figure's lines


def threshold(curves: Curves, rule: SolveRule) -> float:
    """The return that is asked for: the rule's, or its share of the mean of what could be had."""
    return rule.threshold * (float(np.nanmean(curves[rule.share_of])) if rule.share_of else 1)


def worth(curves: Curves, at: np.ndarray) -> np.ndarray:
    """Of each run the return ``[runs, n]`` of the policy that it had after real steps ``at [n]``:
    the newest evaluated one of an episode that was over by then, -infinity before the first; of a
    run that is over its last one.
    """
    steps, returns = _evaluated(curves)
    newest = (steps[:, :, None] <= at).sum(1)  # policies so far
    padded = np.concatenate([np.full((len(returns), 1), -np.inf), returns], axis=1)
    return np.take_along_axis(padded, newest, axis=1)


def snapshots(latest: float) -> np.ndarray:
    """Real steps up to the latest: `FIRST`, and on as often as they can be doubled."""
    return FIRST * 2 ** np.arange(int(np.log2(max(latest / FIRST, 1))) + 1)


def _evaluated(curves: Curves) -> tuple[np.ndarray, np.ndarray]:
    """Of each run's evaluated policies the real steps before and the return, ``[runs, policies]``,
    infinity and NaN after its end.
    """
    seen = np.isfinite(curves["frozen_return"])
    steps = np.where(seen, np.nan_to_num(curves["real_length"]).cumsum(1), np.inf)
    order = np.argsort(steps, axis=1, kind="stable")[:, : max(int(seen.sum(1).max()), 1)]
    returns = np.take_along_axis(curves["frozen_return"], order, axis=1)
    return np.take_along_axis(steps, order, axis=1), returns


def describe(rule: Rule) -> Callable[[Any, Curves], Results]:
    """``frozen``: ``real_steps_to_solve``, after which a policy first earned the rule's threshold;
    ``snapshots``: the return of the policy after so many real steps, and how many runs' earn the
    threshold then. Empty where no policy was evaluated.
    """

    def said(options: Any, curves: Curves) -> Results:
        if "frozen_return" not in curves or not np.isfinite(curves["frozen_return"]).any():
            return {}
        solves = rule(options)
        asked = threshold(curves, solves) if solves else np.inf
        steps, returns = _evaluated(curves)
        good = returns >= asked
        first = np.where(good.any(1), np.take_along_axis(
            steps, good.argmax(1)[:, None], axis=1)[:, 0], np.inf)  # fmt: skip
        played = np.nansum(curves["real_length"], axis=1)
        at = snapshots(steps[np.isfinite(steps)].max())
        return {"frozen": {
            "threshold": asked if solves else None,
            "real_steps_to_solve": summarise(first, at_least=played),
            "snapshots": {
                str(step): _worth(column) | {"solved": int((column >= asked).sum())}
                for step, column in zip(at, worth(curves, at).T, strict=True)
            },
        }}  # fmt: skip

    return said


def at_steps(record: Any) -> str:
    """What the policies are worth after so many real steps; empty where none was evaluated."""
    arms = {name: arm["frozen"]["snapshots"] for name, arm in record.results["arms"].items()
            if "frozen" in arm}  # fmt: skip
    known = {step for arm in arms.values() for step in arm if arm[step]["mean"] is not None}
    if not known:
        return ""
    steps = sorted(known, key=int)[-SHOWN:]
    rows = [
        [name, *(tables.with_interval(arm[step], 1) if step in arm else "-" for step in steps)]
        for name, arm in arms.items()]  # fmt: skip
    return paragraphs(
        "The mean return of the policy as it was after so many real steps, greedy, in new episodes "
        "(95% interval; -: some run had none yet):",
        markdown_table(["arm", *(f"{int(step):,}" for step in steps)], rows),
    )


def _worth(returns: np.ndarray) -> Results:
    """Of policies after so many steps; no mean where some run had none yet."""
    said = mean_of_runs(np.where(np.isfinite(returns), returns, np.nan))
    return said if np.isfinite(returns).all() else said | {"mean": None, "ci95": None}


@told
def frozen(record: Any, rule: Rule) -> str:
    """Real steps until a policy as it stands earns what the rule asks for, and the share of runs
    whose policy does, against real steps; empty without a rule, or where no policy was evaluated.
    """
    arms = {name: arm["frozen"] for name, arm in record.results["arms"].items() if "frozen" in arm}
    solves = rule(record.options)
    if not arms or solves is None:
        return ""
    dyna, rows = record.options.dyna, []
    for name, arm in arms.items():
        first = arm["real_steps_to_solve"]
        most = np.percentile(per_seed(first), 95, method="inverted_cdf")
        rows.append([name, f"{first['solved']}/{first['seeds']}", tables.median(first),
                     f"{most:,.0f}" if np.isfinite(most) else "-"])  # fmt: skip
    shown = drawn(record, tuple(arms))
    latest = max(np.nansum(curves["real_length"], axis=1).max() for curves in shown.values())
    early = min(np.nansum(one["real_length"][:, : dyna.eval_every], axis=1).min()
                for one in shown.values()) / 2  # fmt: skip
    at = np.geomspace(max(FIRST / 2, early), max(latest, FIRST), POINTS)
    asked = f"{next(iter(arms.values()))['threshold']:.4g}"
    lines = {name: worth(curves, at) >= threshold(curves, solves)
             for name, curves in shown.items()}  # fmt: skip
    axes = "real steps", f"share of runs whose policy earns {asked}"
    there = plots.shares(record.out / "frozen.png", lines, *axes, at=at, xscale="log")
    often = "each" if dyna.eval_every == 1 else f"every {dyna.eval_every}"
    episodes = "real episode" if dyna.eval_every == 1 else "real episodes"
    return paragraphs(
        "## Frozen policies",
        f"After {often} {episodes} the policy as it then is plays {dyna.eval_episodes} new "
        "episodes, greedy; nothing is learned of them, and they do not count as real steps. No "
        "window stands in these figures: real steps until a policy first earns "
        f"{asked} on average, and the share of the runs whose "
        "newest policy does, after so many steps.",
        markdown_table(["arm", "runs that came to it", "real steps: median (95%)",
                        "95% of the runs within"], rows),
        "![share of runs whose frozen policy is good enough](frozen.png)" if there else "",
    )  # fmt: skip
