"""A study's report: rows beside the first, or from best to worst, in one figure of solving."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from jaxdyna.experiments.report import plots, tables
from jaxdyna.experiments.report.sections import paragraphs, told
from jaxdyna.experiments.report.summaries import FIRST_DREAMS, ratio_of
from jaxdyna.experiments.report.tables import Results, figure_at, per_seed, whole


@told
def rows(record: Any, column: str = "episodes_to_solve") -> str:
    """A line and a strip of dots for each row, in one of the figures of solving, by its path."""
    results, options = record.results, record.options
    if not results["arms"]:
        return ""
    figures = {name: figure_at(arm, column) for name, arm in results["arms"].items()}
    (name, first), *others = figures.items()
    columns = tables.solving(results, column, "row")
    columns["ratio to the first row"] = ["-", *(_ratio(figure, first) for _, figure in others)]
    columns["fake / real return"] = [
        f"{whole(dreams['fake_return'])} / {whole(dreams['real_return'])}" if dreams else "-"
        for dreams in (arm.get("first_dreams") for arm in results["arms"].values())]  # fmt: skip
    solved = {name: per_seed(figure) for name, figure in figures.items()}
    there = plots.solve_bars(record.out / "variants.png", solved, limit(results["arms"], column),
                             tables.spoken(column))  # fmt: skip
    return paragraphs(
        f"{tables.runs(len(results['runs']['seeds']))} of each row. The first row is the "
        f"`{options.preset}` preset; every other one changes what it says. "
        f"{counted(results['arms'][name], column)} At most {options.episodes} episodes; an "
        "unsolved run counts as what it played. The seeds are the same in "
        f"every row, so that the ratio to «{name}» is paired. "
        f"Fake and real return: medians over the first {FIRST_DREAMS} episodes with dreams.",
        tables.side_by_side(columns),
        "![every run of every row](variants.png)" if there else "",
    )


@told
def ranking(record: Any, grid: Callable[[Any], Mapping[str, Any]]) -> str:
    """The rows of a grid, by their restricted means, and whether the best stands at an edge of it;
    ``grid``: from options to all its rows, those that were not played too.
    """
    results, options, column = record.results, record.options, "episodes_to_solve"
    if not results["arms"]:
        return ""
    every = results["arms"].items()
    arms = dict(sorted(every, key=lambda one: one[1][column]["restricted_mean"]))
    (best, first), *_ = arms.items()
    solved = {name: per_seed(arm[column]) for name, arm in arms.items()}
    there = plots.solve_bars(record.out / "variants.png", solved, limit(arms, column),
                             "episodes to solve")  # fmt: skip
    names = tuple(grid(options))
    seconds = sum(one.get("run_s", 0.0) for one in results["timing"]["arms"].values())
    return paragraphs(
        f"{tables.runs(len(results['runs']['seeds']))} of each of {len(arms)} rows, of a grid of "
        f"{len(names)}, on base seed {options.seed}. {first['solve_rule'].capitalize()}. "
        f"At most {options.episodes} episodes; an unsolved run counts as so many. The rows are in "
        "the order of their restricted means. The best of many looks better than it is: these "
        "seeds choose a setting, others say what it is worth.",
        _winner(first[column], best, names),
        tables.side_by_side(tables.solving(results | {"arms": arms}, of="row")),
        "![every run of every row](variants.png)" if there else "",
        f"All rows together took {seconds / 3600:.2f} hours of {results['device']['cpu_cores']} "
        "cores.",
    )


def _winner(figure: Results, name: str, names: Sequence[str]) -> str:
    if not figure["solved"]:
        return "No run of any row has solved: there is no winner."
    edges = ", ".join(edge_of_grid(names, name))
    widen = (
        f" It stands at the edge of the grid ({edges}): try what lies beyond, or it is no winner."
    )
    return f"**{name}** has the lowest.{widen if edges else ''}"


def edge_of_grid(names: Sequence[str], winner: str) -> list[str]:
    """Those of a winner's values that stand at an end of what was tried: that have a number and
    come first or last in their place.

    Args:
        names: of all rows, such as ``"ratio 1, resets, rate 0.001, 3-step"``: what is varied in
            the same order, and the values of each as they rise or fall.
        winner: one of them.
    """
    places = zip(*(name.split(", ") for name in names), strict=True)
    tried = [list(dict.fromkeys(place)) for place in places]
    mine = winner.partition("@")[0].split(", ")
    return [
        value
        for value, values in zip(mine, tried, strict=True)
        if value in (values[0], values[-1])
        and any(letter.isdigit() for letter in value)
        and len(values) > 1
        and value != "1-step"  # beyond it there is nothing to try
    ]


def counted(arm: Results, column: str) -> str:
    """What a figure of solving counts, in words."""
    if not column.startswith("frozen"):
        return f"{arm['solve_rule'].capitalize()}."
    return (
        "Counted are the real steps after which a run's policy, as it stands between two episodes, "
        f"first earns {arm['frozen']['threshold']:.4g} on average in new ones."
    )


def limit(arms: Mapping[str, Results], column: str) -> int:
    """What an unsolved run counts as, at the most."""
    return int(max(figure_at(arm, column)["budget"] for arm in arms.values()))


def _ratio(solve: Results, first: Results) -> str:
    """To the first row's, run by run, in words."""
    ratio = ratio_of(solve, first, paired=True)
    said, ends = tables.number(ratio["ratio"], 2), tables.interval(ratio["ci95"], 2)
    return said if ends == "-" else f"{said} ({ends}; p {ratio['p']:.3f})"
