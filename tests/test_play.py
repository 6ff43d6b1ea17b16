"""A world under the keyboard: through a pseudo-terminal, whose screen is read as a person would."""

import fcntl
import io
import os
import pty
import re
import signal
import struct
import subprocess
import sys
import termios
import threading
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from jaxdyna import play
from jaxdyna.envs import CartPole, Catch, FrameStack, Maze, Pendulum, Pong
from jaxdyna.watched import Scene

TODAY = Path(__file__).parent / "data" / "kept"
HOME, LEFT, SHOWN = "\x1b[H", "\x1b[?1049l", "\x1b[?25h"
"""Before each screen, after the last one, and where the cursor is seen again."""
UP, RIGHT, DOWN = "\x1b[A", "\x1b[C", "\x1b[B"
BLOCKS = re.compile(r"\x1b\[38;2;(\d+);(\d+);(\d+);48;2;(\d+);(\d+);(\d+)m(▀+)")
ATTACHED = (
    "import os, runpy; os.close(os.open(os.ttyname(0), os.O_RDWR));"
    "runpy.run_module('jaxdyna.play', run_name='__main__', alter_sys=True)"
)
"""As a shell starts it: the terminal is its own, and Ctrl-C is sent to it."""


class Terminal:
    """A pseudo-terminal of 80 columns and 24 lines, and everything that was written to it."""

    def __init__(self):
        self.master, self.slave = pty.openpty()
        fcntl.ioctl(self.slave, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
        self.before = termios.tcgetattr(self.slave)
        self.written = b""
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self):
        while True:
            try:
                self.written += os.read(self.master, 4096)
            except OSError:
                return

    @property
    def screens(self):
        """What was shown, one after the other; whole ones."""
        shown = self.written.decode(errors="ignore").split(HOME)
        return [screen for screen in shown if "q: leave" in screen]

    def type(self, keys):
        os.write(self.master, keys.encode())

    def wait(self, shown, seconds=120):
        """The first screen of which ``shown`` holds."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            for screen in self.screens:
                if shown(screen):
                    return screen
            time.sleep(0.02)
        raise AssertionError(self.screens[-1:])

    def restored(self, seconds=10):
        end = time.monotonic() + seconds
        while LEFT.encode() not in self.written and time.monotonic() < end:
            time.sleep(0.02)
        shown = self.written.rpartition(LEFT.encode())[1] and SHOWN.encode() in self.written
        return shown and termios.tcgetattr(self.slave) == self.before


@pytest.fixture
def terminal():
    made = Terminal()
    yield made
    os.close(made.slave)
    os.close(made.master)


@contextmanager
def at(terminal):
    """This process is there; pytest puts its own files in their place before each test."""
    with ExitStack() as stack:
        patch = stack.enter_context(pytest.MonkeyPatch.context())
        for name, mode in (("stdin", "r"), ("stdout", "w")):
            file = stack.enter_context(open(terminal.slave, mode, closefd=False))
            patch.setattr(sys, name, file)
        yield


def pixels(screen):
    """``[rows, columns, 3]`` of the picture on a screen."""
    rows = []
    for line in screen.split("\n"):
        runs = BLOCKS.findall(line)
        for half in (slice(0, 3), slice(3, 6)) if runs else ():
            row = [np.tile(np.array(run[half], np.uint8), (len(run[6]), 1)) for run in runs]
            rows.append(np.concatenate(row))
    return np.stack(rows)


def agent(screen):
    """The cell of the agent."""
    blue = np.argwhere(pixels(screen)[::2, ::2, 2] == 255)
    assert len(blue) == 1
    return tuple(blue[0].tolist())


def test_the_agent_goes_where_it_is_steered_and_ctrl_c_leaves_all_as_it_was(terminal):
    environment = os.environ | {"TERM": "xterm", "NO_COLOR": "1", "COLUMNS": "", "LINES": ""}
    playing = subprocess.Popen(
        [sys.executable, "-c", ATTACHED, "maze"], stdin=terminal.slave, stdout=terminal.slave,
        stderr=terminal.slave, start_new_session=True, env=environment,
    )  # fmt: skip
    first = terminal.wait(lambda screen: "step 0," in screen)
    assert agent(first) == (15, 0) and pixels(first).shape == (32, 32, 3)
    assert not termios.tcgetattr(terminal.slave)[3] & termios.ECHO
    for step, (key, cell) in enumerate(
        ((UP, (14, 0)), (UP, (13, 0)), (RIGHT, (13, 1)), ("x", None), ("1", (13, 2)),
         (" ", (13, 2)), (DOWN, (14, 2))), start=1,
    ):  # fmt: skip
        terminal.type(key)
        if cell is not None:
            said = f"step {step - (step > 4)},"
            assert agent(terminal.wait(lambda screen, said=said: said in screen)) == cell
    lines = re.sub(r"\x1b\[[\d;?]*\w", "", terminal.screens[-1]).split("\n")
    assert len(lines) == 24 and max(map(len, lines)) <= 81  # with the carriage return
    terminal.type("\x03")
    assert playing.wait(60) == 130
    assert terminal.restored() and "Traceback" not in terminal.written.decode()


def keys_later(terminal, *keys):
    """Typed one after the other, once there is another screen each time."""

    def type_them():
        for number, key in enumerate(keys, start=1):
            while len(terminal.screens) < number:
                time.sleep(0.01)
            terminal.type(key)

    threading.Thread(target=type_them, daemon=True).start()


def test_a_dream_beside_the_truth(terminal):
    """A new start is dreamed of from there, and so is where the true world is after ``d``."""
    keys_later(terminal, RIGHT, RIGHT, "d", "n", "q")
    with at(terminal):
        assert play.main(["cartpole", "--run", str(TODAY)]) == 0
    screens = terminal.screens
    said = [re.findall(r"(step \d+), return", screen) for screen in screens]
    assert said == [[f"step {true}", f"step {dreamed}"]
                    for true, dreamed in ((0, 0), (1, 1), (2, 2), (2, 0), (0, 0))]  # fmt: skip
    assert all("true" in screen and "dreamed" in screen for screen in screens)
    for number in (0, 3, 4):  # side by side the same
        both = pixels(screens[number])
        half = both.shape[1] // 2
        np.testing.assert_array_equal(both[:, :half], both[:, half:])
    assert not np.array_equal(pixels(screens[0]), pixels(screens[4]))
    assert terminal.restored()


@pytest.mark.parametrize("end", ["an error", "SIGTERM"])
def test_the_terminal_is_as_before_whatever_ends_it(end, terminal, monkeypatch):
    def step(scene, action):
        if end == "SIGTERM":
            os.kill(os.getpid(), signal.SIGTERM)
        raise ZeroDivisionError

    handler = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(Scene, "step", step)
    keys_later(terminal, "0")
    kind = SystemExit if end == "SIGTERM" else ZeroDivisionError
    with at(terminal), pytest.raises(kind):
        play.main(["catch"])
    assert terminal.restored() and signal.getsignal(signal.SIGTERM) is handler


@pytest.mark.parametrize(
    ("size", "shown"), [((6, 2), (4, 6)), ((13, 9), (8, 12)), ((3, 9), (2, 3))]
)
def test_a_picture_is_as_large_as_fits(size, shown):
    frame = np.random.default_rng(0).integers(0, 256, (4, 6, 3), np.uint8)
    console = Console(file=io.StringIO(), color_system="truecolor", force_terminal=True, width=80)
    console.print(play.picture(frame, *size))
    seen, times = pixels(console.file.getvalue()), shown[0] // 4
    assert seen.shape == (*shown, 3)
    if times:
        np.testing.assert_array_equal(seen, frame.repeat(times, 0).repeat(times, 1))
    else:
        means = frame.reshape(2, 2, 3, 2, 3).mean((1, 3))
        np.testing.assert_allclose(seen, means, atol=1)


def test_keys():
    arrows = {"left": 0, "right": 1, "up": 2, "down": 3, "space": 4}
    assert play.keys_of(FrameStack(Maze())) == {str(one): one for one in range(5)} | arrows
    assert play.keys_of(CartPole()) == {"0": 0, "1": 1, "left": 0, "right": 1}
    assert play.keys_of(Catch())["right"] == 2 and play.keys_of(Catch())["space"] == 1
    assert play.keys_of(Pong())["up"] == 2 and "left" not in play.keys_of(Pong())
    assert play.keys_of(Pendulum()) == {"left": -2, "space": 0, "right": 2}
    scene, console = Scene(Pendulum(), Pendulum().default_params), Console(width=80, height=24)
    scene.begin(0)
    with console.capture() as shown:
        console.print(play.screen(scene.shots(), play.keys_of(Pendulum()), console))
    assert "left space right: act  n: new episode" in shown.get()


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["mase"], "mase is no world: did you mean jaxdyna:Maze?"),
        (["maze", "--run", str(TODAY)], "is a run in CartPole: leave out maze"),
        (["--arm", "dyna"], "name a world, or the --run of one"),
        (["--run", str(TODAY), "--arm", "nobody"], "has no arm nobody"),
        (["--run", str(TODAY / "nowhere")], "has no result of a run"),
    ],
)
def test_what_cannot_be_played_is_said_in_one_line(argv, said, terminal, capsys):
    with at(terminal), pytest.raises(SystemExit, match="2"):
        play.main(argv)
    [line] = capsys.readouterr().err.strip().splitlines()
    assert said in line and terminal.written == b""


def test_where_there_is_no_terminal(capsys):
    with pytest.raises(SystemExit, match="2"):
        play.main(["maze"])
    [line] = capsys.readouterr().err.strip().splitlines()
    assert "this is no terminal" in line
