"""The folder of a run: nothing of the user's is touched, no result is lost, one run at a time."""

import json
import os
import subprocess
import sys

import pytest

from jaxdyna.experiments.engine.folders import claim, held

WHOSE = {"experiment": "catch", "part": "catch"}
REPORT = "# Catch\n\n![returns](returns.png)\n"


def tree(folder):
    """Every file's bytes, by its path."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def record(folder, number=1, **whose):
    folder.mkdir(exist_ok=True)
    results = WHOSE | {"config": {}, "number": number} | whose
    (folder / "results.json").write_text(json.dumps(results))
    (folder / "curves.npz").write_bytes(b"curves %d" % number)
    (folder / "report.md").write_text(REPORT)
    (folder / "returns.png").write_bytes(b"png %d" % number)
    (folder / "log.jsonl").write_text(f'{{"step": {number}}}\n')
    return tree(folder)


def unfinished(folder):
    (folder / "checkpoints" / "dyna").mkdir(parents=True)
    (folder / "checkpoints" / "settings.json").write_text(json.dumps(WHOSE | {"config": {}}))
    (folder / "checkpoints" / "dyna" / "run0.npz").write_bytes(b"hours")


def refused(folder, complaint, fresh=False, whose=None):
    before = tree(folder)
    with pytest.raises(ValueError, match=complaint):
        claim(folder, whose or WHOSE, fresh)
    assert tree(folder) == before


@pytest.mark.parametrize(
    "name", ["report.md", "checkpoints/model.pt", "previous/thesis.txt", "photo.png", ".config"]
)
def test_a_folder_of_the_users_is_left_alone(name, tmp_path):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("the user's")
    if name.startswith("previous"):
        claim(tmp_path, WHOSE, False)  # where earlier results are kept, beside it
        assert (tmp_path / name).read_text() == "the user's"
    else:
        refused(tmp_path, "of no such run", fresh=True)
    if name.startswith("checkpoints"):
        record(tmp_path)
        refused(tmp_path, "of no such run", fresh=True)


@pytest.mark.parametrize(
    "whose", [{"part": "frames"}, {"experiment": "maze", "part": "catch"}, {"experiment": None}]
)
def test_a_record_of_another_experiment_is_left_alone(whose, tmp_path):
    record(tmp_path, **whose)
    refused(tmp_path, "of no such run")


@pytest.mark.parametrize(
    "text", ['{"experiment": ', "[]", "null", '{"checksum": "0"}', "[" * 10**5]
)
def test_what_is_not_whole_is_left_alone(text, tmp_path):
    record(tmp_path)
    (tmp_path / "results.json").write_text(text)
    refused(tmp_path, "results.json is damaged")


def test_unfinished_work_goes_only_where_it_is_said(tmp_path):
    unfinished(tmp_path)
    refused(tmp_path, "--resume goes on with it, --fresh drops it")
    claim(tmp_path, WHOSE, fresh=True)
    assert tree(tmp_path) == {}


@pytest.mark.parametrize("left", [[], ["settings.part.json"]])
def test_killed_as_it_began_nothing_stands_in_the_way(left, tmp_path):
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / ".lock").write_text("process 7 on earth")
    for name in left:
        (tmp_path / "checkpoints" / name).write_text("{")
    claim(tmp_path, WHOSE, False)


def test_no_generation_is_lost_and_what_else_lies_there_stays(tmp_path):
    generations = []
    (tmp_path / "previous").mkdir()
    (tmp_path / "previous" / "notes.txt").write_text("the user's")
    for number in range(3):
        mine = record(tmp_path, number)
        generations.append({name: mine[name] for name in mine if "/" not in name})
        (tmp_path / "other.png").write_bytes(b"the user's")
        claim(tmp_path, WHOSE, False)
        assert {path.name for path in tmp_path.iterdir()} == {"previous", "other.png"}
        (tmp_path / "other.png").unlink()
    kept = sorted(path for path in (tmp_path / "previous").iterdir() if path.is_dir())
    assert [tree(folder) for folder in kept] == generations
    assert (tmp_path / "previous" / "notes.txt").read_text() == "the user's"


@pytest.mark.parametrize("moves", range(7))
def test_killed_between_any_two_moves_nothing_is_lost(moves, tmp_path, monkeypatch):
    """Five files and their folder's name: it dies before each of these six moves, or after."""
    from pathlib import Path  # noqa: PLC0415

    before, rename, done = record(tmp_path), Path.rename, []

    def dying(self, target):
        if len(done) == moves:
            raise KeyboardInterrupt
        done.append(target)
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", dying)
    if moves < 6:
        with pytest.raises(KeyboardInterrupt):
            claim(tmp_path, WHOSE, False)
    else:
        claim(tmp_path, WHOSE, False)
    monkeypatch.undo()
    claim(tmp_path, WHOSE, False)
    (kept,) = (tmp_path / "previous").iterdir()
    assert tree(kept) == before


def test_what_version_control_has_is_not_kept_aside(tmp_path):
    def git(*words):
        who = ["-c", "user.name=a", "-c", "user.email=a@example.org"]
        subprocess.run(["git", "-C", str(tmp_path), *who, *words], check=True, capture_output=True)

    record(tmp_path)
    git("init")
    git("add", "--", ":!log.jsonl")
    git("commit", "-m", "recorded")
    (tmp_path / "curves.npz").write_bytes(b"other")
    claim(tmp_path, WHOSE, False)  # not as it was committed
    assert len(list((tmp_path / "previous").iterdir())) == 1
    git("checkout", ".")
    (tmp_path / "log.jsonl").write_text("{}")
    claim(tmp_path, WHOSE, False)
    assert len(list((tmp_path / "previous").iterdir())) == 1
    assert not {"results.json", "log.jsonl"} & {path.name for path in tmp_path.iterdir()}


HOLD = """
import sys, time
from pathlib import Path
from jaxdyna.experiments.engine.folders import held
with held(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def test_one_run_at_a_time_and_kill_lets_go(tmp_path):
    command = [sys.executable, "-c", HOLD, str(tmp_path / "out")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "held\n"
        with pytest.raises(ValueError, match=f"in use by process {process.pid} on "):
            held(tmp_path / "out").__enter__()
        process.kill()
    with held(tmp_path / "out"):
        assert f"process {os.getpid()}" in (tmp_path / "out" / ".lock").read_text()
    assert not (tmp_path / "out" / ".lock").exists()


@pytest.mark.skipif(os.geteuid() == 0, reason="the superuser may write anywhere")
def test_a_folder_that_cannot_be_written_to(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(ValueError, match="choose another folder"):
        held(tmp_path / "out").__enter__()


def test_a_file_is_no_folder(tmp_path):
    (tmp_path / "out").write_text("")
    with pytest.raises(ValueError, match="choose another folder"):
        held(tmp_path / "out").__enter__()
