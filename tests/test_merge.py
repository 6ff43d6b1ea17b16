"""Shards put together are the run that was never cut, and what is none is refused by name."""

import json
import shutil

import jax
import numpy as np
import pytest
from parts import lines
from pole import PARTS

from jaxdyna.experiments import merge
from jaxdyna.experiments.engine import main, storage

PROG = "python -m pole"
RUN = ["--arms", "model_free", "--seeds", "4", "--block", "2", "--episodes", "30",
       "--stop-after-solved", "0", "--threshold", "19"]  # fmt: skip


def play(out, *arguments):
    with jax.debug_key_reuse(False):  # which mistakes a cond over several runs for two uses
        assert main(*PARTS, argv=[*RUN, *arguments, "--out", str(out)], prog=PROG) == 0
    return out


def merged(*arguments):
    return merge.main([*map(str, arguments)])


@pytest.fixture(scope="module")
def shards(tmp_path_factory):
    folder = tmp_path_factory.mktemp("shards")
    return [play(folder / str(number), "--shard", f"{number}/2") for number in (1, 2)]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return play(tmp_path_factory.mktemp("whole") / "out")


def read(folder):
    return storage.read_json(folder / "results.json")


@pytest.mark.parametrize("turned", [1, -1])
def test_shards_put_together_are_the_whole(shards, whole, turned, tmp_path):
    out = tmp_path / "record"
    assert merged(*shards[::turned], "--out", out) == 0
    ours, theirs = (np.load(folder / "curves.npz") for folder in (out, whole))
    assert ours.files == theirs.files
    for name in ours.files:
        assert ours[name].dtype == theirs[name].dtype
        np.testing.assert_array_equal(ours[name], theirs[name], err_msg=name)
    ends = np.isfinite(ours["model_free/real_return"]).sum(1)
    assert len(set(ends)) > 1  # stops are on
    ours, theirs = read(out), read(whole)
    assert ours.keys() == theirs.keys()
    own = ("command", "timing", "device", "commit", "source")
    assert {k: v for k, v in ours.items() if k not in own} == {
        k: v for k, v in theirs.items() if k not in own
    }
    assert ours["runs"] == {"seeds": [0, 1, 2, 3], "of": 4, "shard": [1, 1], "block": 2}
    first, second, last = ours["command"].split(" && ")
    assert first.endswith("--shard 1/2 --out " + str(shards[0])) and "--shard 2/2" in second
    assert last.startswith("python -m jaxdyna.experiments.merge ")
    parts = [read(folder)["timing"] for folder in shards]
    assert ours["timing"]["shards"] == 2
    for seconds in ("compile_s", "run_s"):
        assert ours["timing"][seconds] == pytest.approx(sum(one[seconds] for one in parts))
    policies = sorted(path.relative_to(whole) for path in whole.glob("kept/*/*.npz"))
    assert [path.stem for path in policies] == ["0", "1", "2", "3"]
    for path in policies:
        assert (out / path).read_bytes() == (whole / path).read_bytes()
    assert lines(out) == lines(whole)
    images = {path.name for path in whole.glob("*.png")}
    assert images and images == {path.name for path in out.glob("*.png")}
    assert (out / "report.md").read_text().startswith("# Pole\n")


def edited(folder, out, **changes):
    """A copy of a shard whose results say something else."""
    shutil.copytree(folder, out)
    results = read(out)
    for path, value in changes.items():
        *outer, name = path.split("__")
        inner = results
        for part in outer:
            inner = inner[part]
        inner[name] = value
    (out / "results.json").write_text(json.dumps(results))
    return out


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"experiment": "maze"}, "another experiment"),
        ({"part": "frames"}, "another part"),
        ({"preset": "lean"}, "another preset"),
        ({"sweep": {"rows": [3, 4]}}, "another sweep"),
        ({"source": "0123"}, "another source"),
        ({"config__block": 3}, "--block"),
        ({"config__seeds": 6}, "--seeds"),
        ({"config__dyna__rare_share": 0.25}, "--dyna.rare-share"),
        ({"runs__seeds": [1, 2]}, "seed 2 is in both"),
        ({"runs__seeds": [1]}, "no shard has the seeds 3"),
        ({"arms": {}}, "model_free: not in both"),
    ],
)
def test_what_is_not_of_one_run_is_refused(shards, changes, said, tmp_path, capsys):
    other = edited(shards[1], tmp_path / "other", **changes)
    refused([shards[0], other], said, tmp_path, capsys)


def refused(folders, said, tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        merged(*folders, "--out", tmp_path / "record")
    captured = capsys.readouterr()
    assert stop.value.code == 2 and captured.out == ""
    assert said in captured.err and len(captured.err.splitlines()) == 1
    assert not (tmp_path / "record").exists()


def test_folders_are_refused_by_name(shards, tmp_path, capsys):
    empty = tmp_path / "empty"
    empty.mkdir()
    refused([shards[0], empty], f"{empty} has no results", tmp_path, capsys)
    refused([empty, shards[0]], f"{empty} has no results", tmp_path, capsys)
    refused([shards[0]], "no shard has the seeds 1, 3", tmp_path, capsys)
    refused([shards[0], shards[0].parent / "." / "1"], "each of them once", tmp_path, capsys)
    refused([], "each of them once", tmp_path, capsys)
    torn = edited(shards[1], tmp_path / "torn")
    (torn / "curves.npz").write_bytes((shards[1] / "curves.npz").read_bytes()[:-100])
    refused([shards[0], torn], "curves.npz is damaged", tmp_path, capsys)
    (torn / "curves.npz").unlink()
    refused([shards[0], torn], "curves.npz lacks model_free", tmp_path, capsys)
    begun = edited(shards[1], tmp_path / "begun")
    (begun / "checkpoints").mkdir()
    refused([shards[0], begun], f"{begun} is not finished", tmp_path, capsys)
    unknown = [
        edited(folder, tmp_path / folder.name, module="jaxdyna.experiments.catchy")
        for folder in shards
    ]
    refused(unknown, "the module jaxdyna.experiments.catchy, which cannot", tmp_path, capsys)
    refused([*shards, "--block", "2"], "--block", tmp_path, capsys)
    with pytest.raises(SystemExit):
        merged(*shards, "--out", shards[0])
    assert "is one of the shards" in capsys.readouterr().err
