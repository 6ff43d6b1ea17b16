"""Pictures of frames: what was seen, what came, what was predicted; films as GIF or MP4."""

import os
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from importlib.util import find_spec
from itertools import chain
from pathlib import Path

import numpy as np
from matplotlib.font_manager import findfont
from PIL import Image, ImageDraw, ImageFont

from jaxdyna.experiments.report.plots import WIDTH, save, subplots

SCALE, WIDEST, CAPTION_WIDTH = 16, 320, 240
#: pixels across of a page, which a film is not wider than, and between two columns
PAGE, GAP = 830, 12
FILM = "film.gif"  #: in a report, of what its runs have learned
LETTERS = 15  #: of a caption: pixels, and as many where a page shows it
#: between two frames, at the most and at the least, and what a film lasts where that allows it
PAUSE_MS, QUICKEST_MS, FILM_MS = 160, 40, 12_000
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


def film(
    path: Path, columns: Mapping[str, Sequence[tuple[np.ndarray, str]]], together: int = 1
) -> None:
    """Frames side by side, in rows no wider than a page, each time so many ``together``: by title
    uint8 ``[H, W, 3]`` and what is said of each; one that ends sooner than others stands still. The
    name of the file (`check_film`) says whether it is a GIF, which repeats, or an MP4.
    """
    count = max(map(len, columns.values()))
    pause = min(PAUSE_MS, max(QUICKEST_MS, FILM_MS // count // 10 * 10))
    pictures = (
        _in_rows([
            _captioned(frame, f"{name}\n{said}")
            for name, shots in columns.items() for frame, said in [shots[min(at, len(shots) - 1)]]
        ], together)
        for at in range(count)
    )  # fmt: skip
    if path.suffix == ".mp4":
        _write_mp4(path, pictures, 1000 / pause)
        return
    # By coverage of the colours: the median cut gives a small thing the colour of a large one.
    few = (Image.fromarray(one).quantize(64, Image.Quantize.MAXCOVERAGE) for one in pictures)
    next(few).save(path, save_all=True, append_images=few, duration=pause, loop=0, optimize=True)


def check_film(path: Path) -> None:
    """Raises `ValueError` where no film can be written there, before it is made."""
    if path.suffix not in (".gif", ".mp4"):
        raise ValueError(f"{path} is no name of a film: let it end in .gif or .mp4")
    if not os.access(path.parent, os.W_OK):
        raise ValueError(f"cannot write {path}: name a folder that is there and may be written to")
    if path.suffix == ".mp4" and find_spec("imageio_ffmpeg") is None:
        said = "name a .gif, or pip install 'jaxdyna[film]'"
        raise ValueError(f"films as MP4 need imageio-ffmpeg: {said}")


def _write_mp4(path: Path, pictures: Iterator[np.ndarray], rate: float) -> None:
    import imageio_ffmpeg  # noqa: PLC0415  (an extra that most people do without)

    first = next(pictures)
    height, width, _ = first.shape
    given = f"-f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {rate} -i -"
    even = "-pix_fmt yuv420p -vf pad=ceil(iw/2)*2:ceil(ih/2)*2:color=white"
    words = [imageio_ffmpeg.get_ffmpeg_exe(), *f"-y -loglevel error {given} {even}".split(), path]
    # Not by its own writer, which forks a process in whose threads JAX may be at work.
    with subprocess.Popen(words, stdin=subprocess.PIPE) as ffmpeg:
        for picture in chain([first], pictures):
            ffmpeg.stdin.write(picture.tobytes())  # type: ignore[union-attr]


def _in_rows(parts: Sequence[np.ndarray], together: int) -> np.ndarray:
    """Pictures ``[H, W, 3]`` in as few rows as a page takes, equally long ones."""
    height, width = np.max([part.shape[:2] for part in parts], axis=0)
    groups = -(-len(parts) // together)
    rows = -(-groups // max((PAGE + GAP) // (width + GAP) // together, 1))
    columns = -(-groups // rows) * together
    sheet = np.full((rows * (height + GAP) - GAP, columns * (width + GAP) - GAP, 3), 255, np.uint8)
    for number, part in enumerate(parts):
        top, left = (number // columns) * (height + GAP), (number % columns) * (width + GAP)
        sheet[top : top + part.shape[0], left : left + part.shape[1]] = part
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
