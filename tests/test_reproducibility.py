"""Of every world: the same command twice, on one core or all, in shards, is the same run bit for
bit; and whole runs in double precision come to their ends.
"""

import os
import subprocess
import sys

import numpy as np
import pytest
import tiny
from renamed import respelled

from jaxdyna.experiments.engine import storage

pytestmark = pytest.mark.slow
CATCH = ["catch", "--rows", "4", "--columns", "3", "--episodes", "30", "--dyna.num-real-first", "3"]
COMMANDS = {
    "cartpole": [*tiny.NET["cartpole-paper"]],
    "cartpole-lean": [*tiny.NET["cartpole-lean"]],
    "cartpole-planners": ["cartpole", *tiny.CARTPOLE, *tiny.PLANNERS, "--arms", "mcts", "mpc_init"],
    "maze": ["maze", *tiny.MAZE, "--arms", "dyna", "oracle", "more_updates"],
    "maze-planners": [*tiny.NET["maze-imitating"]],
    "maze-model": [*tiny.NET["maze-model"]],
    "pong": ["pong", *tiny.PONG, "--arms", "dyna", "dyna_adversarial"],
    "pong-model": ["pong", *tiny.PONG_MODEL, "--arms", "ours"],
    "pong-model-atari": ["pong", *tiny.PONG_MODEL, *tiny.ON_THE_ATARI, "--arms", "adversarial"],
}  # fmt: skip


def command(name):
    return CATCH if name == "catch" else respelled(COMMANDS[name])


def play(out, *arguments, cores=None, **environment):
    world, *rest = arguments
    module = f"jaxdyna.experiments.{world}"
    subprocess.run(
        [sys.executable, "-m", module, *rest, "--out", str(out)],
        check=True, capture_output=True, env=os.environ | environment,
        preexec_fn=cores and (lambda: os.sched_setaffinity(0, cores)),
    )  # fmt: skip
    return out


def assert_same(ours, theirs):
    ours, theirs = (storage.read_arrays(folder / "curves.npz") for folder in (ours, theirs))
    assert ours.keys() == theirs.keys() and ours
    for name, values in ours.items():
        np.testing.assert_array_equal(values, theirs[name], err_msg=name)


@pytest.mark.parametrize("name", ["catch", *COMMANDS])
def test_again_on_one_core_and_in_shards(name, tmp_path):
    run = [*command(name), "--seeds", "3", "--block", "2"]
    whole = play(tmp_path / "whole", *run)
    cores = os.sched_getaffinity(0)
    again = play(tmp_path / "again", *run, cores={min(cores)}, NPROC=str(len(cores)))
    assert_same(again, whole)
    shards = [play(tmp_path / str(i), *run, "--shard", f"{i}/2") for i in (1, 2)]
    merge = [sys.executable, "-m", "jaxdyna.experiments.merge", *shards, "--out", tmp_path / "all"]
    subprocess.run(merge, check=True, capture_output=True)
    assert_same(tmp_path / "all", whole)
    results = whole / "results.json"
    assert_same(play(tmp_path / "from", run[0], "--from", str(results)), whole)


@pytest.mark.parametrize("name", ["catch", *COMMANDS])
def test_double_precision(name, tmp_path):
    out = play(tmp_path / "out", *command(name), JAX_ENABLE_X64="1")
    results = storage.read_json(out / "results.json")
    assert results["device"]["x64"] is True and "unfinished" not in results
    assert not any("diverged" in arm for arm in results["arms"].values())
