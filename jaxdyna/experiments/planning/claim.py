"""Claim 21 in numbers: is a policy that learns from sub-optimal dreams more robust than one that is
initialised from a planner (§1.1)?

Robust is what loses little with poorer models. All that imitate or dream are compared with good
and with poor models, run by run.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxdyna.experiments.report.tables import Results, interval, markdown_table
from jaxdyna.statistics import bootstrap_interval

LATER = slice(50, 100)
"""Real episodes whose return is compared: after every imitation, and every run plays them."""
FIRST = "dyna"
SAID = (
    "Return: mean of the real episodes 51 to 100, which every run plays and which come after all "
    "imitation. Differences are paired (the same seeds), intervals are 95% bootstrap intervals "
    "over the runs."
)


def describe(options: Any, curves: Mapping[str, np.ndarray]) -> Results:
    """``later_return``, one a run, where so many episodes are played."""
    returns = curves["real_return"][:, LATER]
    whole = returns.shape[1] == LATER.stop - LATER.start and np.isfinite(returns).all()
    return {"later_return": returns.mean(1).tolist()} if whole else {}


def answer(results: Results) -> list[str]:
    """Sentences, and the tables behind them; nothing where too little was played."""
    arms = results["arms"]
    if not _pairs(arms):
        return []
    return [*sentences(results), SAID, markdown_table(*_by_arm(arms)), *_loss_table(arms)]


def sentences(results: Results) -> list[str]:
    """What each loses with poorer models, and how much more than dreams do."""
    arms, lines = results["arms"], []
    for model in _models(arms)[1:]:
        losses = _losses(arms, model)
        if FIRST not in losses or len(losses) < 2:
            continue
        said = [f"`{name}` {_mean(loss)}" for name, loss in losses.items()]
        lines.append(
            f"With {model} a run loses, of its return in episodes 51 to 100: {', '.join(said)}."
        )
        for name, loss in losses.items():
            if name != FIRST:
                more = loss - losses[FIRST]
                lines.append(f"`{name}` loses **{_mean(more, signed=True)}** more than `{FIRST}`.")
    return lines


def _pairs(arms: Results) -> list[tuple[str, str]]:
    """``(kind, model)`` of the arms that imitate or dream; the good models are ""."""
    kinds = [name.partition(", ")[::2] for name in arms if "later_return" in arms[name]]
    return [(kind, model) for kind, model in kinds if kind == FIRST or kind.startswith("mpc_")]


def _models(arms: Results) -> list[str]:
    return list(dict.fromkeys(["", *(model for _, model in _pairs(arms))]))


def _name(kind: str, model: str) -> str:
    return f"{kind}, {model}" if model else kind


def _returns(arm: Results) -> np.ndarray:
    return np.array(arm["later_return"], float)


def _solved(arm: Results) -> np.ndarray:
    return np.array([value is not None for value in arm["first_solved"]["per_seed"]], float)


def _losses(arms: Results, model: str) -> dict[str, np.ndarray]:
    """By kind, the return of each seed with good models less that with these."""
    pairs = _pairs(arms)
    return {
        kind: _returns(arms[kind]) - _returns(arms[_name(kind, model)])
        for kind, other in pairs
        if other == model and (kind, "") in pairs
    }


def _mean(values: np.ndarray, digits: int = 0, signed: bool = False) -> str:
    ends = bootstrap_interval(values, lambda rows: rows.mean(-1))
    mean = f"{values.mean():{'+' if signed else ''}.{digits}f}"
    return f"{mean} ({interval(ends, digits)})"


def _by_arm(arms: Results) -> tuple[list[str], list[list[str]]]:
    header = ["arm", "solved", f"share solved less `{FIRST}`'s", "return", f"less `{FIRST}`'s"]
    rows = []
    for kind, model in _pairs(arms):
        name, other = _name(kind, model), _name(FIRST, model)
        arm = arms[name]
        row = [name, f"{arm['first_solved']['solved']}/{arm['first_solved']['seeds']}", "-",
               f"{_returns(arm).mean():.0f}", "-"]  # fmt: skip
        if kind != FIRST and "later_return" in arms.get(other, {}):
            row[2] = _mean(_solved(arm) - _solved(arms[other]), 2, signed=True)
            row[4] = _mean(_returns(arm) - _returns(arms[other]), signed=True)
        rows.append(row)
    return header, rows


def _loss_table(arms: Results) -> list[str]:
    """A row a kind and a poorer model; nothing without poorer models."""
    rows = []
    for model in _models(arms)[1:]:
        losses = _losses(arms, model)
        for kind, loss in losses.items():
            more = loss - losses[FIRST] if kind != FIRST and FIRST in losses else None
            rows.append([kind, model, _mean(loss), "-" if more is None else _mean(more, 0, True)])
    header = ["arm", "poorer models", "return lost by them", f"more than `{FIRST}` loses"]
    return [markdown_table(header, rows)] if rows else []
