"""Figures. Every one says in its axes and legend what is drawn, and how it was smoothed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

COLOURS = {
    "model_free": "#4c566a",
    "dyna": "#0f7b6c",
    "placebo": "#b5651d",
    "oracle": "#6a4c93",
    "more_updates": "#c2185b",
    "mpc": "#c77700",
    "mcts": "#2f6db5",
    "mpc_init": "#a8432e",
    "mpc_init_dyna": "#5b8c2a",
    "mpc_clone": "#8e5a9b",
    "dyna_l2": "#c0392b",
    "dyna_adversarial": "#d08770",
    "true_ball": "#2e7dbd",
    "true_own": "#7f8c1f",
    "true_opponent": "#888888",
    "true_frames": "#d4a017",
}
PLANNERS = ("mpc", "mcts", "mpc_init", "mpc_init_dyna", "mpc_clone")
BEGINS = dict.fromkeys(PLANNERS, "planner begins")


def learning_curves(
    path: Path,
    returns: Mapping[str, np.ndarray],
    threshold: float,
    solved_at: Mapping[str, np.ndarray],
    real_first: int,
    what: str = "return",
    window: int | None = None,
) -> None:
    """Figs. 6 and 8: a panel an arm, real return against real episodes.

    Args:
        path: the PNG.
        returns: by arm, ``[seeds, episodes]``.
        threshold: the return that counts as solved.
        solved_at: by arm, ``[seeds]``, infinity where unsolved.
        real_first: N, where dreaming begins.
        what: the returns are, on the axis.
        window: episodes in the running mean; None: `smoothing_window`.
    """
    window = window or smoothing_window(max(values.shape[1] for values in returns.values()))
    figure, panels = subplots(
        1, len(returns), figsize=(5.2 * len(returns), 4.2), sharex=True, sharey=True, squeeze=False
    )
    for letter, panel, (name, values) in zip("abcdefgh", panels[0], returns.items(), strict=False):
        draw_seeds(panel, values, colour(name), window)
        panel.axhline(
            threshold, color="#c0392b", linewidth=1, linestyle="--", label=f"solved: {threshold:g}"
        )
        if name != "model_free":
            panel.axvline(
                real_first,
                color="#888888",
                linewidth=1,
                linestyle=":",
                label=f"{BEGINS.get(name, 'dreams begin')}: {real_first}",
            )
        solved = solved_at[name][np.isfinite(solved_at[name])]
        said = f"{len(solved)}/{len(solved_at[name])} solved"
        said += f", mean after {solved.mean():.0f}" if len(solved) == len(solved_at[name]) else ""
        panel.set_title(f"({letter}) {name}: {said}", loc="left", fontsize=10)
        panel.set_xlabel("real episodes")
        low = carried(values)[:, -1].mean() < threshold / 2
        panel.legend(
            loc="upper left" if low else "lower right",
            bbox_to_anchor=(0, 0.9) if low else None,
            fontsize=8,
            framealpha=0.85,
            edgecolor="none",
        )
    panels[0, 0].set_ylabel(f"{what} (running mean of {window} episodes)")
    save(figure, path)


def behaviour(path: Path, panels: Mapping[str, Mapping[str, np.ndarray]], window: int) -> None:
    """What episodes are like against their number, a panel a measure, all arms in it.

    Args:
        path: the PNG.
        panels: by the measure's name and arm, ``[seeds, episodes]``.
        window: episodes in the running mean.
    """
    columns = min(len(panels), 2)
    rows = -(-len(panels) // columns)
    shape = (5.6 * columns, 4.2 * rows)
    figure, axes = subplots(rows, columns, figsize=shape, squeeze=False)
    for spare in axes.flat[len(panels) :]:
        spare.remove()
    for panel, (title, arms) in zip(axes.flat, panels.items(), strict=False):
        for name, values in arms.items():
            smooth = carried(running_mean(values, window))
            low, high = mean_interval(smooth)
            episodes = np.arange(1, smooth.shape[1] + 1)
            panel.fill_between(episodes, low, high, color=colour(name), alpha=0.2, linewidth=0)
            panel.plot(episodes, smooth.mean(0), color=colour(name), label=name, linewidth=1.5)
        panel.set_title(title, loc="left", fontsize=10)
        panel.set_xlabel(f"real episodes (running mean of {window})")
        panel.set_ylim(bottom=0)
        panel.spines[["top", "right"]].set_visible(False)
        panel.legend(fontsize=8, frameon=False)
    save(figure, path)


def draw_seeds(panel: Axes, values: np.ndarray, colour: str, window: int) -> None:
    """The mean over seeds with its 95% interval, every seed faintly behind.

    Args:
        panel: where to draw.
        values: ``[seeds, episodes]``, NaN after a run's own end; the mean keeps its last value.
        colour: of the arm.
        window: of the running mean, in episodes.
    """
    smooth = running_mean(values, window)
    numbers = np.arange(1, values.shape[1] + 1)
    panel.plot(numbers, smooth[:50].T, color=colour, alpha=0.18, linewidth=0.7)
    smooth = carried(smooth)
    low, high = mean_interval(smooth)
    panel.fill_between(numbers, low, high, color=colour, alpha=0.25, linewidth=0)
    label = f"mean of {len(values)} seeds, 95% interval"
    panel.plot(numbers, smooth.mean(0), color=colour, linewidth=1.8, label=label)
    panel.spines[["top", "right"]].set_visible(False)


def prediction_figure(
    path: Path, episodes: Mapping[str, Mapping[str, np.ndarray]], variables: Sequence[str]
) -> None:
    """Fig. 5: every output of the model beside the truth, a column an episode.

    Args:
        path: the PNG.
        episodes: by title: ``truth``, ``one_step`` and ``open_loop``, each ``[T, outputs]``.
        variables: names of the outputs.
    """
    figure, panels = subplots(
        len(variables), len(episodes), figsize=(5.2 * len(episodes), 1.55 * len(variables)),
        sharex="col", squeeze=False,
    )  # fmt: skip
    styles = {
        "truth": {"color": "#d08770", "linewidth": 3.0, "label": "real environment"},
        "one_step": {"color": "#0f7b6c", "linewidth": 1.2, "label": "model, one step ahead"},
        "open_loop": {
            "color": "#6a4c93", "linewidth": 1.2, "linestyle": "--",
            "label": "model, fed with its own predictions",
        },
    }  # fmt: skip
    for column, (title, series) in enumerate(episodes.items()):
        panels[0, column].set_title(title, loc="left", fontsize=10)
        for row, name in enumerate(variables):
            panel = panels[row, column]
            for kind, style in styles.items():
                panel.plot(np.arange(1, len(series[kind]) + 1), series[kind][:, row], **style)
            truth = np.concatenate([series["truth"][:, row], series["one_step"][:, row]])
            truth = truth[np.isfinite(truth)]
            margin = max(0.25 * np.ptp(truth), 0.05)
            panel.set_ylim(truth.min() - margin, truth.max() + margin)
            panel.spines[["top", "right"]].set_visible(False)
            panel.tick_params(labelsize=8)
            if column == 0:
                panel.set_ylabel(name, fontsize=9)
        panels[-1, column].set_xlabel("step")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="upper center", ncols=3, fontsize=9, frameon=False)
    save(figure, path, top=0.96)


def solved_share(
    path: Path, first_solved: Mapping[str, np.ndarray], known: Mapping[str, int] | None = None
) -> None:
    """The share of the runs whose solving window has begun, against real episodes. What is called
    "arm, changed so" has the arm's colour and a broken line.

    Args:
        path: the PNG.
        first_solved: by arm, number of the window's first episode ``[seeds]``, infinity where
            unsolved.
        known: by arm the last episode at which it is known, where its line ends; None draws all to
            the latest one, on a logarithmic axis.
    """
    figure, panel = subplots(figsize=(6.4, 3.6))
    latest = max([values[np.isfinite(values)].max(initial=2) for values in first_solved.values()])
    alike: Counter[str] = Counter()
    for name, values in first_solved.items():
        numbers = np.sort(values)
        share = np.arange(1, len(numbers) + 1) / len(numbers)
        solved = np.isfinite(numbers)
        end = known[name] if known else latest * 1.05
        kind = name.partition(",")[0]
        alike[kind] += 1
        panel.step(
            np.concatenate([[1], numbers[solved], [end]]),
            np.concatenate([[0], share[solved], [solved.mean()]]),
            where="post",
            color=colour(name),
            linestyle=("-", "--", ":", "-.")[alike[kind] % 4 - 1],
            label=f"{name} ({len(numbers)} runs)",
        )
    if known is None:
        panel.set_xscale("log")
    axis = "first real episode of the solving window"
    panel.set_xlabel(axis if known else f"{axis} (logarithmic)")
    panel.set_ylabel("share of the runs")
    panel.set_ylim(-0.02, 1.02)
    panel.legend(fontsize=8, frameon=False)
    if len(first_solved) > 6:  # no room inside
        panel.legend(fontsize=8, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    panel.spines[["top", "right"]].set_visible(False)
    save(figure, path)


def smoothing_window(episodes: int) -> int:
    """Episodes in the running mean of a curve: 20 of 1,000, fewer of fewer."""
    return max(1, min(20, episodes // 50))


def colour(name: str) -> str:
    """The colour of an arm, wherever it appears; "arm, changed so" has the arm's."""
    return COLOURS.get(name.split(",", maxsplit=1)[0], COLOURS["dyna"])


