"""Pictures of frames: what was seen, what came, what was predicted; films as GIF."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.font_manager import findfont
from PIL import Image, ImageDraw, ImageFont

from jaxdyna.experiments.report.plots import WIDTH, save, subplots

SCALE, WIDEST, CAPTION_WIDTH = 16, 320, 190
#: pixels across of a page, which a film is not wider than, and between two columns
PAGE, GAP = 830, 12
LETTERS = 15  #: of a caption: pixels, and as many where a page shows it
PAUSE_MS = 160
TITLES = ("input (older fainter)", "what came", "what was believed", "error")


def prediction_grid(path: Path, rows: Mapping[str, Sequence[np.ndarray]], seen: np.ndarray) -> None:
    """Fig. 7: input, truth, prediction and error of a step, a row for each model: by name ``(truth,
    belief)``, each ``[H, W, 3]`` in [0, 1], as what was ``seen`` before the step.
    """
    figure, panels = subplots(len(rows), 4, figsize=(WIDTH, 2.25 * len(rows)), squeeze=False)
    for row, (name, (truth, belief)) in zip(panels, rows.items(), strict=True):
        for panel, picture in zip(row, (seen, truth, belief, np.abs(truth - belief)), strict=True):
            panel.imshow(np.clip(picture, 0, 1), interpolation="nearest")
            panel.set(xticks=[], yticks=[])
        row[0].set_ylabel(name)
    for panel, title in zip(panels[0], TITLES, strict=True):
        panel.set_title(title, fontsize=10)
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
    """Frames side by side as a GIF that repeats, in rows no wider than a page, by title uint8 ``[T,
    H, W, 3]``; the shortest ends the film.
    """
    pictures = []
    for step, frames in enumerate(zip(*columns.values(), strict=False), start=first_step):
        parts = [
            _captioned(frame, f"{name}\nstep {step}")
            for name, frame in zip(columns, frames, strict=True)
        ]
        picture = Image.fromarray(_in_rows(parts))
        # By coverage of the colours: the median cut gives a small thing the colour of a large one.
        pictures.append(picture.quantize(64, Image.Quantize.MAXCOVERAGE))
    pictures[0].save(
        path, save_all=True, append_images=pictures[1:], duration=PAUSE_MS, loop=0, optimize=True
    )


def _in_rows(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Pictures of one size ``[H, W, 3]`` in as few rows as a page takes, equally long ones."""
    height, width, _ = parts[0].shape
    rows = -(-len(parts) // max((PAGE + GAP) // (width + GAP), 1))
    columns = -(-len(parts) // rows)
    sheet = np.full((rows * (height + GAP) - GAP, columns * (width + GAP) - GAP, 3), 255, np.uint8)
    for number, part in enumerate(parts):
        top, left = (number // columns) * (height + GAP), (number % columns) * (width + GAP)
        sheet[top : top + height, left : left + width] = part
    return sheet


def _captioned(frame: np.ndarray, caption: str) -> np.ndarray:
    width = frame.shape[1]
    scale = max(min(SCALE, WIDEST // width), CAPTION_WIDTH // width, 1)
    big = frame.repeat(scale, axis=0).repeat(scale, axis=1)
    lines = caption.count("\n") + 1
    head = Image.new("RGB", (big.shape[1], lines * (LETTERS + 4) + 4), "white")
    font = ImageFont.truetype(findfont("DejaVu Sans"), LETTERS)
    ImageDraw.Draw(head).multiline_text((2, 1), caption, fill="black", font=font)
    return np.concatenate([np.asarray(head), big])
