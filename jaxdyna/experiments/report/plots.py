"""Figures. Every one says in its axes and legend what is drawn, and how it was smoothed."""

import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxdyna.experiments.report import tables
from jaxdyna.statistics import FEW, carried, mean_interval, running_mean

COLOURS = {
    "model_free": "#4c566a", "dyna": "#0f7b6c", "placebo": "#b5651d", "oracle": "#6a4c93",
    "more_updates": "#c2185b", "mpc": "#c77700", "mcts": "#2f6db5", "mpc_init": "#a8432e",
    "mpc_init_dyna": "#5b8c2a", "mpc_clone": "#8e5a9b", "dyna_l2": "#c0392b",
    "dyna_adversarial": "#d08770", "true_ball": "#2e7dbd", "true_own": "#7f8c1f",
    "true_opponent": "#888888", "true_frames": "#d4a017", "max_updates": "#e07b9a",
}  # fmt: skip
MARK, FAINT = "#c0392b", "#888888"
MARKED = 5
"""Points of a line that are marked: of one alone nothing would be seen."""
FIG5 = {
    "truth": {"color": "#d08770", "linewidth": 3.0, "label": "real environment"},
    "one_step": {"color": "#0f7b6c", "linewidth": 1.2, "label": "model, one step ahead"},
    "open_loop": {"color": "#6a4c93", "linewidth": 1.2, "linestyle": "--",
                  "label": "model, fed with its own predictions"},
}  # fmt: skip


def learning_curves(
    path: Path, returns: Mapping[str, np.ndarray], threshold: float,
    solved_at: Mapping[str, np.ndarray], real_first: int, window: int, what: str = "return",
) -> None:  # fmt: skip
    """Figs. 6 and 8: a panel an arm, real return ``[seeds, episodes]``, NaN after a run's own end,
    against real episodes, every seed faintly behind; ``solved_at`` ``[seeds]`` is infinity where
    unsolved, ``real_first`` N, where dreaming begins, ``window`` episodes in the running mean,
    ``what`` the returns are, on the axis.
    """
    figure, panels = laid_out(len(returns), sharex=True, sharey=True)
    early = any(np.isnan(values).any() for values in returns.values())
    over = " (one that is over keeps its last value)" if early else ""
    for letter, panel, name in zip("abcdefgh", panels.flat, returns, strict=False):
        values = returns[name]
        shade, smooth = colour(name), running_mean(values, window)
        numbers = np.arange(1, values.shape[1] + 1)
        panel.plot(numbers, smooth[:50].T, color=shade, alpha=0.18, linewidth=0.7)
        said = f"mean of {len(values)} seeds{over}, {shaded(values)}"
        band(panel, carried(smooth), shade, said)
        panel.axhline(threshold, color=MARK, linewidth=1, linestyle="--",
                      label=f"solved: {threshold:g}")  # fmt: skip
        if not name.startswith(("model_free", "max_updates")):
            begins = "planner begins" if name.startswith(("mpc", "mcts")) else "dreams begin"
            panel.axvline(real_first, color=FAINT, linewidth=1, linestyle=":",
                          label=f"{begins}: {real_first}")  # fmt: skip
        solved = solved_at[name][np.isfinite(solved_at[name])]
        said = f"{len(solved)}/{len(solved_at[name])} solved"
        said += f", mean after {solved.mean():.0f}" if len(solved) == len(solved_at[name]) else ""
        finish(panel, f"({letter}) {tables.label(name)}: {said}", "real episodes", legend=False)
    for panel in panels[:, 0]:
        panel.set_ylabel(f"{what} (running mean of {window})")
    legend_above(figure, panels.flat)
    save(figure, path)


def bands(
    path: Path, panels: Mapping[str, Mapping[str, np.ndarray]], x: str, y: str = "", *,
    window: int | None = None, at: np.ndarray | None = None,
    dots: Mapping[str, Sequence[int]] | None = None, legend: str | None = None, **axes: Any,
) -> None:  # fmt: skip
    """Means over seeds, `shaded`: panels by title, in each of them lines by name.

    Args:
        path: the PNG.
        panels: by title and name ``[seeds, n]``.
        x: what the numbers 1 to n are.
        y: what all lines are, where titles do not say what each panel's are.
        window: of a running mean over episodes, in which a run that is over keeps its last value;
            None: the values as they are.
        at: other numbers than 1 to n.
        dots: by name, positions of dots on the line.
        legend: its title.
        axes: of every panel, as ``matplotlib.axes.Axes.set`` takes them.
    """
    figure, drawn = laid_out(len(panels), sharey=bool(y))
    names = list(dict.fromkeys(name for lines in panels.values() for name in lines))
    shades = dict(zip(names, colours(names), strict=True))
    for panel, (title, lines) in zip(drawn.flat, panels.items(), strict=False):
        for name, values in lines.items():
            shown = carried(running_mean(values, window)) if window else values
            marker = "o" if dots or shown.shape[1] <= MARKED else None
            band(panel, shown, shades[name], tables.label(name), at, marker=marker,
                 markersize=5, markevery=(dots or {}).get(name))  # fmt: skip
        panel.set(**axes)
        finish(panel, title, x, legend=False)
    for panel in drawn[:, 0]:
        panel.set_ylabel(y)
    legend_above(figure, drawn.flat, legend)
    save(figure, path)


