"""Pictures of frames: what was seen, what came, what was predicted; films as GIF."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from jaxdyna.experiments.report.plots import save, subplots

SCALE, WIDEST, CAPTION_WIDTH = 16, 320, 220
PAUSE_MS = 160
TITLES = ("input (older frames fainter)", "what came", "what was believed", "error")


def prediction_grid(path: Path, rows: Mapping[str, Sequence[np.ndarray]], seen: np.ndarray) -> None:
    """Fig. 7: input, truth, prediction and error of a step, a row for each model: by name ``(truth,
    belief)``, each ``[H, W, 3]`` in [0, 1], as what was ``seen`` before the step.
    """
    figure, panels = subplots(len(rows), 4, figsize=(9.2, 2.45 * len(rows)), squeeze=False)
    for row, (name, (truth, belief)) in zip(panels, rows.items(), strict=True):
        for panel, picture in zip(row, (seen, truth, belief, np.abs(truth - belief)), strict=True):
            panel.imshow(np.clip(picture, 0, 1), interpolation="nearest")
            panel.set(xticks=[], yticks=[])
        row[0].set_ylabel(name, fontsize=9)
    for panel, title in zip(panels[0], TITLES, strict=True):
        panel.set_title(title, fontsize=9)
    save(figure, path)


def trail(stack: np.ndarray) -> np.ndarray:
    """The newest frame of a stack with the older ones fading behind it, ``[H, W, 3]``."""
    frames = np.split(stack, stack.shape[-1] // 3, axis=-1)
    strength = np.linspace(0.15, 1, len(frames))
    return np.max([frame * part for frame, part in zip(frames, strength, strict=True)], axis=0)


def trails(frames: np.ndarray) -> np.ndarray:
    """A film, uint8 ``[T, H, W, 3]``, in which each frame shows the last four: `trail` of each."""
    padded = np.concatenate([np.repeat(frames[:1], 3, axis=0), frames])
    stacks = [padded[number : number + len(frames)] for number in range(4)]
    return trail(np.concatenate(stacks, axis=-1)).astype(np.uint8)


def film(path: Path, columns: Mapping[str, np.ndarray], first_step: int = 1) -> None:
    """Frames side by side as a GIF that repeats, by title uint8 ``[T, H, W, 3]``; the shortest ends
    the film.
    """
    pictures = []
    for step, frames in enumerate(zip(*columns.values(), strict=False), start=first_step):
        parts = [
            _captioned(frame, f"{name}, step {step}")
            for name, frame in zip(columns, frames, strict=True)
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
