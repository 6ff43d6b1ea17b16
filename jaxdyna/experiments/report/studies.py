"""Figures of studies: many settings beside each other, a model's error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from jaxdyna.experiments.report.plots import COLOURS, colour, mean_interval, save, subplots


def solve_bars(path: Path, solved_at: Mapping[str, np.ndarray], limit: int, axis: str) -> None:
    """When many settings solved: every seed a dot, the mean a bar; unsolved on the right.

    Args:
        path: the PNG.
        solved_at: by setting, ``[seeds]``, infinity where unsolved.
        limit: what an unsolved run counts as.
        axis: what ``solved_at`` is.
    """
    figure, panel = subplots(figsize=(8.5, 0.42 * len(solved_at) + 1.4))
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
    panel.set_xlabel(f"{axis}\n(dot: a seed; bar: mean, an unsolved seed counted as {limit})")
    panel.spines[["top", "right"]].set_visible(False)
    save(figure, path)


def error_scatter(
    path: Path,
    error: Mapping[str, np.ndarray],
    solved_at: Mapping[str, np.ndarray],
    lines: Mapping[str, float],
    limit: int,
    axis: str,
    solved: str,
    hollow: Sequence[str] = (),
) -> None:
    """Episodes to solve against a model's error: a number a setting, with bootstrap intervals.

    Args:
        path: the PNG.
        error: by setting, ``[seeds]``.
        solved_at: by setting, ``[seeds]``, unsolved at ``limit``.
        lines: levels to draw across, by name.
        limit: what an unsolved run counts as.
        axis: what ``error`` is.
        solved: what ``solved_at`` is.
        hollow: settings that are drawn hollow.
    """
    figure, panel = subplots(figsize=(9.5, 4.8))
    for number, (name, values) in enumerate(error.items(), start=1):
        x, y = values.mean(), solved_at[name].mean()
        ends = [mean_interval(part[:, None])[:, 0] for part in (values, solved_at[name])]
        panel.plot(ends[0], [y, y], color="#0f7b6c", alpha=0.5, linewidth=1)
        panel.plot([x, x], ends[1], color="#0f7b6c", alpha=0.5, linewidth=1)
        fill = "white" if name in hollow else "#0f7b6c"
        panel.plot(x, y, "o", color="#0f7b6c", markerfacecolor=fill, markersize=5, zorder=3,
                   label=f"{number}  {name}")  # fmt: skip
        panel.annotate(str(number), (x, y), (4, 4), textcoords="offset points", fontsize=8)
    for name, level in lines.items():
        panel.axhline(level, color="#c0392b", linewidth=1, linestyle="--")
        panel.text(0.995, level, name, color="#c0392b", fontsize=7, va="bottom", ha="right",
                   transform=panel.get_yaxis_transform())  # fmt: skip
    panel.set_xscale("log")
    panel.set_xlabel(axis)
    panel.set_ylabel(f"{solved} (unsolved counted as {limit})")
    handles, labels = panel.get_legend_handles_labels()
    panel.legend(handles, labels, fontsize=7, frameon=False, handlelength=0, markerscale=0,
                 loc="center left", bbox_to_anchor=(1.0, 0.5))  # fmt: skip
    panel.spines[["top", "right"]].set_visible(False)
    save(figure, path)


def error_growth(path: Path, errors: Mapping[str, np.ndarray]) -> None:
    """Open-loop error by step, with its 95% interval over seeds.

    Args:
        path: the PNG.
        errors: by what the model was trained on, ``[seeds, steps]``.
    """
    figure, panel = subplots(figsize=(6.4, 3.8))
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
    save(figure, path)


def sweep_cost(path: Path, rows: Sequence[Mapping[str, float]]) -> None:
    """Seconds of a whole sweep, and seconds a run, against the number of runs.

    Args:
        path: the PNG.
        rows: of each sweep its ``runs``, ``compile_s`` and ``run_s``.
    """
    runs, compiling, running = (
        np.array([row[name] for row in rows]) for name in ("runs", "compile_s", "run_s")
    )
    figure, (whole, each) = subplots(1, 2, figsize=(8.5, 3.6), sharex=True)
    whole.plot(runs, compiling + running, "o-", color="#0f7b6c", label="in all")
    whole.plot(runs, compiling, "o:", color="#888888", label="compiling")
    whole.set_ylabel("seconds a sweep")
    whole.legend(fontsize=8, frameon=False)
    each.plot(runs, (compiling + running) / runs, "o-", color="#0f7b6c", label="in all")
    each.plot(runs, running / runs, "o:", color="#4c566a", label="without compiling")
    each.set_ylabel("seconds a run")
    each.legend(fontsize=8, frameon=False)
    for panel in (whole, each):
        panel.set_xscale("log")
        panel.set_yscale("log")
        panel.set_xlabel("runs in one jitted call")
        panel.grid(alpha=0.3, which="major")
        panel.spines[["top", "right"]].set_visible(False)
    save(figure, path)
