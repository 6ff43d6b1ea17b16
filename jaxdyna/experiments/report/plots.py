"""Figures. Every one says in its axes and legend what is drawn, and how it was smoothed.

All are as wide as a page shows them, so that a letter of 10 points is some 14 pixels high there.
Colours are Okabe and Ito's (2008), which colour-blind people tell apart; lines have dashes, too.
"""

import re
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import cycle, islice, product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import LogLocator, NullFormatter

from jaxdyna.experiments.report import tables
from jaxdyna.statistics import FEW, carried, mean_interval, running_mean, share_interval

WIDTH = 8.3  #: of every figure, in inches: 830 pixels where pages show them
BLACK, ORANGE, SKY, GREEN = "#000000", "#e69f00", "#56b4e9", "#009e73"
BLUE, VERMILION, PURPLE = "#0072b2", "#d55e00", "#cc79a7"
SOLID, DASHED, DOTTED = "-", (0, (5, 2)), (0, (1, 1.2))
DASH_DOTTED, LONG = (0, (6, 1.5, 1, 1.5)), (0, (9, 2))
DASHES = SOLID, DASHED, DOTTED, DASH_DOTTED


class Look(NamedTuple):
    """A line's colour and dashes, as matplotlib takes them."""

    color: str
    linestyle: Any


LOOKS = {
    "model_free": Look(BLACK, SOLID), "dyna": Look(GREEN, SOLID),
    "placebo": Look(ORANGE, DASH_DOTTED), "oracle": Look(BLUE, DASHED),
    "more_updates": Look(VERMILION, DASHED), "max_updates": Look(PURPLE, DOTTED),
    "mpc": Look(SKY, SOLID), "mcts": Look(PURPLE, DASH_DOTTED),
    "mpc_init": Look(VERMILION, DASH_DOTTED), "mpc_init_dyna": Look(BLUE, LONG),
    "mpc_clone": Look(ORANGE, DOTTED), "random_search": Look(PURPLE, LONG),
    "linear_model": Look(SKY, DASHED), "dqn": Look(VERMILION, SOLID),
    "dyna_l2": Look(SKY, LONG), "dyna_adversarial": Look(BLUE, DASH_DOTTED),
    "true_ball": Look(ORANGE, SOLID), "true_own": Look(PURPLE, SOLID),
    "true_opponent": Look(BLACK, DOTTED), "true_frames": Look(BLUE, SOLID)}  # fmt: skip
#: of lines that have none of their own, one after the other
OTHERS = [
    Look(color, linestyle)
    for linestyle, color in product(DASHES, (GREEN, BLUE, VERMILION, PURPLE, SKY, ORANGE, BLACK))
]
#: of levels that points are compared with
REFERENCES = Look(BLUE, DOTTED), Look(VERMILION, DASH_DOTTED), Look(PURPLE, DASHED)
MARK, FAINT = VERMILION, "#767676"
MARKED = 5  #: points of a line that are marked: of one alone nothing would be seen
FIG5 = {
    "truth": {"color": ORANGE, "linewidth": 3.5, "label": "real environment"},
    "one_step": {"color": BLUE, "linewidth": 1.3, "label": "model, one step ahead"},
    "open_loop": {"color": BLACK, "linewidth": 1.3, "linestyle": DASHED,
                  "label": "model, fed with its own predictions"}}  # fmt: skip


