"""Compiled programs that are kept from one start to the next."""

import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from pole import POLE

from jaxdyna.experiments.engine import main, programs, work

PLAY = """
import sys, jax, jax.numpy as jnp
from jaxdyna.experiments.engine import programs
hits = []
jax.monitoring.register_event_listener(
    lambda event, **_: hits.append(event) if event.endswith("cache_hits") else None)
with programs.kept():
    print("begun", flush=True)
    def body(x, key):
        for number in range(int(sys.argv[1])):
            x = jnp.sort(jnp.tanh(x @ x.T + jax.random.normal(key, x.shape)), axis=number % 2)
        return x, x.sum()
    keys = jax.random.split(jax.random.key(0), 3)
    found = jax.jit(lambda x: jax.lax.scan(body, x, keys))(jnp.ones((8, 8)))[1]
    print(f"{float(found.sum()):.4f} {len(hits)}", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder for programs, with nothing of the tests' own cache."""
    monkeypatch.setenv(programs.FOLDER, str(tmp_path / "cache"))
    before = jax.config.jax_compilation_cache_dir
    programs._configure({programs.DIRECTORY: None})
    yield tmp_path / "cache"
    programs._configure({programs.DIRECTORY: before})


def start(size: int = 12) -> subprocess.Popen:
    env = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    return subprocess.Popen(
        [sys.executable, "-c", PLAY, str(size)], env=env, text=True, stdin=subprocess.PIPE,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip


def compile_one(value: float) -> None:
    jax.jit(lambda x: x * value + 1)(jnp.arange(3.0)).block_until_ready()


def entries(folder: Path) -> list[Path]:
    return sorted(folder.glob("*/*-cache"))


def test_a_second_process_compiles_nothing_and_finds_the_same(folder):
    first, *_ = start().communicate()
    second, *_ = start().communicate()
    assert first.split()[1] == second.split()[1]
    assert first.split()[2] == "0"
    assert int(second.split()[2]) >= 1
    assert [path.name for path in folder.glob("*/process-*")] == []


def test_what_a_killed_process_left_is_removed_and_not_shared(folder):
    killed = start()
    assert killed.stdout is not None
    killed.stdout.readline(), killed.stdout.readline()
    (own,) = folder.glob("*/process-*")
    assert [*own.glob("*-cache")]
    with programs.kept():
        assert own.exists()  # it lives
    killed.send_signal(signal.SIGKILL)
    killed.communicate()
    with programs.kept():
        assert not own.exists()
    assert entries(folder) == []


def test_entries_are_shared_once_they_are_whole(folder, monkeypatch):
    monkeypatch.setitem(programs.HOW, "jax_persistent_cache_min_compile_time_secs", 0.0)
    with programs.kept() as share:
        compile_one(2.0)
        assert entries(folder) == []
        share()
        assert entries(folder)
    before = entries(folder)
    with programs.kept():
        compile_one(3.0)
    assert set(before) < set(entries(folder))
    assert jax.config.jax_compilation_cache_dir is None


def test_programs_are_shared_before_the_first_arm_is_played(folder, tmp_path, monkeypatch):
    found, play = [], work.Engine.play

    def playing(engine, *arguments):
        found.append(entries(folder))
        return play(engine, *arguments)

    monkeypatch.setattr(work.Engine, "play", playing)
    flags = ["--arms", "model_free", "dyna", "--seeds", "1", "--out", str(tmp_path / "out")]
    assert main(POLE, argv=flags, prog="pole") == 0
    assert found[0] and len(found) == 2


def test_what_was_not_used_for_long_makes_room(folder, monkeypatch):
    where = folder / programs.machine()
    where.mkdir(parents=True)
    for number, name in enumerate(["old", "new", "newest"]):
        (where / f"{name}-cache").write_bytes(b"x" * 10)
        os.utime(where / f"{name}-cache", (number, time.time()))
    monkeypatch.setattr(programs, "MOST_BYTES", 25)
    with programs.kept():
        pass
    assert [path.name for path in entries(folder)] == ["new-cache", "newest-cache"]


def test_threads_and_processor_have_folders_of_their_own(monkeypatch):
    monkeypatch.setenv("NPROC", "2")
    two = programs.machine()
    monkeypatch.setenv("NPROC", "3")
    assert programs.machine() != two
    assert "/" not in two


def test_what_a_full_disk_cut_is_not_shared(folder, monkeypatch):
    monkeypatch.setitem(programs.HOW, "jax_persistent_cache_min_compile_time_secs", 0.0)
    with programs.kept() as share:
        compile_one(5.0)
        (own,) = folder.glob("*/process-*")
        written = [*own.glob("*-cache")]
        for entry in written:
            entry.write_bytes(entry.read_bytes()[:-9])
        share()
    assert written and entries(folder) == []


@pytest.mark.parametrize("why", ["told", "a file"])
def test_without_a_folder_nothing_is_kept(folder, monkeypatch, why):
    if why == "a file":
        folder.write_text("in the way")
    else:
        programs._configure({programs.DIRECTORY: str(folder / "own")})
    before = jax.config.jax_compilation_cache_dir
    with programs.kept() as share:
        assert jax.config.jax_compilation_cache_dir == before
        share()


@pytest.mark.slow
def test_two_hundred_starts_eight_at_a_time_of_which_a_quarter_is_killed(folder):
    """Killed within the second after they began to compile; four at a time are the same program."""

    def one(number: int) -> tuple[int, int, str]:
        process = start(program := number // 4 % 20 + 1)
        assert process.stdout is not None
        if number % 4 == 3:
            process.stdout.readline()
            time.sleep((number * 37) % 100 / 100)
            process.kill()
        out, errors = process.communicate()
        return program, process.returncode, " ".join(out.split()[1:2]) + errors

    with ThreadPoolExecutor(8) as pool:
        found = [*pool.map(one, range(200))]
    whole = {said for number, said in enumerate(found) if number % 4 != 3}
    assert {code for _, code, _ in whole} == {0}
    assert len(whole) == len({program for program, *_ in whole}) == 20
    assert all(programs._is_whole(entry.read_bytes()) for entry in entries(folder))
    with programs.kept():
        assert len([*folder.glob("*/process-*")]) == 1
