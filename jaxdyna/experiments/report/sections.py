"""The sections that most reports share: pure functions of a record, each with its figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from jaxdyna.experiments.report import plots
from jaxdyna.experiments.report.settings import settings_table
from jaxdyna.experiments.report.summaries import HELD_EPISODES, comparisons, mean_of_runs
from jaxdyna.experiments.report.tables import (
    Table,
    arm_table,
    end_table,
    interval,
    markdown_table,
    quantile_table,
    runs,
    time_table,
)
from jaxdyna.statistics import SolveRule, episodes_to_solve

Section = Callable[[Any], str]
Rule = Callable[[Any], SolveRule]
COUNTED = (
    "The rule is the same for all arms and counts every real episode. An unsolved run is never "
    "dropped: it leaves the mean undefined, of which only a lower bound (≥) is then known."
)


def paragraphs(*parts: str) -> str:
    """Put below each other; empty ones are left out."""
    return "\n\n".join(part.strip("\n") for part in parts if part)


def figure(record: Any, name: str, said: str) -> str:
    """A figure's line, where there is that file."""
    return f"![{said}]({name})" if (record.out / name).exists() else ""


def solving(
    rule: Rule, paper: Mapping[str, float], ratio: Mapping[str, float], said: str = ""
) -> Section:
    """The table of arms and the ratios between them; the paper's own figures beside."""

    def section(record: Any) -> str:
        options, results = record.options, record.results
        counted = len(results["runs"]["seeds"])
        about = f"{runs(counted)} of each arm. {str(rule(options)).capitalize()}. {said}"
        return paragraphs(
            f"{about} {COUNTED}", markdown_table(*arm_table(results, paper)),
            *comparisons(results, ratio), swept(record),
        )  # fmt: skip

    return section


def learning_curves(
    rule: Rule, name: str = "returns.png", said: str = "return against real episodes",
    what: str = "return", window: int | None = None, arms: Sequence[str] = (),
    real_first: Callable[[Any], int] = lambda options: options.dyna.num_real_first,
) -> Section:  # fmt: skip
    """Real return against real episodes, a panel an arm, and the share of runs that have solved."""

    def section(record: Any) -> str:
        solves, shown = rule(record.options), drawn(record, arms)
        returns = {name: _levelled(solves, curves) for name, curves in shown.items()}
        at = {
            name: episodes_to_solve(solves.score(curves), solves)
            for name, curves in record.curves.items()
        }
        plots.learning_curves(record.out / name, returns, solves.threshold, at,
                              real_first(record.options), what, window)  # fmt: skip
        return paragraphs(f"![{said}]({name})", solved_share(rule)(record))

    return section


def solved_share(rule: Rule) -> Section:
    """The share of the runs that have solved, against real episodes."""

    def section(record: Any) -> str:
        if not record.curves:
            return ""
        solves, first, known = rule(record.options), {}, {}
        for name, curves in record.curves.items():
            first[name] = episodes_to_solve(solves.score(curves), solves) - solves.window + 1
            played = int(np.isfinite(curves["real_return"]).sum(1).max())
            known[name] = max(played - solves.window + 1, 1)
        plots.solved_share(record.out / "solved.png", first, known)
        return "![share of the runs that have solved](solved.png)"

    return section


def _levelled(rule: SolveRule, curves: Mapping[str, np.ndarray]) -> np.ndarray:
    """Returns as the rule measures them: a share where it asks for one."""
    returns = curves["real_return"]
    return returns if rule.share_of is None else returns / curves[rule.share_of]


def drawn(record: Any, arms: Sequence[str]) -> Mapping[str, Any]:
    """The arms that are drawn: those named, or the first eight of all."""
    named = {name: record.curves[name] for name in arms if name in record.curves}
    return named or dict(list(record.curves.items())[:8])


def behaviour(measures: Mapping[str, str], window: int, name: str = "behaviour.png",
              said: str = "", arms: Sequence[str] = ()) -> Section:  # fmt: skip
    """What episodes are like against their number, a panel a curve, by the curve's name."""

    def section(record: Any) -> str:
        shown = drawn(record, arms)
        panels = {
            title: {arm: curves[key] for arm, curves in shown.items() if key in curves}
            for key, title in measures.items()
        }
        panels = {title: drawn for title, drawn in panels.items() if drawn}
        if not panels:
            return ""
        plots.behaviour(record.out / name, panels, window)
        return paragraphs(said, f"![{', '.join(panels)}]({name})")

    return section


