"""Pictures of frames: what was seen, what came, what was predicted; films as GIF."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image, ImageDraw

from jaxdyna.experiments.report.plots import COLOURS, mean_interval, save, subplots

SCALE, WIDEST = 16, 320
CAPTION_WIDTH = 220
PAUSE_MS = 160


def prediction_grid(path: Path, rows: Mapping[str, Sequence[np.ndarray]], seen: np.ndarray) -> None:
    """Fig. 7: input, truth, prediction and error of a step, a row for each model.

    Args:
        path: the PNG.
        rows: by name ``(truth, belief)``, each ``[H, W, 3]`` in [0, 1].
        seen: what was seen before the step, likewise.
    """
    titles = ("input (older frames fainter)", "what came", "what was believed", "error")
    figure, panels = subplots(len(rows), 4, figsize=(9.2, 2.45 * len(rows)), squeeze=False)
    for row, (name, (truth, belief)) in zip(panels, rows.items(), strict=True):
        for panel, picture in zip(row, (seen, truth, belief, np.abs(truth - belief)), strict=True):
            _show(panel, picture)
        row[0].set_ylabel(name, fontsize=9)
    for panel, title in zip(panels[0], titles, strict=True):
        panel.set_title(title, fontsize=9)
    save(figure, path)


def trail(stack: np.ndarray) -> np.ndarray:
    """The newest frame of a stack with the older ones fading behind it, ``[H, W, 3]``."""
    frames = np.split(stack, stack.shape[-1] // 3, axis=-1)
    strength = np.linspace(0.15, 1, len(frames))
    return np.max([frame * part for frame, part in zip(frames, strength, strict=True)], axis=0)


def score_by_threshold(
    path: Path,
    thresholds: np.ndarray,
    scores: Mapping[str, np.ndarray],
    classes: Sequence[str],
    marks: Mapping[str, float],
) -> None:
    """F1 against the threshold above which a pixel counts as lit, a panel a class.

    Args:
        path: the PNG.
        thresholds: ``[n]``.
        scores: by model ``[seeds, n, classes]``.
        classes: their names.
        marks: by model the threshold that it uses.
    """
    figure, panels = subplots(1, len(classes), figsize=(10.5, 3.4), sharey=True)
    for number, (panel, title) in enumerate(zip(panels, classes, strict=True)):
        for (name, values), colour in zip(scores.items(), _colours(scores), strict=True):
            _band(panel, thresholds, values[..., number], colour, name)
            mark = np.argmin(np.abs(thresholds - marks[name]))
            panel.plot(thresholds[mark], values[:, mark, number].mean(), "o", color=colour)
        panel.set_title(title, loc="left", fontsize=10)
        panel.set_xlabel("threshold (dot: the one used)")
        panel.set_ylim(-0.02, 1.02)
    panels[0].set_ylabel("F1 on held-out episodes")
    _legend_above(figure, panels[0])
    save(figure, path, top=0.9)


def score_by_horizon(
    path: Path,
    scores: Mapping[str, np.ndarray],
    classes: Sequence[str],
    what: str = "F1 on held-out episodes",
) -> None:
    """A score of dreamed frames against the number of dreamed steps, a panel a class.

    Args:
        path: the PNG.
        scores: by name ``[seeds, horizon, classes]``.
        classes: their names.
        what: the score is.
    """
    figure, panels = subplots(1, len(classes), figsize=(10.5, 3.4), sharey=True)
    for number, (panel, title) in enumerate(zip(panels, classes, strict=True)):
        for (name, values), colour in zip(scores.items(), _colours(scores), strict=True):
            steps = np.arange(1, values.shape[1] + 1)
            _band(panel, steps, values[..., number], colour, name)
        panel.set_title(title, loc="left", fontsize=10)
        panel.set_xlabel("dreamed steps")
        panel.set_ylim(-0.02, 1.02)
    panels[0].set_ylabel(what)
    _legend_above(figure, panels[0])
    save(figure, path, top=0.9)


def trails(frames: np.ndarray, length: int = 4) -> np.ndarray:
    """A film in which each frame shows the last few, older ones fainter: `trail` of each.

    Args:
        frames: uint8 ``[T, H, W, 3]``.
        length: frames that are seen at a time.
    """
    padded = np.concatenate([np.repeat(frames[:1], length - 1, axis=0), frames])
    stacks = [padded[number : number + len(frames)] for number in range(length)]
    return trail(np.concatenate(stacks, axis=-1)).astype(np.uint8)


def film(path: Path, columns: Mapping[str, np.ndarray], first_step: int = 1) -> None:
    """Frames side by side as a GIF that repeats.

    Args:
        path: the GIF.
        columns: by title uint8 ``[T, H, W, 3]``, all of one length.
        first_step: the number of the first frame.
    """
    pictures = []
    for time in range(len(next(iter(columns.values())))):
        parts = [
            _captioned(frames[time], f"{name}, step {time + first_step}")
            for name, frames in columns.items()
        ]
        gap = np.full((parts[0].shape[0], 12, 3), 255, np.uint8)
        joined = [piece for part in parts for piece in (part, gap)][:-1]
        picture = Image.fromarray(np.concatenate(joined, axis=1))
        # By coverage of the colours: the median cut gives a small thing the colour of a large one.
        pictures.append(picture.quantize(64, Image.Quantize.MAXCOVERAGE))
    pictures[0].save(
        path, save_all=True, append_images=pictures[1:], duration=PAUSE_MS, loop=0, optimize=True
    )


def _captioned(frame: np.ndarray, caption: str) -> np.ndarray:
    width = frame.shape[1]
    scale = max(min(SCALE, WIDEST // width), CAPTION_WIDTH // width, 1)
    big = frame.repeat(scale, axis=0).repeat(scale, axis=1)
    head = Image.new("RGB", (big.shape[1], 18), "white")
    ImageDraw.Draw(head).text((2, 3), caption, fill="black")
    return np.concatenate([np.asarray(head), big])


def _legend_above(figure: Figure, panel: Axes) -> None:
    handles, labels = panel.get_legend_handles_labels()
    figure.legend(handles, labels, loc="upper center", ncols=4, fontsize=8, frameon=False)


def _show(panel: Axes, picture: np.ndarray) -> None:
    panel.imshow(np.clip(picture, 0, 1), interpolation="nearest")
    panel.set_xticks([])
    panel.set_yticks([])


def _band(panel: Axes, x: np.ndarray, values: np.ndarray, colour: str, label: str) -> None:
    """Mean over seeds ``[seeds, n]`` with its 95% interval."""
    low, high = mean_interval(values)
    panel.fill_between(x, low, high, color=colour, alpha=0.2, linewidth=0)
    panel.plot(x, values.mean(0), color=colour, label=label, linewidth=1.5)
    panel.spines[["top", "right"]].set_visible(False)


def _colours(names: Mapping[str, object]) -> list[str]:
    palette = [*COLOURS.values(), "#c0392b", "#2e7dbd", "#7f8c1f", "#888888"]
    return [palette[number % len(palette)] for number in range(len(names))]