def prediction_figure(
    path: Path, episodes: Mapping[str, Mapping[str, np.ndarray]], variables: Sequence[str]
) -> None:
    """Fig. 5: every output of the model beside the truth, a column an episode: by title its
    ``truth``, ``one_step`` and ``open_loop``, each ``[T, variables]``.
    """
    rows, columns = len(variables), len(episodes)
    size = (5.2 * columns, 1.55 * rows)
    figure, panels = subplots(rows, columns, figsize=size, sharex="col", squeeze=False)
    for column, (title, series) in zip(panels.T, episodes.items(), strict=True):
        for row, panel in enumerate(column):
            for kind, style in FIG5.items():
                panel.plot(np.arange(1, len(series[kind]) + 1), series[kind][:, row], **style)
            shown = np.concatenate([series[kind][:, row] for kind in ("truth", "one_step")])
            low, high = np.nanmin(shown), np.nanmax(shown)
            margin = max(0.25 * (high - low), 0.05)
            panel.set_ylim(low - margin, high + margin)
            panel.tick_params(labelsize=8)
            finish(panel, legend=False)
        column[0].set_title(title, loc="left", fontsize=10)
        column[-1].set_xlabel("step")
    for panel, name in zip(panels[:, 0], variables, strict=True):
        panel.set_ylabel(name, fontsize=9)
    legend_above(figure, panels.flat)
    save(figure, path)


def solve_bars(path: Path, solved_at: Mapping[str, np.ndarray], limit: int, axis: str) -> None:
    """When many settings solved (``[seeds]``): every seed a dot, the mean a bar; on the right the
    unsolved, infinity, each counted as ``limit``.
    """
    figure, panel = subplots(figsize=(8.5, 0.42 * len(solved_at) + 1.4))
    jitter = np.random.default_rng(0)
    for row, (name, values) in enumerate(solved_at.items()):
        shown = np.where(np.isfinite(values), values, limit * 1.03)
        spread = row + jitter.uniform(-0.22, 0.22, len(values))
        panel.scatter(shown, spread, s=14, alpha=0.6, color=colour(name), linewidth=0)
        mean = np.minimum(values, limit).mean()
        panel.plot([mean, mean], [row - 0.36, row + 0.36], color="black", linewidth=2)
    panel.axvline(limit, color=MARK, linewidth=1, linestyle="--")
    panel.text(limit * 1.012, -0.6, "unsolved", color=MARK, fontsize=8, va="bottom")
    panel.set_yticks(range(len(solved_at)), list(solved_at), fontsize=8)
    panel.set_ylim(len(solved_at) - 0.4, -0.6)
    finish(panel, x=f"{axis}\n(dot: a seed; bar: mean, an unsolved seed counted as {limit})",
           legend=False)  # fmt: skip
    save(figure, path)


