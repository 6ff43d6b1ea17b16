"""The sections that most reports share: pure functions of a record, each with its figures."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import wraps
from itertools import product
from typing import Any, Concatenate, ParamSpec

import numpy as np

from jaxdyna import fields
from jaxdyna.experiments.report import frames, plots, tables
from jaxdyna.experiments.report.summaries import (
    AS_BUSY,
    HELD_EPISODES,
    baseline_of,
    break_even,
    comparison,
    comparisons,
)
from jaxdyna.experiments.report.tables import Results, markdown_table, paragraphs, runs
from jaxdyna.statistics import FEW, brunner_munzel, episodes_to_solve, mean_of_runs, summarise

Section = Callable[[Any], str]
Rule = Callable[[Any], Any]  #: of options their `SolveRule`, or None
P = ParamSpec("P")
COUNTED = (
    "The rule is the same for all arms and counts every real episode. An unsolved run is never "
    "dropped: it counts as the budget (a restricted mean)."
)
NONE_OF_FEW = "Figures of solving have no interval: of five runs or fewer none can be trusted."
QUANTILES = (5, 50, 95, 99)
BOTH = "dyna", "model_free"  #: that are compared first of all
LOWERED = np.linspace(0.5, 1, 11)  #: shares of a rule's threshold
#: curves of how wrong a model is one step ahead: `jaxdyna.models.evaluation.frame_errors`
WRONG = {
    "wrong_frames": "share of new frames predicted wrong",
    "wrong_rewards": "share of new rewards predicted wrong",
}
NOT_SHOWN = ("preset", "quick", "arms")
#: what settings begin with that are told only where one of these arms, or of what begins so, is
ARMS_OWN = {
    "dqn": ("dqn",), "mpc": ("mpc",), "mcts": ("mcts",),
    "cloning": ("mpc_init", "mpc_clone"), "shown": ("mpc_init", "mpc_clone")}  # fmt: skip


def told(section: Callable[Concatenate[Any, P], str]) -> Callable[P, Section]:
    """A section that is told more than the record: called with that, it gives the section."""

    @wraps(section)
    def tell(*args: P.args, **more: P.kwargs) -> Section:
        return lambda record: section(record, *args, **more)

    return tell


def with_rule(section: Callable[Concatenate[Any, Rule, P], str]) -> Callable[..., Section]:
    """A section of a record and a rule, likewise; empty where its settings have no rule, or runs
    are shorter than its window.
    """

    @told
    @wraps(section)
    def tell(record: Any, rule: Rule, *args: P.args, **more: P.kwargs) -> str:
        solves = rule(record.options)
        there = solves is not None and solves.window <= record.options.episodes
        return section(record, rule, *args, **more) if there else ""

    return tell


def grouped(record: Any, by: str = "arm", of: str = "setting") -> dict[str, dict[str, str]]:
    """The full names of the entries of ``results["arms"]``, by arm and setting, or the reverse."""
    names: dict[str, dict[str, str]] = {}
    for name, entry in record.results["arms"].items():
        names.setdefault(entry.get(by, name), {})[entry.get(of, name)] = name
    return names


@told
def solving(
    record: Any, rule: Rule, paper: Mapping[str, float] = {}, ratio: Mapping[str, float] = {},
    said: str = "",
) -> str:  # fmt: skip
    """The table of arms and the ratios between them, where there is a rule; the paper's own figures
    beside.
    """
    count, solves = len(record.results["runs"]["seeds"]), rule(record.options)
    if solves is None:
        return ""
    if solves.window > record.options.episodes:
        return (
            f"**No run can have solved**: the rule asks for {solves.window} episodes, and runs are "
            f"{record.options.episodes} long. Give more --episodes to compare arms by it."
        )
    arms, columns = record.results["arms"], tables.solving(record.results)
    steps = [tables.median(arm["real_steps_to_solve"]) for arm in arms.values()]
    columns["real steps before: median"] = steps
    if set(paper) & set(arms):
        own = [f"{paper[name]:g}" if name in paper else "-" for name in arms]
        columns = {"arm": [*arms], "paper": own, **columns}
    return paragraphs(
        f"{runs(count)} of each arm. {str(solves).capitalize()}. {COUNTED} {said}".rstrip(),
        tables.side_by_side(columns), "" if count > FEW else NONE_OF_FEW, _never(record),
        _half(record.results),
        *comparisons(record.results, ratio), _windowless(record.results), _price(record.results),
        swept(record))  # fmt: skip


def _half(results: Results) -> str:
    """The restricted means at half the budget, where some run did not solve in all of it."""
    arms, half = results["arms"], results["config"]["episodes"] / 2
    figures = {name: arm["episodes_to_solve"] for name, arm in arms.items()}
    if all(one["solved"] == one["seeds"] for one in figures.values()):
        return ""
    said = []
    for name, one in figures.items():
        values = tables.per_seed(one)
        cut = summarise(np.where(values <= half, values, np.inf), at_least=half)
        said.append(f"{name} {cut['solved']}/{cut['seeds']}, {tables.with_interval(cut)}")
    return f"Within half the budget, {half:g} episodes: {'; '.join(said)}."


def _windowless(results: Results) -> str:
    """The window stands in both terms of a ratio, and pulls it towards 1."""
    lines = comparison(results, {}, figure="first_solved")
    found = [line for line in lines if line.startswith("dyna needs")]
    return f"Without the window: {found[0]}" if found else ""


def _price(results: Results) -> str:
    """From what price of a real step on dreams pay."""
    found = break_even(results)
    if found is None:
        return ""
    extra, saved, price = found
    where, more = f"where a real step takes longer than **{_short(price)} ms**", "more"
    if extra <= 0:
        where, more = "**whatever a real step takes**", "less"
    return (
        f"Dreams pay {where}: a run of dyna computes for {_short(abs(extra))} s {more} than one of "
        f"model_free, and saves {saved:,.0f} real steps before the solving window. (Seconds of one "
        "core or device, of runs that were played beside others and to their end, judging with "
        "them and compiling left out.)"
    )


def _short(value: float) -> str:
    return f"{value:,.0f}" if value >= 10 else f"{value:.2g}"


@with_rule
def thresholds(record: Any, rule: Rule) -> str:
    """Episodes to solve against the threshold; empty where that is 0 or less."""
    solves, budget = rule(record.options), record.options.episodes
    if solves.threshold <= 0 or not record.curves:
        return ""
    lowered = [replace(solves, threshold=float(share * solves.threshold)) for share in LOWERED]

    def needed(curves: Mapping[str, np.ndarray]) -> np.ndarray:
        return np.stack([episodes_to_solve(one.score(curves), one) for one in lowered], axis=-1)

    def within(values: np.ndarray) -> np.ndarray:
        return np.clip(plots.around(values), min(solves.window, budget), budget)

    every = {name: needed(curves) for name, curves in drawn(record, ()).items()}
    lines = {name: np.minimum(values, budget) for name, values in every.items()}
    axis = "threshold, as a share of the rule's"
    axes = axis, f"episodes to solve: mean, {plots.shaded(next(iter(lines.values())))}"
    if not plots.bands(record.out / "thresholds.png", {"": lines}, *axes, at=LOWERED,
                       interval=within):  # fmt: skip
        return ""
    said = ""
    if {*BOTH} <= lines.keys():
        ratios = lines[BOTH[0]].mean(0) / lines[BOTH[1]].mean(0)
        known = [2 * np.isfinite(every[name]).sum(0) >= len(every[name]) for name in BOTH]
        told = [
            f"{share:.2f}: {ratio:.2f}"
            for share, ratio, some in zip(LOWERED, ratios, np.any(known, axis=0), strict=True)
            if some
        ][::2]
        said = "dyna's episodes over model_free's where a lower threshold is asked for"
        said = f"{said}: {'; '.join(told)}." if told else ""
    return paragraphs("![episodes to solve against the threshold](thresholds.png)", said)


def area(record: Any) -> str:
    """The area under each arm's learning curve up to where the first run of any arm ends, tested
    against the same arms as its figures of solving.
    """
    returns = {name: curves["real_return"] for name, curves in record.curves.items()}
    if len(returns) < 2:
        return ""
    end = min(int(np.isfinite(values).sum(1).min()) for values in returns.values())
    areas = {name: values[:, :end].mean(1) for name, values in returns.items()}
    tests = {name: _against(name, areas, record.results["arms"]) for name in areas}
    said = [f"{name} {tables.with_interval(mean_of_runs(values), 1)}{tests[name]}"
            for name, values in areas.items()]  # fmt: skip
    how = " (Brunner and Munzel's test)" if any(tests.values()) else ""
    return (
        "Without a threshold, the area under the learning curve: the mean return of the first "
        f"{end} real episodes, as many as every run has played: {'; '.join(said)}{how}."
    )


def _against(name: str, areas: Mapping[str, np.ndarray], arms: Results) -> str:
    """The p of an arm's areas ``[seeds]``, in words, against those it is compared with."""
    entry, said = {"arm": name} | arms.get(name, {}), ""
    for other in ("model_free", *(AS_BUSY if entry["arm"] == "dyna" else ())):
        base = baseline_of(entry, other)
        p = brunner_munzel(areas[name], areas[base]) if base in areas and base != name else None
        said += "" if p is None else f", {tables.p_value(p)} against {base}"
    return said