def running_mean(values: np.ndarray, window: int) -> np.ndarray:
    """Mean of the last ``window`` entries along the last axis, of fewer at the start."""
    padded = np.concatenate([np.zeros((*values.shape[:-1], 1)), values.cumsum(-1, np.float64)], -1)
    ends = np.arange(1, values.shape[-1] + 1)
    starts = np.maximum(ends - window, 0)
    return (padded[..., ends] - padded[..., starts]) / (ends - starts)


def carried(values: np.ndarray) -> np.ndarray:
    """``[seeds, episodes]`` in which a run that is over keeps its last value."""
    last = np.maximum(np.isfinite(values).sum(-1) - 1, 0)
    numbers = np.minimum(np.arange(values.shape[-1]), last[:, None])
    return np.take_along_axis(values, numbers, axis=-1)


def swept_curves(
    path: Path, setting: str, values: Sequence[Any], returns: Mapping[str, Sequence[np.ndarray]]
) -> None:
    """Real return against real episodes, a panel an arm, a line a value of one setting.

    Args:
        path: the PNG.
        setting: its dotted path.
        values: that were swept.
        returns: by arm, of each value ``[seeds, episodes]``.
    """
    figure, panels = subplots(1, len(returns), figsize=(5.6 * len(returns), 4.2), squeeze=False,
                              sharey=True)  # fmt: skip
    for panel, (name, curves) in zip(panels[0], returns.items(), strict=True):
        window = smoothing_window(max(one.shape[1] for one in curves))
        for number, (value, one) in enumerate(zip(values, curves, strict=True)):
            shade = f"C{number}"
            smooth = carried(running_mean(one, window))
            low, high = mean_interval(smooth)
            episodes = np.arange(1, smooth.shape[1] + 1)
            panel.fill_between(episodes, low, high, color=shade, alpha=0.15, linewidth=0)
            panel.plot(episodes, smooth.mean(0), color=shade, label=f"{value}", linewidth=1.5)
        panel.set_title(f"{name}: mean of {len(curves[0])} runs, 95% interval", loc="left",
                        fontsize=10)  # fmt: skip
        panel.set_xlabel(f"real episodes (running mean of {window})")
        panel.legend(title=setting, fontsize=8, title_fontsize=8, frameon=False)
        panel.spines[["top", "right"]].set_visible(False)
    panels[0, 0].set_ylabel("return")
    save(figure, path)


