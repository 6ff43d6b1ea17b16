"""The examples that spread an experiment over many machines say what a user would type; schedulers
and processes are stood in for (both were tried with the real ones: docs/scale.md).
"""

import importlib.util
import json
import os
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import pytest

EXAMPLES = Path(__file__).parent.parent / "docs" / "examples"
FLAGS = ["--seeds", "4", "--sweep", "hparams.agent.learning_rate=0.01,0.02", "--out-of", "a b"]
SBATCH = """#!/usr/bin/env bash
printf '%s\\n' "$@" >> sbatch.txt
script=$(mktemp -p .); cat > "$script"
case "$*" in
  *--array=1-2*) for one in 1 2; do SLURM_ARRAY_TASK_ID=$one bash "$script"; done; echo "7;here" ;;
  *) bash "$script"; echo 8 ;;
esac
"""
PYTHON = """#!/usr/bin/env bash
printf '%s\\t' "$@" >> played.txt; echo >> played.txt
"""


def words(name, number, *more, flags=FLAGS):
    out = f"out/parts/{number}-of-2"
    return ["-m", f"jaxdyna.experiments.{name}", *flags, "--shard", f"{number}/2", "--out", out,
            *more]  # fmt: skip


MERGE = ["-m", "jaxdyna.experiments.merge", "out/parts/1-of-2", "out/parts/2-of-2", "--out", "out"]


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, text in {"sbatch": SBATCH, "python": PYTHON}.items():
        path = tmp_path / "bin" / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
        path.chmod(0o755)
    return tmp_path


def begun(folder):
    """A shard that was interrupted, and one that is whole."""
    (folder / "out" / "parts" / "1-of-2" / "checkpoints").mkdir(parents=True)
    (folder / "out" / "parts" / "2-of-2").mkdir()
    (folder / "out" / "parts" / "2-of-2" / "results.json").write_text("{}")


def by_slurm(folder, *arguments):
    env = os.environ | {"PATH": f"{folder / 'bin'}:{os.environ['PATH']}",
                        "SBATCH_FLAGS": "--partition=long --time=60"}  # fmt: skip
    env.pop("PYTHON", None)
    return subprocess.run([EXAMPLES / "slurm.sh", *arguments], env=env, text=True,
                          capture_output=True, check=False)  # fmt: skip


def played(folder):
    lines = (folder / "played.txt").read_text().splitlines()
    return [line.split("\t")[:-1] for line in lines]


def test_slurm_plays_every_shard_and_merges_them(here):
    done = by_slurm(here, "2", "out", "cartpole", *FLAGS)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "array 7 plays 2 shards into out/parts; job 8 merges them into out\n"
    assert played(here) == [words("cartpole", 1), words("cartpole", 2), MERGE]
    told = (here / "sbatch.txt").read_text().splitlines()
    assert {"--partition=long", "--time=60", "--dependency=afterok:7", "--requeue"} <= set(told)


def test_slurm_goes_on_with_what_was_begun(here):
    begun(here)
    assert by_slurm(here, "2", "out", "maze", *FLAGS).returncode == 0
    assert played(here) == [words("maze", 1, "--resume"), MERGE]


def test_slurm_needs_no_flags(here):
    assert by_slurm(here, "2", "out", "catch").returncode == 0
    assert played(here) == [words("catch", 1, flags=[]), words("catch", 2, flags=[]), MERGE]


def test_slurm_says_how_it_is_called(here):
    done = by_slurm(here, "2", "out")
    assert done.returncode == 2
    assert "usage" in done.stderr
    assert not (here / "sbatch.txt").exists()


@pytest.fixture
def sweep(here, monkeypatch):
    """The example, beside a submitit that plays at once."""
    told, calls = [], []

    class Executor:
        def __init__(self, folder, cluster=None):
            told.append((Path(folder), cluster))

        def update_parameters(self, **parameters):
            told.append(parameters)

        def batch(self):
            return nullcontext()

        def submit(self, shard):
            shard()
            again = shard.checkpoint()
            assert again.function is shard  # what is submitted once it was preempted
            return SimpleNamespace(result=lambda: None)

    helpers = SimpleNamespace(DelayedSubmission=lambda function: SimpleNamespace(function=function))
    monkeypatch.setitem(sys.modules, "submitit", SimpleNamespace(AutoExecutor=Executor))
    monkeypatch.setitem(sys.modules, "submitit.helpers", helpers)
    spec = importlib.util.spec_from_file_location("sweep", EXAMPLES / "submitit_sweep.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "sweep", module)
    spec.loader.exec_module(module)
    child = SimpleNamespace(wait=lambda: 0, terminate=lambda: calls.append("terminated"))

    def popen(line):
        calls.append(line[1:])
        return nullcontext(child)

    monkeypatch.setattr(module.subprocess, "Popen", popen)
    return SimpleNamespace(main=module.main, told=told, calls=calls, child=child)


def test_submitit_plays_every_shard_and_merges_them(sweep, monkeypatch):
    monkeypatch.setenv("SUBMITIT", json.dumps({"cluster": "local", "cpus_per_task": 2}))
    sweep.main(2, Path("out"), ("pong", *FLAGS))
    assert sweep.calls == [words("pong", 1), words("pong", 2), MERGE]
    assert sweep.told == [(Path("out/parts/logs"), "local"), {"cpus_per_task": 2}]


def test_submitit_goes_on_with_what_was_begun(sweep, here):
    begun(here)
    sweep.main(2, Path("out"), ("maze", *FLAGS))
    assert sweep.calls == [words("maze", 1, "--resume"), MERGE]


def test_submitit_lets_a_preempted_shard_save(sweep):
    def preempted():
        raise KeyboardInterrupt

    sweep.child.wait = preempted
    with pytest.raises(KeyboardInterrupt):
        sweep.main(2, Path("out"), ("maze", *FLAGS))
    assert sweep.calls[1] == "terminated"
    sweep.child.wait = lambda: 3
    with pytest.raises(SystemExit, match="ended with code 3"):
        sweep.main(2, Path("out"), ("maze", *FLAGS))
