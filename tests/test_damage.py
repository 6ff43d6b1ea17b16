"""What lies on the disk is damaged, lost or cannot be written: the same bits in the end, or one
line that says which file.
"""

import errno
import importlib
import json
import shutil
import signal
from functools import partial

import numpy as np
import pytest
from test_engine import (
    SEEDS,
    arm,
    assert_same_run,
    assert_same_runs,
    making,
    play,
    step,
    stopping_after,
)

from jaxdyna.experiments.engine import (
    Engine,
    Experiment,
    Options,
    checkpoint,
    main,
    session,
    storage,
    work,
)  # fmt: skip
from jaxdyna.experiments.engine.checkpoint import Store
from jaxdyna.experiments.engine.work import Interrupted
from jaxdyna.trees import difference

PLACES = 200
WORK = making(2)


def flipped(content, bit):
    changed = bytearray(content)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """Four runs that were interrupted with two checkpoints each, the programs, and whole runs."""
    store, engine = Store(tmp_path_factory.mktemp("store")), Engine(workers=1)
    whole = play(engine, [arm(WORK)], SEEDS[:4])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(checkpoint, "CHECKPOINT_SECONDS", 0.0)
        patch.setattr(checkpoint, "CHECKPOINT_SHARE", 1e9)
        stopped = Engine(workers=2, programs=engine.programs)
        with pytest.raises(Interrupted):
            play(stopped, [arm(WORK)], SEEDS[:4], stopping_after(stopped, 4), store=store)
    names = {path.name for path in store.folder.iterdir()}
    assert names == {f"run{n}{kind}.npz" for n in range(4) for kind in ("", ".before")}
    return store.folder, engine.programs, whole


def goes_on(saved, folder, damage):
    """Goes on in a copy of the folder that ``damage`` has changed; what was said of it."""
    original, programs, whole = saved
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(original, folder)
    damage(folder)
    said = []
    store = Store(folder, said.append)
    assert_same_runs(play(Engine(programs=programs), [arm(WORK)], SEEDS[:4], store=store), whole)
    return said


def test_a_flipped_bit_is_noticed_and_the_checkpoint_before_is_used(saved, tmp_path):
    """Whichever is used, the rest of the run is the same (`goes_on`)."""
    folder, noticed = tmp_path / original_name(saved), 0
    shutil.copytree(saved[0], folder)
    newest = folder / "run0.npz"
    content, whole = newest.read_bytes(), Store(folder).load(0)
    before = Store(folder)._read(folder / "run0.before.npz")
    assert whole.done > before.done > 0
    bits = np.random.default_rng(0).integers(0, 8 * len(content), PLACES)
    for bit in map(int, bits):
        newest.write_bytes(flipped(content, bit))
        said = []
        loaded = Store(folder, said.append).load(0)
        assert not difference(loaded.__dict__, (before if said else whole).__dict__)
        assert all("run0.npz is damaged" in line and "\n" not in line for line in said)
        noticed += bool(said)
    assert noticed > 0.7 * PLACES  # the rest: dates and padding of the file's own format
    said = goes_on(saved, folder, lambda at: (at / "run0.npz").write_bytes(flipped(content, 999)))
    assert len(said) == 1


def original_name(saved):
    """Checkpoints say whose they are by the name of their folder."""
    return saved[0].name


@pytest.mark.parametrize("kept", [0, 1, 100, 0.5, -1])
def test_a_checkpoint_that_was_cut(kept, saved, tmp_path):
    def cut(folder):
        content = (folder / "run1.npz").read_bytes()
        size = int(kept * len(content)) if kept == 0.5 else kept
        (folder / "run1.npz").write_bytes(content[:size])

    (said,) = goes_on(saved, tmp_path / original_name(saved), cut)
    assert "run1.npz is damaged" in said


def test_checkpoints_that_changed_places(saved, tmp_path):
    def exchanged(one, other, folder):
        (folder / one).rename(folder / "third")
        (folder / other).rename(folder / one)
        (folder / "third").rename(folder / other)

    again = partial(goes_on, saved, tmp_path / original_name(saved))
    assert again(partial(exchanged, "run0.npz", "run0.before.npz")) == []  # older, but whole
    said = again(partial(exchanged, "run0.npz", "run1.npz"))
    assert len(said) == 2 and all("is the checkpoint of" in line for line in said)


