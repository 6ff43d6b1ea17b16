"""Figures. Every one says in its axes and legend what is drawn, and how it was smoothed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

COLOURS = {
    "model_free": "#4c566a",
    "dyna": "#0f7b6c",
    "placebo": "#b5651d",
    "oracle": "#6a4c93",
}
SMOOTHING = 20


def learning_curves(
    path: Path,
    returns: Mapping[str, np.ndarray],
    threshold: float,
    solved_at: Mapping[str, np.ndarray],
    real_first: int,
) -> None:
    """Fig. 6: a panel an arm, real return against real episodes.

    Args:
        path: the PNG.
        returns: by arm, ``[seeds, episodes]``.
        threshold: the return that counts as solved.
        solved_at: by arm, ``[seeds]``, infinity where unsolved.
        real_first: N, where dreaming begins.
    """
    figure, panels = plt.subplots(
        1, len(returns), figsize=(5.2 * len(returns), 4.2), sharex=True, sharey=True, squeeze=False
    )
    for letter, panel, (name, values) in zip("abcdefgh", panels[0], returns.items(), strict=False):
        draw_seeds(panel, values, colour(name))
        panel.axhline(
            threshold, color="#c0392b", linewidth=1, linestyle="--", label=f"solved: {threshold:g}"
        )
        if name != "model_free":
            panel.axvline(
                real_first,
                color="#888888",
                linewidth=1,
                linestyle=":",
                label=f"dreams begin: {real_first}",
            )
        solved = solved_at[name][np.isfinite(solved_at[name])]
        said = f"{len(solved)}/{len(solved_at[name])} solved"
        said += f", mean after {solved.mean():.0f}" if len(solved) == len(solved_at[name]) else ""
        panel.set_title(f"({letter}) {name}: {said}", loc="left", fontsize=10)
        panel.set_xlabel("real episodes")
        panel.legend(loc="lower right", fontsize=8, frameon=False)
    panels[0, 0].set_ylabel(f"return (running mean of {SMOOTHING} episodes)")
    _save(figure, path)


def draw_seeds(panel: Axes, values: np.ndarray, colour: str) -> None:
    """The mean over seeds with its 95% interval, every seed faintly behind.

    Args:
        panel: where to draw.
        values: ``[seeds, episodes]``.
        colour: of the arm.
    """
    smooth = running_mean(values, SMOOTHING)
    numbers = np.arange(1, values.shape[1] + 1)
    panel.plot(numbers, smooth[:50].T, color=colour, alpha=0.18, linewidth=0.7)
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
    figure, panels = plt.subplots(
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
    _save(figure, path, top=0.96)


def solve_bars(
    path: Path, solved_at: Mapping[str, np.ndarray], limit: int, title: str, axis: str
) -> None:
    """When many settings solved: every seed a dot, the mean a bar; unsolved on the right.

    Args:
        path: the PNG.
        solved_at: by setting, ``[seeds]``, infinity where unsolved.
        limit: the number of episodes played at the most.
        title: above the figure.
        axis: what ``solved_at`` is.
    """
    figure, panel = plt.subplots(figsize=(8.5, 0.42 * len(solved_at) + 1.4))
    jitter = np.random.default_rng(0)
    for row, (name, values) in enumerate(solved_at.items()):
        shown = np.where(np.isfinite(values), values, limit * 1.03)
        spread = row + jitter.uniform(-0.22, 0.22, len(values))
        panel.scatter(shown, spread, s=14, alpha=0.6, color=colour(name), linewidth=0)
        mean = np.minimum(values, limit).mean()
        panel.plot([mean, mean], [row - 0.36, row + 0.36], color="black", linewidth=2)
    panel.axvline(limit, color="#c0392b", linewidth=1, linestyle="--")
    panel.text(limit * 1.012, -0.6, "unsolved", color="#c0392b", fontsize=8, va="bottom")
    panel.set_yticks(range(len(solved_at)), list(solved_at), fontsize=8)
    panel.set_ylim(len(solved_at) - 0.4, -0.6)
    panel.set_xlabel(f"{axis} (dot: a seed; bar: mean, an unsolved seed counted as {limit})")
    panel.set_title(title, loc="left", fontsize=10, pad=14)
    panel.spines[["top", "right"]].set_visible(False)
    _save(figure, path)


def solved_share(path: Path, first_solved: Mapping[str, np.ndarray]) -> None:
    """The share of the runs whose solving window has begun, against real episodes.

    Args:
        path: the PNG.
        first_solved: by arm, number of the window's first episode ``[seeds]``, infinity where
            unsolved.
    """
    figure, panel = plt.subplots(figsize=(6.4, 3.6))
    latest = max([values[np.isfinite(values)].max(initial=2) for values in first_solved.values()])
    for name, values in first_solved.items():
        numbers = np.sort(values)
        share = np.arange(1, len(numbers) + 1) / len(numbers)
        known = np.isfinite(numbers)
        panel.step(
            np.concatenate([[1], numbers[known], [latest * 1.05]]),
            np.concatenate([[0], share[known], [known.mean()]]),
            where="post",
            color=colour(name),
            label=f"{name} ({len(numbers)} runs)",
        )
    panel.set_xscale("log")
    panel.set_xlabel("real episodes before the solving window (logarithmic)")
    panel.set_ylabel("share of the runs")
    panel.set_ylim(-0.02, 1.02)
    panel.legend(fontsize=8, frameon=False)
    panel.spines[["top", "right"]].set_visible(False)
    _save(figure, path)


def error_scatter(
    path: Path,
    error: Mapping[str, np.ndarray],
    solved_at: Mapping[str, np.ndarray],
    lines: Mapping[str, float],
    limit: int,
) -> None:
    """Episodes to solve against a model's error: a number a setting, with bootstrap intervals.

    Args:
        path: the PNG.
        error: by setting, ``[seeds]``.
        solved_at: by setting, ``[seeds]``, unsolved at ``limit``.
        lines: levels to draw across, by name.
        limit: what an unsolved run counts as.
    """
    figure, panel = plt.subplots(figsize=(9.5, 4.8))
    for number, (name, values) in enumerate(error.items(), start=1):
        x, y = values.mean(), solved_at[name].mean()
        ends = [mean_interval(part[:, None])[:, 0] for part in (values, solved_at[name])]
        panel.plot(ends[0], [y, y], color="#0f7b6c", alpha=0.5, linewidth=1)
        panel.plot([x, x], ends[1], color="#0f7b6c", alpha=0.5, linewidth=1)
        panel.plot(x, y, "o", color="#0f7b6c", markersize=5, label=f"{number}  {name}")
        panel.annotate(str(number), (x, y), (4, 4), textcoords="offset points", fontsize=8)
    for name, level in lines.items():
        panel.axhline(level, color="#c0392b", linewidth=1, linestyle="--")
        panel.text(0.005, level, name, color="#c0392b", fontsize=7, va="bottom",
                   transform=panel.get_yaxis_transform())  # fmt: skip
    panel.set_xscale("log")
    panel.set_xlabel("unexplained share of a step's change (logarithmic)")
    panel.set_ylabel(f"episodes to solve (unsolved counted as {limit})")
    handles, labels = panel.get_legend_handles_labels()
    panel.legend(handles, labels, fontsize=7, frameon=False, handlelength=0, markerscale=0,
                 loc="center left", bbox_to_anchor=(1.0, 0.5))  # fmt: skip
    panel.spines[["top", "right"]].set_visible(False)
    _save(figure, path)


def error_growth(path: Path, errors: Mapping[str, np.ndarray]) -> None:
    """Open-loop error by step, with its 95% interval over seeds.

    Args:
        path: the PNG.
        errors: by what the model was trained on, ``[seeds, steps]``.
    """
    figure, panel = plt.subplots(figsize=(6.4, 3.8))
    for (name, values), shade in zip(errors.items(), COLOURS.values(), strict=False):
        steps = np.arange(1, values.shape[1] + 1)
        low, high = mean_interval(values)
        panel.fill_between(steps, low, high, color=shade, alpha=0.2, linewidth=0)
        panel.plot(steps, values.mean(0), color=shade, label=name)
    panel.set_yscale("log")
    panel.set_xlabel("dreamed steps")
    panel.set_ylabel("error (standard deviations)")
    panel.legend(title="trained on", fontsize=8, title_fontsize=8, frameon=False)
    panel.spines[["top", "right"]].set_visible(False)
    _save(figure, path)


def colour(name: str) -> str:
    """The colour of an arm, wherever it appears."""
    return COLOURS.get(name, COLOURS["dyna"])


def running_mean(values: np.ndarray, window: int) -> np.ndarray:
    """Mean of the last ``window`` entries along the last axis, of fewer at the start."""
    padded = np.concatenate([np.zeros((*values.shape[:-1], 1)), values.cumsum(-1, np.float64)], -1)
    ends = np.arange(1, values.shape[-1] + 1)
    starts = np.maximum(ends - window, 0)
    return (padded[..., ends] - padded[..., starts]) / (ends - starts)


def mean_interval(values: np.ndarray, resamples: int = 400) -> np.ndarray:
    """Bootstrap 95% interval of the mean over seeds: ``[2, episodes]``."""
    generator = np.random.default_rng(0)
    weights = generator.multinomial(len(values), np.full(len(values), 1 / len(values)), resamples)
    return np.percentile(weights @ values / len(values), [2.5, 97.5], axis=0)


def _save(figure, path: Path, top: float = 1.0) -> None:
    figure.tight_layout(rect=(0, 0, 1, top))
    figure.savefig(path, dpi=120)
    plt.close(figure)
