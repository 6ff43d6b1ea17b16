"""What arms of unequal length had reached after as many real episodes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from jaxdyna.experiments.ratios import comparison
from jaxdyna.experiments.report import Results, interval, markdown_table
from jaxdyna.statistics import bootstrap_interval

TEN = 10
BLOCKS = 2
BLURRED = "dyna_l2"
BASELINES = ("model_free", "more_updates")


def by_tens(returns: np.ndarray) -> list[list[float]]:
    """Mean return of each run in each ten of its episodes, from ``[seeds, episodes]``."""
    seeds, episodes = returns.shape
    whole = returns[:, : episodes // TEN * TEN]
    return whole.reshape(seeds, -1, TEN).mean(-1).tolist()


def equal_episodes(results: Results, baselines: Sequence[str] = BASELINES) -> list[str]:
    """The arms' returns in the last episodes that all of them have played, and less a baseline's
    run by run: runs of the same number begin with the same key. Empty where there is nothing to
    compare.
    """
    returns = {name: np.array(arm["by_tens"]) for name, arm in results["arms"].items()}
    ends = min(values.shape[1] for values in returns.values())
    known = [name for name in baselines if name in returns]
    if not known or len(returns) == 1 or ends < BLOCKS:
        return []
    at = {name: values[:, ends - BLOCKS : ends].mean(1) for name, values in returns.items()}

    def less(name: str, baseline: str) -> str:
        return "-" if name == baseline else _mean(at[name] - at[baseline], "+")

    rows = [[name, _mean(at[name], ""), *(less(name, other) for other in known)] for name in at]
    first, last = (ends - BLOCKS) * TEN + 1, ends * TEN
    return [
        f"After as many real episodes: the mean return of episodes {first} to {last}, the last "
        "that every arm has played, and less another arm's run by run; 95% intervals over runs.",
        markdown_table(["arm", "return", *(f"less that of {name}" for name in known)], rows),
    ]


def mended(arms: Iterable[str]) -> list[str]:
    """Of these the blurred arm, and those in whose dreams the truth mends something; empty where
    there is nothing to compare.
    """
    names = set(arms)
    true = sorted(name for name in names if name.startswith("true_"))
    return [BLURRED, *true] if true and BLURRED in names else []


def cause_said(results: Results) -> list[str]:
    """What each object of the blurred dreams costs; empty without arms that mend one."""
    both = {name: results["arms"][name] for name in mended(results["arms"])}
    if not both:
        return []
    return [
        "## Which object's error does it",
        f"`true_...` is `{BLURRED}` whose dreams show one object, or all of them (`true_frames`), "
        "as the true game has it, which runs beside the dream from a state read off the same "
        "frames; rewards are the model's.",
        *comparison({"arms": both}, {}, BLURRED),
        *equal_episodes({"arms": both}, (BLURRED,)),
        "![point difference against real episodes, by what is true in the dreams](cause.png)",
    ]


def _mean(values: np.ndarray, sign: str) -> str:
    ends = bootstrap_interval(values, lambda rows: rows.mean(-1))
    return f"{values.mean():{sign}.2f} ({interval(ends, 2)})"
