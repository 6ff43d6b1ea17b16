"""``python -m jaxdyna.play WORLD``: a world under the keyboard, in the terminal; with ``--run`` a
run's, beside the dream of it that was learned.
"""

import os
import re
import signal
import sys
import termios
import tty
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from PIL import Image
from rich.color import Color
from rich.console import Console, Group
from rich.live import Live
from rich.style import Style
from rich.table import Table
from rich.text import Text

from jaxdyna.actions import Box, actions_of
from jaxdyna.envs.named import FORMS, named, whole
from jaxdyna.experiments.engine import cli, programs
from jaxdyna.experiments.engine.loaded import load
from jaxdyna.fields import setting
from jaxdyna.watched import Scene, Shot

PROG = "python -m jaxdyna.play"
#: an arrow or the like, of which the last letter counts, or what is a letter itself
TYPED = re.compile(rb"\x1b[\[O][\d;]*(.)|([^\x1b])")
ARROWS = {b"A": "up", b"B": "down", b"C": "right", b"D": "left"}
LETTERS = {b" ": "space", b"\x04": "q"}
WORLDS = f"maze, cartpole, pong, catch, pendulum, {FORMS}"
GAP, LINES = 2, 4  #: columns between two pictures, and lines of text


@dataclass(frozen=True)
class Call:
    """Steers a world with the keyboard, or a run's, and beside it the dream that it has learned."""

    world: tyro.conf.Positional[str | None] = setting(None, "which")
    run: Path | None = setting(None, "the folder of a run that keeps what it has learned")
    arm: str | None = setting(None, "whose dream; the first that has one")
    seed: int | None = setting(None, "of the run; the first that is kept")


@cli.command(Call, PROG, "WORLD | --run DIR [--arm ARM] [--seed N]", f"\nWorlds: {WORLDS}")
def main(call: Call, argv: Sequence[str]) -> int:
    """Steers until a key ends it; `ValueError` where there is no terminal, or nothing to watch."""
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise ValueError("this is no terminal: play where keys are typed and colours are shown")
    with programs.kept():
        env, scene = watched(call)
        console = Console(color_system="truecolor", no_color=False)
        try:
            with keyboard(), Live(console=console, screen=True, auto_refresh=False) as live:
                steer(scene, keys_of(env), live)
        except KeyboardInterrupt:
            return 130
    return 0


def watched(call: Call) -> tuple[Any, Scene]:
    """The world, and how it is watched."""
    env = named(whole(call.world)) if call.world else None
    if call.run is None:
        if env is None:
            raise ValueError("there is nothing to play: name a world, or the --run of one")
        return env, Scene(env, env.default_params)
    scenes = load(call.run).scenes([call.arm] if call.arm else [], call.seed)
    run, scene = next(iter(scenes.values()))
    own = type(getattr(run.env, "env", run.env))
    if env is not None and type(env) is not own:
        raise ValueError(f"{call.run} is a run in {own.__name__}: leave out {call.world}")
    return run.env, scene


def keys_of(env: Any) -> dict[str, Any]:
    """Actions by key: their digits, and what the world says; where it says nothing and has two or
    three, the first and the last are left and right. Of a Box of one number left is the lowest,
    space the middle, right the highest; `ValueError` for a larger one.
    """
    actions = actions_of(env)
    if isinstance(actions, Box):
        if actions.shape != (1,):
            raise ValueError(f"{type(env).__name__} takes {actions.shape[0]} numbers a step, and a "
                             "key is one: play a world of numbered actions")  # fmt: skip
        ends = np.array([actions.low, actions.high], np.float32)
        return {"left": ends[0], "space": ends.mean(0), "right": ends[1]}
    count = actions.n
    few = {"left": 0, "right": count - 1} | ({"space": 1} if count == 3 else {})
    own = getattr(getattr(env, "env", env), "keys", {}) or (few if count in (2, 3) else {})
    return {str(action): action for action in range(min(count, 10))} | dict(own)


@contextmanager
def keyboard() -> Iterator[None]:
    """Keys come one by one and are not echoed; all is as before once it ends, however it does."""

    def end(number: int, frame: Any) -> None:
        sys.exit(128 + number)

    modes = termios.tcgetattr(sys.stdin)
    with cli.receiving({signal.SIGTERM: end, signal.SIGINT: signal.default_int_handler}):
        try:
            tty.setcbreak(sys.stdin)
            yield
        finally:
            termios.tcsetattr(sys.stdin, termios.TCSAFLUSH, modes)


def steer(scene: Scene, actions: Mapping[str, Any], live: Live) -> None:
    """Plays episodes, by keys, until one of them says that it is over."""
    episode = 0
    scene.begin(episode)
    while True:
        live.update(screen(scene.shots(), actions, live.console), refresh=True)
        for key in pressed():
            if key == "q":
                return
            if key == "n":
                episode += 1
                scene.begin(episode)
            elif key == "d":
                scene.dream()
            elif key in actions:
                scene.step(actions[key])


def pressed() -> list[str]:
    """The next keys, by name."""
    typed = os.read(sys.stdin.fileno(), 1024)
    names = [
        ARROWS.get(arrow, "") if arrow else LETTERS.get(letter, letter.decode("latin-1"))
        for arrow, letter in TYPED.findall(typed)
    ]
    return names if typed else ["q"]  # the terminal is gone


def screen(shots: Mapping[str, Shot], actions: Mapping[str, Any], console: Console) -> Group:
    """The sides, each under its caption, and the keys."""
    width = (console.width + GAP) // len(shots) - GAP
    sides = Table.grid(padding=(0, GAP, 0, 0))
    sides.add_row(*(Text(f"{name}\n{said}") for name, (_, said) in shots.items()))
    sides.add_row(*(picture(frame, width, console.height - LINES) for frame, _ in shots.values()))
    own = " ".join(key for key in actions if not key.isdigit())
    dream = "d: dream from here  " if len(shots) > 1 else ""
    digits = [key for key in actions if key.isdigit()]
    own += f" 0-{digits[-1]}" if digits else ""
    keys = f"{own}: act  n: new episode  {dream}q: leave"
    return Group(sides, Text(), Text(keys, no_wrap=True))


def picture(frame: np.ndarray, width: int, height: int) -> Text:
    """Bytes ``[H, W, 3]`` as half blocks, two pixels each, as large as columns and lines allow."""
    scale = min(width / frame.shape[1], 2 * height / frame.shape[0])
    scale = int(scale) or scale  # or cells would be of several sizes
    columns, rows = int(frame.shape[1] * scale), int(frame.shape[0] * scale / 2) * 2
    image = Image.fromarray(frame).resize((max(columns, 1), max(rows, 2)), Image.Resampling.BOX)
    lines = []
    for upper, lower in np.asarray(image).reshape(-1, 2, image.width, 3).tolist():
        lines.append(Text(no_wrap=True))
        for (above, below), run in groupby(zip(upper, lower, strict=True)):
            style = Style(color=Color.from_rgb(*above), bgcolor=Color.from_rgb(*below))
            lines[-1].append("▀" * len([*run]), style)
    return Text("\n").join(lines)


if __name__ == "__main__":
    sys.exit(main())