def _never(record: Any) -> str:
    """What to think of where no single episode of any run came up to the rule's threshold."""
    reached = [arm["first_at_threshold"]["solved"] for arm in record.results["arms"].values()]
    if any(reached):
        return ""
    highest = max(np.nanmax(curves["real_return"]) for curves in record.curves.values())
    return (
        "**No episode of any run reached the threshold**; the highest return was "
        f"{highest:.4g}. Can this world give more?"
    )


@told
def learning_curves(
    record: Any, rule: Rule, name: str = "returns.png", said: str = "return against real episodes",
    what: str = "return", window: int | None = None, arms: Sequence[str] = (), begins: bool = True,
) -> str:  # fmt: skip
    """Real return against real episodes, all arms in one panel, and where there is a rule the share
    of runs that have solved; ``begins``: whether it shows when dreams and planners begin.
    """
    solves, returns, at = rule(record.options), {}, {}
    for arm, curves in drawn(record, arms).items():
        whole = curves[solves.share_of] if solves and solves.share_of else 1
        returns[arm] = curves["real_return"] / whole
        if solves:
            at[arm] = episodes_to_solve(solves.score(curves), solves)
    asked, smooth = (solves.threshold, min(solves.window, 20)) if solves else (None, 20)
    begins = begins and "dyna.num_real_first" not in record.results["sweep"]
    kinds = " and ".join(sorted({_begun(arm) for arm in returns if begins} - {""}))
    first = {kinds: record.options.dyna.num_real_first} if kinds else {}
    plots.learning_curves(record.out / name, returns, asked, at, first, window or smooth, what)
    shown, there = len(returns), len(record.curves)
    few = f"Curves are drawn of {shown} of the {there} arms." if shown < there else ""
    return paragraphs(f"![{said}]({name})", few, solved_share(rule)(record))