@pytest.mark.parametrize("lost", [["run0.npz"], ["run0.npz", "run0.before.npz"]])
def test_checkpoints_that_are_gone(lost, saved, tmp_path):
    def lose(folder):
        for name in lost:
            (folder / name).unlink()

    assert goes_on(saved, tmp_path / original_name(saved), lose) == []


def test_nothing_is_left_of_either(saved, tmp_path):
    def spoil(folder):
        for path in folder.iterdir():
            path.write_bytes(path.read_bytes()[:-30])

    assert len(goes_on(saved, tmp_path / original_name(saved), spoil)) == 8


# ---- the same from the command line


def slow_step(state, data, unit, hparams):
    return step(state, {"input": hparams["rate"]}, unit, hparams)


PLAIN = making(2, data=None, step=slow_step, judge=None, show=None)
ARMS = {"one": lambda: arm(PLAIN), "other": lambda: arm(PLAIN, 0.7, 2 * 11)}
TOY = Experiment("toy", "A toy", {"tuned": Options(seeds=4)}, lambda options: ARMS)


def command(out, *more):
    return main(TOY, argv=["--out", str(out), *more], prog="toy")


def curves(out):
    return storage.read_curves(out / "curves.npz")


def assert_same_curves(out, whole):
    ours = curves(out)
    assert ours.keys() == whole.keys()
    for name in whole:
        assert_same_run(ours[name], whole[name])


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    out = tmp_path_factory.mktemp("finished") / "toy"
    assert command(out) == 0
    return out


def ends(out, whole, capsys, *more):
    """The exit code of a resume, and what it said where that was an error of one line."""
    capsys.readouterr()
    try:
        assert command(out, *more, "--resume") == 0
    except SystemExit as stop:
        said = capsys.readouterr().err.strip()
        assert stop.code == 2 and "\n" not in said and str(out) in said
        return 2, said
    assert_same_curves(out, whole)
    return 0, ""


