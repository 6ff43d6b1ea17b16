"""Two trees' arrays, arm by arm: which differ, and where first."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import renamed

Curves = Mapping[str, Mapping[str, np.ndarray]]


@dataclass
class Verdict:
    """What comes of comparing.

    Attributes:
        total: arrays compared by value.
        equal: those whose values are the same, or within the tolerance.
        differences: ``(episode, run, in words)``: the first of each array that differs.
        notes: what else there is to say, with the arms that it is said of.
    """

    total: int = 0
    equal: int = 0
    differences: list[tuple[int, int, str]] = field(default_factory=list)
    notes: dict[str, list[str]] = field(default_factory=dict)

    @property
    def first(self) -> str:
        """The first difference of all; "" where there is none."""
        return min(self.differences)[2] if self.differences else ""

    def note(self, said: str, arm: str) -> None:
        """Says it of one arm more."""
        self.notes.setdefault(said, []).append(arm)

    def differs(self, said: str) -> None:
        """What is not as in the base from the start."""
        self.differences.append((-1, 0, said))


class Pair(NamedTuple):
    """An array of one run in both trees, one axis at least; ``by_episode``: that is the first."""

    name: str
    run: int
    old: np.ndarray
    new: np.ndarray
    by_episode: bool


def compare(old: Curves, new: Curves, tolerance: float | None = None, module: str = "") -> Verdict:
    """Compares what two trees left, by arm.

    Args:
        old: the base's.
        new: the other's.
        tolerance: None wants the same bits. Otherwise what `renamed.LOSSES` names may differ by as
            much until anything else of the same run differs by more; from there on all may.
        module: whose arms they are.
    """
    verdict = Verdict()
    today = {renamed.arm_of(module, arm): values for arm, values in old.items()}
    for arm in new:
        if arm not in today:
            verdict.note("only new", arm)
    for arm, values in today.items():
        if arm not in new:
            verdict.differs(f"{arm}: only in the base")
            continue
        pairs = _matched(verdict, arm, values, new[arm])
        until = {} if tolerance is None else _goes_apart(pairs, tolerance)
        for run, at in until.items():
            verdict.note(f"run {run} goes apart at {at + 1}", arm)
        wrong = {}
        for pair in pairs:
            if not pair.by_episode and until.get(pair.run):
                continue
            end = until.get(pair.run) or None
            found = _difference(pair._replace(old=pair.old[:end], new=pair.new[:end]), tolerance)
            if found is not None:
                found = (*found[:2], f"{arm}/{found[2]}")
                wrong[pair.name] = min(found, wrong.get(pair.name, found))
        names = {pair.name for pair in pairs}
        verdict.total += len(names)
        verdict.equal += len(names) - len(wrong)
        verdict.differences += wrong.values()
    if not verdict.total:
        verdict.differs("nothing is compared by value")
    return verdict


def _matched(verdict: Verdict, arm: str, old: Mapping, new: Mapping) -> list[Pair]:
    """What both have of an arm; the rest, and what is judged, goes to the verdict."""
    pairs, known = [], set()
    for name, values in old.items():
        names = renamed.arrays(name)
        judged = renamed.is_one(name, renamed.JUDGED)
        found = next((one for one in names if one in new), None)
        known.add(found)
        if found is None:
            verdict.note(f"{name}: only in the base{', judged' if judged else ''}", arm)
            if names and not judged:
                verdict.differs(f"{arm}/{name}: only in the base")
            continue
        other, shown = new[found], found.startswith("show_")
        if other.shape == (*values.shape[:1], 1, *values.shape[1:]):
            other = other[:, 0]  # of the one unit that a run has
        alone = values[0] if shown and values.ndim > other.ndim else values
        if judged:
            verdict.note(f"{name}: judged: {_judged(alone, other)}", arm)
        elif shown:
            alone, other = np.atleast_1d(alone), np.atleast_1d(other)
            pairs.append(_cut(Pair(name, 0, alone, other, False), old, new))
        elif len(values) != len(other):
            verdict.differs(f"{arm}/{name}: {len(values)} runs are now {len(other)}")
        else:
            both = enumerate(zip(values, other, strict=True))
            pairs += [_cut(Pair(name, run, *map(np.atleast_1d, pair), False), old, new)
                      for run, pair in both]  # fmt: skip
    for name in new:
        if name not in known:
            verdict.note(f"{name}: only new", arm)
    whole = sum(len(pair.old) for pair in pairs if pair.name == "real_return")
    if "real_return" in old and whole < old["real_return"].size:
        of = old["real_return"].size
        verdict.note(f"{whole} of {of} episodes, up to the runs' own ends", arm)
    return pairs


def _judged(old: np.ndarray, new: np.ndarray) -> str:
    if old.shape != new.shape:
        return f"shape {old.shape} is now {new.shape}"
    return "shape equal" if _first(old, new, None) is not None else "shape and values equal"


def _cut(pair: Pair, old: Mapping, new: Mapping) -> Pair:
    """An array by episode up to the run's own end, after which there is NaN."""
    if "real_return" not in old or "real_return" not in new:
        return pair._replace(by_episode=True)
    lengths = old["real_return"].shape[1:], new["real_return"].shape[1:]
    if (pair.old.shape[:1], pair.new.shape[:1]) != lengths:
        return pair
    end = min(len(pair.old), int(np.isfinite(new["real_return"][pair.run]).sum()))
    return pair._replace(old=pair.old[:end], new=pair.new[:end], by_episode=True)


def _goes_apart(pairs: list[Pair], tolerance: float) -> dict[int, int]:
    """By run, the episode (from 0) at which anything but a loss differs first."""
    until: dict[int, int] = {}
    for pair in pairs:
        if pair.by_episode and not renamed.is_one(pair.name, renamed.LOSSES):
            episode = _first(pair.old, pair.new, tolerance)
            if episode is not None:
                until[pair.run] = min(until.get(pair.run, episode), episode)
    return until


def _difference(pair: Pair, tolerance: float | None) -> tuple[int, int, str] | None:
    if pair.old.shape != pair.new.shape:
        return -1, pair.run, f"{pair.name}: {pair.old.shape} is now {pair.new.shape}"
    at = _first(pair.old, pair.new, tolerance)
    if at is None:
        return None
    old, new = pair.old[at].ravel(), pair.new[at].ravel()
    one = _first(old, new, tolerance)
    where = f"{pair.name}, run {pair.run}, episode {at + 1}"
    return at, pair.run, f"{where}: {old[one]} is now {new[one]}"


def _first(old: np.ndarray, new: np.ndarray, tolerance: float | None) -> int | None:
    """Where two arrays differ first along their first axis; None where they do not."""
    if old.shape != new.shape:
        return 0
    old, new = np.atleast_1d(old), np.atleast_1d(new)
    if tolerance is None:
        wrong = (old != new) & ~(np.isnan(old) & np.isnan(new))
    else:
        wrong = ~np.isclose(old, new, rtol=tolerance, atol=tolerance, equal_nan=True)
    wrong = wrong.reshape(len(wrong), -1).any(1)
    return int(wrong.argmax()) if wrong.any() else None