def swept_map(
    path: Path, sweep: Mapping[str, Sequence[Any]], solved: Mapping[str, np.ndarray]
) -> None:
    """Mean episodes to solve over a grid of two settings, a panel an arm.

    Args:
        path: the PNG.
        sweep: values by dotted path, rows first.
        solved: by arm ``[rows, columns]``, an unsolved run counted with all its episodes.
    """
    (rows, row_values), (columns, column_values) = sweep.items()
    figure, panels = subplots(1, len(solved), figsize=(4.8 * len(solved), 4.0), squeeze=False)
    for panel, (name, values) in zip(panels[0], solved.items(), strict=True):
        picture = panel.imshow(values, cmap="viridis_r", aspect="auto")
        middle = (values.min() + values.max()) / 2
        for (row, column), value in np.ndenumerate(values):
            shade = "black" if value < middle else "white"
            panel.text(column, row, f"{value:.0f}", ha="center", va="center", color=shade)
        panel.set_xticks(range(len(column_values)), [str(value) for value in column_values])
        panel.set_yticks(range(len(row_values)), [str(value) for value in row_values])
        panel.set_xlabel(columns)
        panel.set_ylabel(rows)
        panel.set_title(f"{name}: episodes to solve, mean", loc="left", fontsize=10)
        figure.colorbar(picture, ax=panel)
    save(figure, path)


def mean_interval(values: np.ndarray, resamples: int = 400) -> np.ndarray:
    """Bootstrap 95% interval of the mean over seeds: ``[2, episodes]``."""
    generator = np.random.default_rng(0)
    weights = generator.multinomial(len(values), np.full(len(values), 1 / len(values)), resamples)
    return np.percentile(weights @ values / len(values), [2.5, 97.5], axis=0)


def subplots(
    rows: int = 1, columns: int = 1, *, figsize: tuple[float, float], **shared: Any
) -> Any:
    """A figure of its own and its panels; nothing of matplotlib's is set for the whole process."""
    figure = Figure(figsize=figsize)
    return figure, figure.subplots(rows, columns, **shared)


def save(figure: Figure, path: Path, top: float = 1.0) -> None:
    """Writes the PNG."""
    figure.tight_layout(rect=(0, 0, 1, top))
    figure.savefig(path, dpi=120)
