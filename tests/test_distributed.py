"""One run over several processes on this machine is the run of one, also where one is killed."""

import fcntl
import itertools
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import jax
import numpy as np
import pytest
from parts import lines
from pole import PARTS

from jaxdyna.experiments.engine import distributed, folders, main, storage

RUN = ["--arms", "model_free", "--seeds", "5", "--episodes", "12", "--threshold", "19",
       "--stop-after-solved", "0"]  # fmt: skip
PLAY = """
import os, signal, sys
from pole import PARTS
from jaxdyna.experiments.engine import main
from jaxdyna.experiments.engine.checkpoint import Store

save, saved = Store.save, set()

def dying(self, number, run, seconds):
    save(self, number, run, seconds)
    saved.add(number)
    if len(saved) == 2:
        os.kill(os.getpid(), signal.SIGKILL)

if "DIES" in os.environ:
    Store.save = dying
sys.exit(main(*PARTS, prog="python -m pole"))
"""


def begun(out, *arguments, **environment):
    here = Path(__file__).parent
    paths = os.pathsep.join([str(here.parent), str(here)])
    return subprocess.Popen(
        [sys.executable, "-c", PLAY, *RUN, *arguments, "--out", str(out)], text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": paths, "COLUMNS": "1000"} | environment,
    )  # fmt: skip