def _begun(arm: str) -> str:
    """What begins in an arm after the first N real episodes."""
    if arm.startswith(("mpc", "mcts")):
        return "planners begin"
    alone = ("model_free", "max_updates", "more_updates", "random_search", "linear_model", "dqn")
    return "" if arm.startswith(alone) else "dreams begin"


@with_rule
def solved_share(record: Any, rule: Rule) -> str:
    """The share of the runs that have solved, against real episodes."""
    solves, solved = rule(record.options), {}
    for name, curves in drawn(record, ()).items():
        at = episodes_to_solve(solves.score(curves), solves)
        played = int(np.isfinite(curves["real_return"]).sum(1).max())
        solved[name] = at[:, None] <= np.arange(1, played + 1)
    said = "share of the runs that have solved"
    there = plots.shares(record.out / "solved.png", solved, "real episodes", said)
    return f"![{said}](solved.png)" if there else ""


def drawn(record: Any, arms: Sequence[str]) -> Mapping[str, Any]:
    """The arms that are drawn: those named, or the first eight of all."""
    named = {name: record.curves[name] for name in arms if name in record.curves}
    return named or dict(list(record.curves.items())[:8])


@told
def behaviour(
    record: Any, measures: Mapping[str, str], window: int, name: str = "behaviour.png",
    said: str = "", arms: Sequence[str] = (), log: bool = False,
) -> str:  # fmt: skip
    """What episodes are like against their number, a panel a curve, by the curve's name; ``log``:
    where what is drawn falls by orders of magnitude.
    """
    how = {"log": True} if log else {"ylim": (0, None)}
    shown = drawn(record, arms)
    panels = {
        title: {arm: curves[key] for arm, curves in shown.items() if key in curves}
        for key, title in measures.items()
    }
    panels = {title: lines for title, lines in panels.items() if lines}
    axis = f"real episodes\n(running mean of {window})"
    if not plots.bands(record.out / name, panels, axis, window=window, **how):
        return ""
    return paragraphs(said, f"![{', '.join(panels)}]({name})")