def texts(content):
    """Damages of a file."""
    bits = np.random.default_rng(1).integers(0, 8 * len(content), 12)
    cuts = [content[:size] for size in (0, 1, len(content) // 2, len(content) - 2)]
    return [b"[]", b"{}", b"null", *cuts, *(flipped(content, int(bit)) for bit in bits)]


@pytest.mark.parametrize("name", ["results.json", "curves.npz"])
def test_a_record_that_is_damaged(name, finished, tmp_path, capsys):
    whole, codes = curves(finished), []
    for number, text in enumerate(texts((finished / name).read_bytes())):
        out = tmp_path / str(number)
        shutil.copytree(finished, out)
        (out / name).write_bytes(text)
        code, said = ends(out, whole, capsys)
        codes.append(code)
        assert code == 0 or name in said or text == b"{}"
        assert code == 0 or (out / name).read_bytes() == text  # nothing else was touched
    assert codes.count(2) > len(codes) / 2


@pytest.mark.parametrize("name", ["results.json", "curves.npz", "report.md"])
def test_a_file_of_a_record_that_is_gone(name, finished, tmp_path, capsys):
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    (out / name).unlink()
    code, said = ends(out, curves(finished), capsys)
    assert (code, "nothing to resume" in said) == (
        (2, True) if name == "results.json" else (0, False)
    )
    assert code == 2 or (out / name).exists()


def interrupted(out, monkeypatch, pieces=5):
    """A run that Ctrl-C stops."""
    told, advance = [], work._Pool.tell

    def tell(pool, units):
        advance(pool, units)
        told.append(units)
        if len(told) == pieces:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(work._Pool, "tell", tell)
        patch.setattr(checkpoint, "CHECKPOINT_SECONDS", 0.0)
        patch.setattr(checkpoint, "CHECKPOINT_SHARE", 1e9)
        assert command(out) == 130


def test_settings_of_an_unfinished_run_that_are_damaged(finished, tmp_path, monkeypatch, capsys):
    begun = tmp_path / "begun"
    interrupted(begun, monkeypatch)
    path = begun / "checkpoints" / "settings.json"
    for number, text in enumerate(texts(path.read_bytes())):
        out = tmp_path / str(number)
        shutil.copytree(begun, out)
        (out / "checkpoints" / "settings.json").write_bytes(text)
        ends(out, curves(finished), capsys)


def test_the_curves_of_another_run_are_refused(finished, tmp_path, capsys):
    out, other = tmp_path / "out", tmp_path / "other"
    shutil.copytree(finished, out)
    assert command(other, "--seed", "5") == 0
    shutil.copy(other / "curves.npz", out / "curves.npz")
    code, said = ends(out, {}, capsys)
    assert code == 2 and "curves.npz is damaged (it is another run's than results.json)" in said


def test_checkpoints_without_their_settings_are_named(tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    interrupted(out, monkeypatch)
    (out / "checkpoints" / "settings.json").unlink()
    (out / "results.json").unlink(missing_ok=True)
    code, said = ends(out, {}, capsys)
    assert code == 2 and "settings.json is gone: restore it" in said


def test_what_the_user_keeps_among_checkpoints_stays(finished, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    interrupted(out, monkeypatch)
    (out / "checkpoints" / "notes.txt").write_text("the user's")
    assert ends(out, curves(finished), capsys) == (0, "")
    assert [path.name for path in (out / "checkpoints").iterdir()] == ["notes.txt"]


@pytest.mark.parametrize("lost", ["timing", "runs", "command", "config"])
def test_results_that_somebody_has_edited(lost, finished, tmp_path, capsys):
    """Without their checksum they may be."""
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    results = json.loads((out / "results.json").read_text())
    del results["checksum"], results[lost]
    (out / "results.json").write_text(json.dumps(results))
    code, said = ends(out, curves(finished), capsys)
    assert code == 2 and str(out) in said


def test_resume_and_fresh_exclude_each_other(tmp_path, capsys):
    assert "leave one out" in ends_with(tmp_path, capsys, "--resume", "--fresh")[1]


# ---- what a resumed run must have in common


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"source": "another"}, "with other code of jaxdyna or of the experiment"),
        ({"versions": {"jax": "0.0.1"}}, "with jax 0.0.1 (now "),
        ({"device": {"platform": "tpu", "x64": True}}, "platform tpu (now cpu), x64 True (now Fal"),
        ({"device": {"platform": "cpu", "x64": False, "threads": 99}}, "; NPROC=99 makes it so"),
        ({"source": None, "versions": None, "device": None}, "with other code"),
    ],
)
def test_a_run_that_was_begun_otherwise_is_not_gone_on_with(
    changes, said, finished, tmp_path, monkeypatch, capsys
):
    out = tmp_path / "out"
    interrupted(out, monkeypatch)
    path = out / "checkpoints" / "settings.json"
    before = storage.read_json(path)
    storage.write_json(path, before | changes)
    code, line = ends(out, {}, capsys)
    assert code == 2 and said in line and "--fresh" in line
    storage.write_json(path, before)
    assert ends(out, curves(finished), capsys) == (0, "")


def test_arms_of_other_code_are_told_apart(finished, tmp_path, capsys):
    out = tmp_path / "out"
    assert command(out, "--arms", "one") == 0
    assert "made_otherwise" not in storage.read_json(out / "results.json")
    results = storage.read_json(out / "results.json")
    storage.write_json(out / "results.json", results | {"source": "before"})
    assert ends(out, {"one": curves(finished)["one"]}, capsys, "--arms", "one")[0] == 0
    drawn = storage.read_json(out / "results.json")
    assert drawn["source"] == "before" and "made_otherwise" not in drawn
    assert command(out, "--arms", "one", "other", "--resume") == 0
    assert_same_curves(out, curves(finished))
    mixed = storage.read_json(out / "results.json")
    assert mixed["made_otherwise"]["one"]["source"] == "before" != mixed["source"]
    assert mixed["made_otherwise"].keys() == {"one"}
    assert "**one were played before, by other code" in (out / "report.md").read_text()