def swept(record: Any) -> str:
    """A figure of what was swept: curves for one field, a map for two; empty where nothing was."""
    sweep, arms = record.results["sweep"], record.results["arms"]
    shape = [len(values) for values in sweep.values()]
    whole = {arm: names for arm, names in _by_arm(record).items() if len(names) == np.prod(shape)}
    if not sweep or not whole or not all("final_return" in arm for arm in arms.values()):
        return ""
    if len(sweep) == 1:
        [(path, values)] = sweep.items()
        returns = {
            arm: [record.curves[name]["real_return"] for name in names]
            for arm, names in whole.items()
        }
        plots.swept_curves(record.out / "sweep.png", path, values, returns)
    elif len(sweep) == 2:
        solved = {
            arm: np.array([arms[name]["episodes_to_solve"]["restricted_mean"] for name in names])
            .reshape(shape)
            for arm, names in whole.items()
        }  # fmt: skip
        plots.swept_map(record.out / "sweep.png", sweep, solved)
    return figure(record, "sweep.png", f"swept: {', '.join(sweep)}")


def _by_arm(record: Any) -> dict[str, list[str]]:
    names: dict[str, list[str]] = {}
    for name, arm in record.results["arms"].items():
        names.setdefault(arm.get("arm", name), []).append(name)
    return names


def distribution(record: Any) -> str:
    """Quantiles over the runs of the solving window's first episode."""
    return paragraphs(
        "## The whole distribution",
        "`first_solved`, the number of the solving window's first episode, in quantiles over the "
        "runs. The window forgives a few falls at its start, so that the policy may be found only "
        "some episodes later:",
        markdown_table(*quantile_table(record.results, "first_solved")),
        "The first single episode at or above the threshold:",
        markdown_table(*quantile_table(record.results, "first_at_threshold")),
    )


def endings(rule: Rule) -> Section:
    """How each arm ended."""

    def section(record: Any) -> str:
        return paragraphs(
            markdown_table(*end_table(record.results, rule(record.options).window)),
            f"Held: solved, and still so good over the last {HELD_EPISODES} episodes that the run "
            "played.",
        )

    return section


def equal_episodes(baselines: Sequence[str], arms: Sequence[str] = (), last: int = 20) -> Section:
    """Returns in the last episodes that every run of all arms has played, and less a baseline's run
    by run: runs of the same number begin with the same key. Empty where nothing can be compared.
    """

    def cell(values: np.ndarray, sign: str) -> str:
        said = mean_of_runs(values)
        ends = interval(said["ci95"], 2)
        return f"{said['mean']:{sign}.2f}{'' if ends == '-' else f' ({ends})'}"

    def section(record: Any) -> str:
        returns = {
            name: curves["real_return"]
            for name, curves in record.curves.items()
            if name in arms or not arms
        }
        known = [name for name in baselines if name in returns]
        end = min(int(np.isfinite(values).sum(1).min()) for values in returns.values())
        if not known or len(returns) == 1 or end < last:
            return ""
        at = {name: values[:, end - last : end].mean(1) for name, values in returns.items()}
        rows = [
            [name, cell(mine, ""), *("-" if name == other else cell(mine - at[other], "+")
                                     for other in known)]
            for name, mine in at.items()
        ]  # fmt: skip
        return paragraphs(
            "After as many real episodes: the mean return of episodes "
            f"{end - last + 1} to {end}, the last that every run has played, and less another "
            "arm's run by run; 95% intervals over runs.",
            markdown_table(["arm", "return", *(f"less that of {name}" for name in known)], rows),
        )

    return section


def arms_said(said: Mapping[str, str]) -> Section:
    """What each arm that was played is."""

    def section(record: Any) -> str:
        named = {arm.get("arm", name) for name, arm in record.results["arms"].items()}
        lines = [f"- `{name}`: {text}" for name, text in said.items() if name in named]
        return paragraphs("## The arms", "\n".join(lines)) if lines else ""

    return section


def settings(record: Any) -> str:
    """Everyday settings, and whatever is not as declared."""
    return paragraphs("## Settings", markdown_table(*settings_table(record.options)))


def spent(record: Any) -> str:
    """Seconds and memory."""
    peak = record.results["device"]["peak_memory_gib"]
    memory = f"The process took {peak:.1f} GiB of memory at the most." if peak else ""
    return paragraphs("## Time", markdown_table(*time_table(record.results)), memory)


def solve_summary(title: str, paper: Mapping[str, float],
                  ratio: Mapping[str, float]) -> Callable[[Any], list[Any]]:  # fmt: skip
    """The table of arms in the terminal, and the ratios under it."""

    def summary(record: Any) -> list[tuple[str, Table] | str]:
        results, options = record.results, record.options
        counted = runs(len(results["runs"]["seeds"]))
        head = f"{title}, {options.preset} preset, {counted} an arm"
        header, rows = arm_table(results, paper)
        short = ["episodes to solve" if "episodes to solve" in name else name for name in header]
        timing = results["timing"]
        return [
            (head, (short, rows)), *comparisons(results, ratio),
            f"{timing['total_s']:.1f} s in all: compiling {timing['compile_s']:.1f}, running "
            f"{timing['run_s']:.1f}",
        ]  # fmt: skip

    return summary