def learning_curves(
    path: Path, returns: Mapping[str, np.ndarray], threshold: float | None,
    solved_at: Mapping[str, np.ndarray], begins: Mapping[str, int], window: int,
    what: str = "return",
) -> None:  # fmt: skip
    """Figs. 6 and 8: all arms in one panel, the mean over runs of real returns ``[seeds,
    episodes]``, NaN after a run's own end, against real episodes.

    Args:
        path: the PNG.
        returns: by arm.
        threshold: the line that a run's mean has to reach; None: nothing is solved.
        solved_at: by arm ``[seeds]``, infinity where unsolved; not of arms of which it is not said.
        begins: by what begins in all arms that have it, the real episode.
        window: episodes in every line's running mean.
        what: the returns are, on the axis.
    """
    figure, panel = subplots(figsize=(WIDTH, 5.0 + 0.2 * max(len(returns) - 6, 0)))
    early = any(np.isnan(values).any() for values in returns.values())
    for (name, values), look in zip(returns.items(), looks([*returns]), strict=True):
        at, said = solved_at.get(name, np.zeros(0)), tables.label(name)
        said += f": {np.isfinite(at).sum()}/{len(at)} solved" if at.size else ""
        said += f", mean {at.mean():.0f}" if at.size and np.isfinite(at).all() else ""
        band(panel, carried(running_mean(values, window)), look, said)
    if threshold is not None:
        panel.axhline(threshold, color=FAINT, linewidth=1, linestyle=DASHED,
                      label=f"solved: {threshold:g}")  # fmt: skip
    for said, episode in begins.items():
        panel.axvline(episode, color=FAINT, linewidth=1.2, linestyle=DOTTED,
                      label=f"{said}: {episode}")  # fmt: skip
    over = "; a run that is over keeps its last value" if early else ""
    x = f"real episodes (running mean of {window}{over})"
    finish(panel, x=x, y=f"{what}: mean, {shaded(values)}")
    legend_above(figure, [panel])
    save(figure, path)