def error_scatter(
    path: Path, error: Mapping[str, np.ndarray], solved_at: Mapping[str, np.ndarray],
    lines: Mapping[str, float], x: str, y: str, hollow: Sequence[str],
) -> None:  # fmt: skip
    """A model's error (``x``) against what it takes to solve with it (``y``), both ``[seeds]``: a
    numbered dot a setting, some hollow, with 95% intervals both ways; lines at the means of those
    without a model.
    """
    figure, panel = subplots(figsize=(9.5, 4.8))
    shade = COLOURS["dyna"]
    for number, (name, values) in enumerate(error.items(), start=1):
        means = [one.mean() for one in (values, solved_at[name])]
        across, up = (
            abs(mean_interval(one[:, None]) - one.mean()) for one in (values, solved_at[name])
        )
        panel.errorbar(
            *means, up, across, fmt="o", color=shade, markersize=5, elinewidth=0.6,
            markerfacecolor="white" if name in hollow else shade, label=f"{number}  {name}",
        )  # fmt: skip
        panel.annotate(str(number), means, (4, 4), textcoords="offset points", fontsize=8)
    for name, level in lines.items():
        panel.axhline(level, color=MARK, linewidth=1, linestyle="--")
        panel.text(0.995, level, name, color=MARK, fontsize=7, va="bottom", ha="right",
                   transform=panel.get_yaxis_transform())  # fmt: skip
    panel.set_xscale("log")
    finish(panel, x=x, y=y, fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    save(figure, path)


def band(panel: Axes, values: np.ndarray, shade: str, label: str, x: Any = None, **line: Any):
    """The mean over seeds of ``[seeds, n]``, `shaded`, against 1 to n or ``x``."""
    x = np.arange(1, values.shape[1] + 1) if x is None else x
    ends = mean_interval(values) if len(values) > FEW else (values.min(0), values.max(0))
    panel.fill_between(x, *ends, color=shade, alpha=0.2, linewidth=0)
    panel.plot(x, values.mean(0), color=shade, label=label, linewidth=1.6, **line)


def shaded(values: np.ndarray) -> str:
    """What is shaded around the mean of ``[seeds, n]``."""
    return "95% interval" if len(values) > FEW else "lowest to highest"


def finish(
    panel: Axes, title: str = "", x: str = "", y: str = "", *, legend: bool = True, **placed: Any
) -> None:
    """Title, axes, a legend (``placed`` so), and no box around them."""
    panel.set_title(title, loc="left", fontsize=10)
    panel.set(xlabel=x, ylabel=y)
    panel.spines[["top", "right"]].set_visible(False)
    if legend:
        panel.legend(**{"fontsize": 8, "frameon": False} | placed)


def legend_above(figure: Figure, panels: Iterable[Axes], title: str | None = None) -> None:
    """One legend for all panels."""
    named = {
        label: handle
        for panel in panels
        for handle, label in zip(*panel.get_legend_handles_labels(), strict=True)
    }
    fit = int(13 * figure.get_figwidth() / (6 + max(map(len, named), default=0)))
    figure.legend(list(named.values()), list(named), loc="outside upper center",
                  ncols=max(1, min(4, fit)), fontsize=8, frameon=False, title=title,
                  title_fontsize=8)  # fmt: skip


def colour(name: str) -> str:
    """An arm's, wherever it appears; "arm, changed so" and "arm@setting" have the arm's."""
    return COLOURS.get(re.split("[,@]", name)[0], COLOURS["dyna"])


def colours(names: Sequence[str]) -> list[str]:
    """Of lines in one figure: the arms' own, or one after the other where some would be alike."""
    own = [colour(name) for name in names]
    return own if len(set(own)) == len(own) else list(islice(cycle(COLOURS.values()), len(own)))


def swept_map(
    path: Path, sweep: Mapping[str, Sequence[Any]], solved: Mapping[str, Sequence[Any]], what: str
) -> None:
    """``what`` over a grid of two settings, a panel an arm, rows first; ``sweep`` has the settings'
    values by dotted path, ``solved`` summaries of runs, an unsolved one at the least it can be.
    """
    (rows, row_values), (columns, column_values) = sweep.items()
    size = (1.5 + (2.4 + 0.7 * len(column_values)) * len(solved), 2.2 + 0.5 * len(row_values))
    figure, panels = subplots(1, len(solved), figsize=size, squeeze=False)
    for panel, (name, each) in zip(panels.flat, solved.items(), strict=True):
        shape = len(row_values), len(column_values)
        grid = np.reshape([one["restricted_mean"] for one in each], shape)
        picture = panel.imshow(grid, cmap="viridis_r", aspect="auto")
        for (row, column), value in np.ndenumerate(grid):
            shade = "black" if value <= (grid.min() + grid.max()) / 2 else "white"
            panel.text(column, row, f"{value:,.0f}", ha="center", va="center", color=shade)
        panel.set_xticks(range(len(column_values)), [str(value) for value in column_values])
        panel.set_yticks(range(len(row_values)), [str(value) for value in row_values])
        finish(panel, name, columns, rows, legend=False)
        figure.colorbar(picture, ax=panel, label=what)
    save(figure, path)


def subplots(
    rows: int = 1, columns: int = 1, *, figsize: tuple[float, float], **shared: Any
) -> Any:
    """A figure of its own and its panels; nothing of matplotlib's is set for the whole process."""
    figure = Figure(figsize=figsize, layout="constrained")
    return figure, figure.subplots(rows, columns, **shared)


def laid_out(count: int, **shared: bool) -> tuple[Figure, np.ndarray]:
    """A figure of so many panels in rows of three or fewer, and the panels ``[rows, columns]``."""
    columns = {1: 1, 2: 2, 4: 2}.get(count, 3)
    rows = -(-count // columns)
    size = (2.2 + 3.4 * columns, 0.5 + 3.5 * rows)
    figure, panels = subplots(rows, columns, figsize=size, squeeze=False, **shared)
    for spare in panels.flat[count:]:
        spare.remove()
    return figure, panels


def save(figure: Figure, path: Path) -> None:
    """Writes the PNG."""
    figure.savefig(path, dpi=120)