def together(out, number, *arguments, dies=0, until=None):
    """Of each process: exit code, standard output and error, in the order of their numbers. Ctrl-C
    reaches all of them once ``until`` is true.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    every = [
        begun(out, *arguments, "--distributed", f"127.0.0.1:{port},{one}/{number}",
              **({"DIES": ""} if one == dies else {}))
        for one in range(1, number + 1)
    ]  # fmt: skip
    if until:
        while not until():
            assert all(process.poll() is None for process in every)
            time.sleep(0.05)
        for process in every:
            process.send_signal(signal.SIGINT)
    return ended(every)


def ended(every):
    said = [process.communicate(timeout=300) for process in every]
    return [(process.returncode, *words) for process, words in zip(every, said, strict=True)]


def alone(out, *arguments):
    process = begun(out, *arguments)
    assert not process.communicate()[1] and process.returncode == 0
    return np.load(out / "curves.npz")


def same(out, whole):
    ours = np.load(out / "curves.npz")
    assert ours.files == whole.files
    for name in whole.files:
        np.testing.assert_array_equal(ours[name], whole[name], err_msg=name)
    ends = [int(np.isfinite(one).sum()) for one in whole["model_free/real_return"]]
    wanted = {("model_free", seed, step) for seed, end in enumerate(ends)
              for step in range(2, end + 1, 2)}  # fmt: skip
    assert lines(out).keys() == wanted and len(list(out.glob("log*"))) == 1
    assert not {"checkpoints", ".lock"} & {path.name for path in out.iterdir()}


def test_two_processes_are_one(tmp_path):
    with jax.debug_key_reuse(False):  # which mistakes a cond over several runs for two uses
        assert main(*PARTS, argv=[*RUN, "--out", str(tmp_path / "whole")], prog="pole") == 0
    whole = np.load(tmp_path / "whole" / "curves.npz")
    (first, said, error), second = together(tmp_path / "both", 2)
    assert (first, error) == (0, "") and "Report: " in said
    assert second == (0, "", "")
    same(tmp_path / "both", whole)
    ours, theirs = (storage.read_json(tmp_path / one / "results.json") for one in ("both", "whole"))
    assert ours["timing"]["shards"] == 2
    assert ours["arms"] == theirs["arms"] and ours["runs"] == theirs["runs"]


@pytest.mark.slow
@pytest.mark.parametrize("dies", [1, 2])
def test_one_is_killed_and_others_go_on(dies, tmp_path):
    """The line comes within a minute, and any number of processes ends the run."""
    whole, out = alone(tmp_path / "whole"), tmp_path / "out"
    began = time.monotonic()
    done = together(out, 2, dies=dies)
    assert time.monotonic() - began < 60
    assert [code for code, *_ in done] == [-9 if one == dies else 1 for one in (1, 2)]
    line = f"process {dies} of 2 was lost. What is finished is in {out}; the same command with"
    _, said, error = done[2 - dies]
    assert " ".join(said.split()).count(line) == 1 and not error
    assert list(out.glob("checkpoints/*/run*.npz"))
    for number in (1, 3):
        copy = Path(shutil.copytree(out, tmp_path / str(number)))
        if number == 1:
            alone(copy, "--resume")
        else:
            assert [code for code, *_ in together(copy, number, "--resume")] == [0, 0, 0]
        same(copy, whole)


@pytest.mark.slow
def test_interrupted_together_and_resumed_is_uninterrupted(tmp_path):
    """Each saves what it plays, and one line says how to go on."""
    whole, out = alone(tmp_path / "whole", "--episodes", "120"), tmp_path / "out"
    saved = partial(out.glob, "checkpoints/*/run*.npz")
    done = together(out, 2, "--episodes", "120", until=lambda: any(saved()))
    assert [code for code, *_ in done] == [130, 130] and not done[0][2] + done[1][1] + done[1][2]
    said = " ".join(done[0][1].split())
    assert said.count(f"Interrupted. What is finished is in {out}; the same command with") == 1
    assert any(saved()) and not (out / "curves.npz").exists()
    assert [code for code, *_ in together(out, 2, "--episodes", "120", "--resume")] == [0, 0]
    same(out, whole)


@pytest.mark.slow
def test_bad_input_is_said_where_it_was_typed(tmp_path):
    """By each process that was started by itself; once where a cluster started all alike."""
    for one in together(tmp_path / "out", 2, "--seeds", "0"):
        assert one[:2] == (2, "") and one[2].count("error: --seeds") == 1
    cluster = {"SLURM_JOB_ID": "1", "SLURM_STEP_NODELIST": "localhost", "SLURM_NTASKS": "2"}
    first, second = ended([
        begun(tmp_path / "out", "--seeds", "0", "--distributed", **cluster, SLURM_PROCID=number,
              SLURM_LOCALID=number)
        for number in "01"
    ])  # fmt: skip
    assert first[2].count("error: --seeds") == 1 and second == (2, "", "")
    assert first[0] == 2 and not (tmp_path / "out").exists()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("")
    first, second = together(tmp_path / "mine", 2)
    assert first[0] == second[0] == 2 and second[1:] == ("", "")
    assert first[2].count("choose an empty folder") == 1


@pytest.mark.parametrize(
    ("typed", "said"),
    [("", None), ("--distributed", ""), ("--distributed=a:1,1/2", "a:1,1/2"),
     ("--distributed a:1,1/2", "a:1,1/2")],
)  # fmt: skip
def test_the_flag_is_taken_out_of_the_command(typed, said):
    words = ["--seeds", "3", *typed.split(), "--resume"]
    assert distributed.taken(words) == (["--seeds", "3", "--resume"], said)


@pytest.mark.parametrize("said", ["a:1,0/2", "a:1,3/2", "a,1/2", "1/2"])
def test_who_this_process_is_makes_sense(said):
    with ExitStack() as stack, pytest.raises(ValueError, match="give HOST:PORT,I/N"):
        distributed.Processes().found(said, stack)


@pytest.mark.parametrize(("count", "block", "of"), [(10, 3, 2), (2, 1, 4), (7, 2, 3)])
def test_each_run_is_played_once(count, block, of):
    shares = []
    for number in range(1, of + 1):
        one = distributed.Processes()
        one.number, one.of = number, of
        shares.append(one.rows(count, block))
    assert sorted(itertools.chain(*shares)) == list(range(count))


def test_a_straggler_of_a_lost_run_keeps_its_folder(tmp_path):
    """Until it has saved what it played."""
    with ExitStack() as straggler:
        with folders.held(tmp_path) as lock:
            folders.share(lock)
            straggler.enter_context(folders.held(tmp_path, alone=False))
        with pytest.raises(ValueError, match="in use by process"):
            folders.held(tmp_path).__enter__()
    with folders.held(tmp_path) as lock:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    assert not (tmp_path / ".lock").exists()