def test_time_is_right_after_a_kill(finished, tmp_path, monkeypatch):
    """Between two files of a record: the arm is known, and so is what it took."""
    out = tmp_path / "out"

    def killed(*written):
        raise ZeroDivisionError

    with monkeypatch.context() as patch, pytest.raises(ZeroDivisionError):
        patch.setattr(storage, "write_curves", killed)
        command(out)
    before = storage.read_json(out / "results.json")["timing"]
    assert command(out, "--resume") == 0
    assert_same_curves(out, curves(finished))
    after = storage.read_json(out / "results.json")["timing"]
    assert after["arms"].keys() == {"one", "other"} or len(after["arms"]) == 1
    assert after["total_s"] > before["total_s"]
    assert sum(one["run_s"] for one in after["arms"].values()) <= after["total_s"]


# ---- what cannot be written


def test_a_full_disk_ends_in_one_line_and_what_is_finished_is_kept(
    finished, tmp_path, monkeypatch, capsys
):
    out, save = tmp_path / "out", np.savez_compressed

    def full(file, **arrays):
        file.write(b"some")
        raise OSError(errno.ENOSPC, "No space left on device")

    assert command(out, "--arms", "one") == 0
    before = curves(out)
    monkeypatch.setattr(np, "savez_compressed", full)
    code, said = ends_with(out, capsys, "--arms", "one", "other", "--resume")
    assert code == 2 and "curves.npz (No space left on device)" in said and "--resume" in said
    assert_same_curves(out, before)
    assert not list(out.glob("*.part*"))  # room for others
    monkeypatch.setattr(np, "savez_compressed", save)
    assert command(out, "--arms", "one", "other", "--resume") == 0
    assert_same_curves(out, curves(finished))


def ends_with(out, capsys, *more):
    capsys.readouterr()
    with pytest.raises(SystemExit) as stop:
        command(out, *more)
    said = capsys.readouterr().err.strip()
    assert "\n" not in said
    return stop.value.code, said


def test_a_folder_that_goes_in_mid_run_is_not_made_again(tmp_path, monkeypatch, capsys):
    out, tell = tmp_path / "out", work._Pool.tell

    def vanish(pool, units):
        shutil.rmtree(out, ignore_errors=True)
        tell(pool, units)

    monkeypatch.setattr(work._Pool, "tell", vanish)
    code, said = ends_with(out, capsys)
    assert code == 2 and str(out) in said and "No such file" in said
    assert not out.exists()


def test_checkpoints_hold_no_pickle(saved):
    for path in saved[0].iterdir():
        with np.load(path, allow_pickle=False) as file:
            assert all(file[name].dtype != object for name in file.files)
            assert json.loads(str(file[checkpoint.ABOUT]))["done"] > 0


def test_the_code_is_the_packages_and_that_of_the_experiments_own_folder(tmp_path, monkeypatch):
    """A user's file, and what it imports from beside it; not what lies there unused."""
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "own_world.py").write_text("PAYS = 1")
    (tmp_path / "own_study.py").write_text("import own_world")
    (tmp_path / "own_notes.py").write_text("")
    importlib.import_module("own_study")
    before = storage.source(["own_study"])
    assert before == storage.source(["own_study"]) != storage.source()
    (tmp_path / "own_notes.py").write_text("# later")
    assert before == storage.source(["own_study"])
    (tmp_path / "own_world.py").write_text("PAYS = 2")
    assert before != storage.source(["own_study"])
    assert storage.source(["jaxdyna.experiments.catch.acting"]) == storage.source()
    assert storage.source(["builtins"]) == storage.source(["not a module"]) == storage.source()


@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_the_report_is_drawn(sent, finished, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        patch.setattr(session, "write_report", lambda *_: signal.raise_signal(sent))
        assert command(out) == 130
    assert "--resume makes the report" in " ".join(capsys.readouterr().out.split())
    assert not (out / "report.md").exists()
    assert command(out, "--resume") == 0
    assert (out / "report.md").exists()
    assert_same_curves(out, curves(finished))