def swept(record: Any) -> str:
    """What was swept, of the arms of which every value has been played: returns for one field, a
    map of episodes to solve for two; the table alone says more.
    """
    sweep, arms, file = record.results["sweep"], grouped(record), record.out / "sweep.png"
    points = list(product(*sweep.values()))
    whole = {arm: list(names.values()) for arm, names in arms.items() if len(names) == len(points)}
    if len(sweep) not in (1, 2) or not whole:
        return ""
    if len(sweep) == 2:
        solved = {
            arm: [record.results["arms"][name]["episodes_to_solve"] for name in names]
            for arm, names in whole.items()
        }
        plots.swept_map(file, sweep, solved, "episodes to solve, mean")
    else:
        panels = {
            arm: {str(value): record.curves[name]["real_return"]
                  for (value,), name in zip(points, names, strict=True)}
            for arm, names in whole.items()}  # fmt: skip
        said = plots.shaded(np.array(record.results["runs"]["seeds"]))
        axes = "real episodes (running mean of 20)", f"return: mean of runs, {said}"
        if not plots.bands(file, panels, *axes, window=20, legend=next(iter(sweep))):
            return ""
    return f"![swept: {', '.join(sweep)}](sweep.png)"


def distribution(record: Any) -> str:
    """Quantiles over the runs of the solving window's first episode."""
    rows = []
    for name, arm in record.results["arms"].items():
        solved = tables.per_seed(arm["first_solved"])
        at = np.percentile(solved, [*QUANTILES, 100], method="inverted_cdf")
        rows.append([name, *("never" if np.isinf(one) else f"{one:,.0f}" for one in at)])
    return paragraphs(
        "## The whole distribution",
        "`first_solved`, the number of the solving window's first episode, in quantiles over the "
        "runs. The window forgives a few falls at its start, so that the policy may be found only "
        "some episodes later:",
        markdown_table(["arm", *(f"{percent}%" for percent in QUANTILES), "latest"], rows),
    )


@with_rule
def endings(record: Any, rule: Rule) -> str:
    """How each arm ended: episodes played, last returns, and whether what was solved held."""
    solves, stop = rule(record.options), record.options.stop_after_solved
    short = stop is not None and stop < HELD_EPISODES
    rows = [
        [name, f"{arm['episodes_played']['mean']:,.0f}",
         tables.with_interval(arm["final_return"], 1 if solves.threshold > 10 else 2),
         "-" if short else f"{arm['solved_and_held']}/{arm['final_return']['seeds']}"]
        for name, arm in record.results["arms"].items()]  # fmt: skip
    last = f"return of a run's last {solves.window}: mean (95% interval)"
    return paragraphs(
        markdown_table(["arm", "episodes played", last, "solved and held"], rows),
        f"Held: solved, and still so good over the last {HELD_EPISODES} episodes that the run "
        "played" + (f" (-: runs end {stop} episodes after they have solved)." if short else "."),
    )