def bands(
    path: Path, panels: Mapping[str, Mapping[str, np.ndarray]], x: str, y: str = "", *,
    window: int | None = None, at: np.ndarray | None = None,
    dots: Mapping[str, Sequence[int]] | None = None, legend: str | None = None,
    interval: Callable[[np.ndarray], Any] | None = None, log: bool = False, **axes: Any,
) -> bool:  # fmt: skip
    """Means over seeds, `shaded`: panels by title, in each of them lines by name. Panels in which
    nothing varies are left out; where all are, there is no figure. Returns whether there is one.

    Args:
        path: the PNG.
        panels: by title and name ``[seeds, n]``.
        x: what the numbers 1 to n are.
        y: what all lines are, where titles do not say what each panel's are.
        window: of a running mean over episodes, in which a run that is over keeps its last value;
            None: the values as they are.
        at: other numbers than 1 to n, of the longest line.
        dots: by name, positions of dots on the line.
        legend: its title.
        interval: what is shaded instead, ``[seeds, n] -> [2, n]``.
        log: whether what is drawn is positive and falls by orders of magnitude.
        axes: of every panel, as ``matplotlib.axes.Axes.set`` takes them.
    """
    panels = {title: lines for title, lines in panels.items() if _vary(lines.values())}
    if not panels:
        path.unlink(missing_ok=True)  # of an earlier record in the same place
        return False
    figure, drawn = laid_out(len(panels), sharey=bool(y))
    names = list(dict.fromkeys(name for lines in panels.values() for name in lines))
    own = dict(zip(names, looks(names), strict=True))
    interval = interval or partial(around, positive=log)
    axes |= {"yscale": "log"} if log else {}
    for panel, (title, lines) in zip(drawn.flat, panels.items(), strict=False):
        for name, values in lines.items():
            shown = carried(running_mean(values, window)) if window else values
            marker = "o" if dots or shown.shape[1] <= MARKED else None
            band(panel, shown, own[name], tables.label(name), at, interval, marker=marker,
                 markersize=5, markevery=(dots or {}).get(name))  # fmt: skip
        panel.set(**axes)
        if panel.get_xscale() == "log":
            few = np.ptp(np.log10(at[[0, -1]])) < 2 if at is not None else False
            panel.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if few else (1,)))
            panel.xaxis.set_major_formatter("{x:,.0f}")
            panel.xaxis.set_minor_formatter(NullFormatter())
        finish(panel, textwrap.fill(title, 84 // drawn.shape[1]), x)
    for panel in drawn[:, 0]:
        panel.set_ylabel(y)
    legend_above(figure, drawn.flat, legend)
    save(figure, path)
    return True


def shares(path: Path, hits: Mapping[str, np.ndarray], x: str, y: str, **more: Any) -> bool:
    """`bands` of shares of the seeds, by name bool ``[seeds, n]``; shaded from the first seed's hit
    on: before, all are the same; and where there are more than a few.
    """

    def interval(hits: np.ndarray) -> np.ndarray:
        return np.where(hits.any(0) & (len(hits) > FEW), share_interval(hits), np.nan)

    lines = {name: values.astype(float) for name, values in hits.items()}
    if max(map(len, lines.values()), default=0) > FEW:
        y = f"{y},\n95% interval (Clopper and Pearson)"
    return bands(path, {"": lines}, x, y, interval=interval, ylim=(-0.02, 1.02), **more)


def _vary(values: Iterable[np.ndarray]) -> bool:
    """Whether there is more than one number in all of them."""
    known = np.concatenate([np.empty(0), *(one[np.isfinite(one)] for one in values)])
    return bool(known.size and np.ptp(known) > 0)


def prediction_figure(
    path: Path, episodes: Mapping[str, Mapping[str, np.ndarray]], variables: Sequence[str]
) -> None:
    """Fig. 5: every output of the model beside the truth, a column an episode: by title its
    ``truth``, ``one_step`` and ``open_loop``, each ``[T, variables]``.
    """
    rows, columns = len(variables), len(episodes)
    size = (WIDTH, 1.5 * rows + 0.4)
    figure, panels = subplots(rows, columns, figsize=size, sharex="col", squeeze=False)
    for column, (title, series) in zip(panels.T, episodes.items(), strict=True):
        for row, panel in enumerate(column):
            for kind, style in FIG5.items():
                panel.plot(np.arange(1, len(series[kind]) + 1), series[kind][:, row], **style)
            shown = np.concatenate([series[kind][:, row] for kind in ("truth", "one_step")])
            low, high = np.nanmin(shown), np.nanmax(shown)
            margin = max(0.25 * (high - low), 0.05)
            panel.set_ylim(low - margin, high + margin)
            finish(panel)
        column[0].set_title(title, loc="left", fontsize=11)
        column[-1].set_xlabel("step")
    for panel, name in zip(panels[:, 0], variables, strict=True):
        panel.set_ylabel(name)
    legend_above(figure, panels.flat)
    save(figure, path)


def solve_bars(path: Path, solved_at: Mapping[str, np.ndarray], limit: int, axis: str) -> bool:
    """When many settings solved (``[seeds]``): every seed a dot, the mean a bar; on the right the
    unsolved, infinity, each counted as ``limit``. Returns whether there is one: not where all are
    the same.
    """
    if not _vary(np.minimum(values, limit) for values in solved_at.values()):
        path.unlink(missing_ok=True)
        return False
    names = [textwrap.fill(name, 36) for name in solved_at]
    lines = sum(1 + name.count("\n") for name in names)
    figure, panel = subplots(figsize=(WIDTH, 0.2 * len(names) + 0.2 * lines + 1.4))
    jitter = np.random.default_rng(0)
    for row, (name, values) in enumerate(solved_at.items()):
        shown = np.where(np.isfinite(values), values, limit * 1.03)
        spread = row + jitter.uniform(-0.22, 0.22, len(values))
        panel.scatter(shown, spread, s=16, alpha=0.6, color=look(name).color, linewidth=0)
        mean = np.minimum(values, limit).mean()
        panel.plot([mean, mean], [row - 0.36, row + 0.36], color="black", linewidth=2)
    panel.axvline(limit, color=MARK, linewidth=1, linestyle=DASHED)
    panel.text(limit, -0.65, "unsolved", color=MARK, va="bottom", ha="center")
    panel.set_yticks(range(len(names)), names)
    panel.set_ylim(len(names) - 0.4, -0.6)
    finish(panel, x=f"{axis}\n(dot: a seed; bar: mean, an unsolved seed counted as {limit})")
    save(figure, path)
    return True


def error_scatter(
    path: Path, error: Mapping[str, np.ndarray], solved_at: Mapping[str, np.ndarray],
    lines: Mapping[str, float], x: str, y: str, hollow: Sequence[str],
) -> None:  # fmt: skip
    """A model's error (``x``) against what it takes to solve with it (``y``), both ``[seeds]``: a
    numbered dot a setting, some hollow, `shaded` both ways; lines at means of those without one.
    """
    figure, panel = subplots(figsize=(WIDTH, 5.0 + 0.11 * len(error)))
    shade = LOOKS["dyna"].color
    labels: dict[str, tuple[float, float]] = {}
    for number, (name, values) in enumerate(error.items(), start=1):
        both = values, solved_at[name]
        means = values.mean(), solved_at[name].mean()
        across, up = (abs(np.array(around(one[:, None])) - one.mean()) for one in both)
        panel.errorbar(*means, up, across, color=shade, linestyle="", elinewidth=0.8, alpha=0.35)
        said = textwrap.fill(f"{number}  {name}", 46, subsequent_indent="      ")
        panel.plot(*means, "o", color=shade, markersize=6, label=said,
                   markerfacecolor="white" if name in hollow else shade)  # fmt: skip
        labels[str(number)] = means
    for (name, level), own in zip(lines.items(), REFERENCES, strict=False):
        panel.axhline(level, label=name, linewidth=1.5, **own._asdict())
    panel.set_xscale("log")
    finish(panel, x=f"{x}; bars: {shaded(next(iter(error.values())))}", y=y)
    handles, said = panel.get_legend_handles_labels()
    figure.legend(handles, said, loc="outside lower left", ncols=2, fontsize=9, frameon=False)
    figure.draw_without_rendering()  # only now it is known where the points lie
    apart(panel, labels)
    save(figure, path)


def apart(panel: Axes, labels: Mapping[str, tuple[float, float]]) -> None:
    """Short labels near their points ``(x, y)``, each at the nearest place that covers neither a
    point nor a label before it, with a line to its point where that is not beside it.
    """
    at = panel.transData.transform(np.array([*labels.values()]))
    size = np.array([13.5, 11.0]) * panel.figure.dpi / 72  # of two digits
    taken = [*at]
    turns = np.linspace(0, 2 * np.pi, 16, endpoint=False) + np.pi / 4
    ways = [np.array([np.cos(turn), np.sin(turn)]) for turn in turns]
    for (text, point), here in zip(labels.items(), at, strict=True):
        places = [here + far * size * way for far in (1.0, 1.6, 2.4, 3.4, 4.6) for way in ways]
        free = [place for place in places
                if all((abs(place - other) > size).any() for other in taken)]  # fmt: skip
        place = (free or places)[0]
        taken.append(place)
        offset = (place - here) * 72 / panel.figure.dpi
        line = {"arrowstyle": "-", "color": FAINT, "linewidth": 0.7}
        far_off = np.linalg.norm((place - here) / size) > 1.2
        panel.annotate(text, point, offset, textcoords="offset points", ha="center", va="center",
                       arrowprops=line if far_off else None,
                       path_effects=[withStroke(linewidth=2.5, foreground="white")])  # fmt: skip


def band(
    panel: Axes, values: np.ndarray, look: Look, label: str, x: Any = None,
    interval: Callable[[np.ndarray], Any] | None = None, **line: Any,
) -> None:  # fmt: skip
    """The mean over seeds of ``[seeds, n]``, `shaded`, against 1 to n or ``x``."""
    x = np.arange(1, values.shape[1] + 1) if x is None else x[: values.shape[1]]
    low, high = (interval or around)(values)
    panel.fill_between(x, low, high, color=look.color, alpha=0.13, linewidth=0)
    panel.plot(x, values.mean(0), label=label, linewidth=1.8, **look._asdict(), **line)


def around(values: np.ndarray, positive: bool = False) -> Any:
    """The ends of what is shaded around the mean of ``[seeds, n]``, each ``[n]``."""
    few = len(values) <= FEW
    return (values.min(0), values.max(0)) if few else mean_interval(values, positive)


def shaded(values: np.ndarray) -> str:
    """What that is, in words."""
    return "95% interval" if len(values) > FEW else "lowest to highest"


def finish(panel: Axes, title: str = "", x: str = "", y: str = "") -> None:
    """Title and axes, and no box around them."""
    panel.set_title(title, loc="left", fontsize=11)
    panel.set(xlabel=x, ylabel=y)
    panel.spines[["top", "right"]].set_visible(False)


def legend_above(figure: Figure, panels: Iterable[Axes], title: str | None = None) -> None:
    """One legend for all panels."""
    named = {
        label: handle
        for panel in panels
        for handle, label in zip(*panel.get_legend_handles_labels(), strict=True)
    }
    fit = int(12 * figure.get_figwidth() / (6 + max(map(len, named), default=0)))
    figure.legend(list(named.values()), list(named), loc="outside upper center",
                  ncols=max(1, min(4, fit)), fontsize=10, frameon=False, title=title,
                  title_fontsize=10, handlelength=2.8)  # fmt: skip


def look(name: str) -> Look:
    """An arm's, wherever it appears; "arm, changed so" and "arm@setting" have the arm's."""
    return LOOKS.get(re.split("[,@]", name)[0], LOOKS["dyna"])


def looks(names: Sequence[str]) -> list[Look]:
    """Of lines in one figure: the arms' own, dashed otherwise where one of several arms comes
    again; or one after the other where some would be alike.
    """
    own, arms = [look(name) for name in names], {re.split("[,@]", name)[0] for name in names}
    told: list[Look] = []
    for one in own:
        ways = [one, *(Look(one.color, dashes) for dashes in DASHES)]
        told.append(next((way for way in ways if way not in told), one))
    known = len(arms) > 1 and arms <= LOOKS.keys()
    found = told if known else own
    return found if len(set(found)) == len(own) else list(islice(cycle(OTHERS), len(own)))


def swept_map(
    path: Path, sweep: Mapping[str, Sequence[Any]], solved: Mapping[str, Sequence[Any]], what: str
) -> None:
    """``what`` over a grid of two settings, a panel an arm, rows first; ``sweep`` has the settings'
    values by dotted path, ``solved`` summaries of runs, an unsolved one at the least it can be.
    """
    (rows, row_values), (columns, column_values) = sweep.items()
    figure, panels = laid_out(len(solved), height=1.6 + 0.4 * len(row_values))
    for panel, (name, each) in zip(panels.flat, solved.items(), strict=False):
        shape = len(row_values), len(column_values)
        grid = np.reshape([one["restricted_mean"] for one in each], shape)
        picture = panel.imshow(grid, cmap="viridis_r", aspect="auto")
        for (row, column), value in np.ndenumerate(grid):
            shade = "black" if value <= (grid.min() + grid.max()) / 2 else "white"
            panel.text(column, row, f"{value:,.0f}", ha="center", va="center", color=shade)
        panel.set_xticks(range(len(column_values)), [str(value) for value in column_values])
        panel.set_yticks(range(len(row_values)), [str(value) for value in row_values])
        finish(panel, name, columns, rows)
        figure.colorbar(picture, ax=panel, label=what)
    save(figure, path)


def subplots(
    rows: int = 1, columns: int = 1, *, figsize: tuple[float, float], **shared: Any
) -> Any:
    """A figure of its own and its panels; nothing of matplotlib's is set for the whole process."""
    figure = Figure(figsize=figsize, layout="constrained")
    return figure, figure.subplots(rows, columns, **shared)


def laid_out(count: int, height: float = 3.2, **shared: bool) -> tuple[Figure, np.ndarray]:
    """A figure of so many panels, each so many inches high, in rows of three or fewer, and the
    panels ``[rows, columns]``.
    """
    columns = {1: 1, 2: 2, 4: 2}.get(count, 3)
    rows = -(-count // columns)
    size = (WIDTH, (1.0 + (columns == 1)) + height * rows)
    figure, panels = subplots(rows, columns, figsize=size, squeeze=False, **shared)
    for spare in panels.flat[count:]:
        spare.remove()
    return figure, panels


def save(figure: Figure, path: Path) -> None:
    """Writes the PNG."""
    figure.savefig(path, dpi=150)