@told
def equal_episodes(
    record: Any, baselines: Sequence[str], arms: Sequence[str] = (), last: int = 20
) -> str:
    """Returns in the last episodes that every run of all arms has played, and less a baseline's run
    by run: runs of the same number begin with the same key. Empty where nothing can be compared.
    """
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
        [name, tables.with_interval(mean_of_runs(mine), 2),
         *("-" if name == other else tables.with_interval(mean_of_runs(mine - at[other]), 2, "+")
           for other in known)]
        for name, mine in at.items()]  # fmt: skip
    return paragraphs(
        f"After as many real episodes: the mean return of episodes {end - last + 1} to {end}, the "
        "last that every run has played, and less another arm's run by run; 95% intervals over "
        "runs.",
        markdown_table(["arm", "return", *(f"less that of {name}" for name in known)], rows),
    )


@told
def arms_said(record: Any, said: Mapping[str, str]) -> str:
    """What each arm that was played is."""
    lines = [f"- `{name}`: {text}" for name, text in said.items() if name in grouped(record)]
    return paragraphs("## The arms", "\n".join(lines)) if lines else ""


def settings(record: Any) -> str:
    """Everyday settings, and whatever is not as declared."""
    results = record.results
    unplayed = set()  # the rows of a study may be any arm's
    if results.get("part") == results.get("experiment"):
        unplayed = {own for own, users in ARMS_OWN.items()
                    if not any(arm.startswith(users) for arm in grouped(record))}  # fmt: skip
    rows = [
        [f"`{leaf.path}`", _said(record.results["sweep"].get(leaf.path, leaf.value)), leaf.help]
        for leaf in fields.leaves(record.options)
        if leaf.path not in (*NOT_SHOWN, *record.options.decided)
        and re.split(r"[._]", leaf.path)[0] not in unplayed
        and (leaf.everyday or leaf.default not in (fields.MISSING, leaf.value))
    ]
    return paragraphs("## Settings", markdown_table(["setting", "value", "what it is"], rows))


def _said(value: Any) -> str:
    said = fields.plain(value)
    if isinstance(said, list):
        return " ".join(map(str, said))
    return f"{said:g}" if isinstance(said, float) else str(said)


def kept_policies(record: Any) -> str:
    """What the policies earn that were kept; empty where none was."""
    kept = {name: arm["kept_return"] for name, arm in record.results["arms"].items()
            if arm.get("kept_return", {}).get("mean") is not None}  # fmt: skip
    rows = [
        [name, tables.with_interval(said, 1), ", ".join(f"{one:.10g}" for one in said["per_seed"]
                                                        if one is not None)]
        for name, said in kept.items()]  # fmt: skip
    if not rows:
        return ""
    episodes = next(iter(kept.values()))["episodes"]
    return paragraphs(
        "## Kept policies",
        f"Mean return over {episodes} new episodes of each policy that was kept, as evaluated: "
        "`jaxdyna.load` opens them, `python -m jaxdyna.experiments.evaluate` plays them again, and "
        "films them (`--film`).",
        markdown_table(["arm", "mean (95% interval)", "each run's"], rows),
        f"![an episode of each arm]({frames.FILM})" if (record.out / frames.FILM).is_file() else "",
    )


def spent(record: Any) -> str:
    """Seconds and memory."""
    timing, device = record.results["timing"], record.results["device"]
    rows = [
        [name, f"{one.get('compile_s', 0):,.1f}",
         f"{one.get('run_s', one.get('measure_s', 0)):,.1f}"]
        for name, one in timing["arms"].items()]  # fmt: skip
    rows.append(["all, with drawing", "", f"{timing['total_s']:,.1f}"])
    header = [f"arm ({device['cpu_cores']} cores)", "compiling (s)", "running and judging (s)"]
    peak = device["peak_memory_gib"]
    memory = f"The process took {peak:.1f} GiB of memory at the most." if peak else ""
    return paragraphs("## Time", markdown_table(header, rows), memory)
