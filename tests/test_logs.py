"""The log of a run: what its curves say, once, whatever happens; and who else is told."""

import json
import shutil
import sys
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType

import jax
import numpy as np
import pytest
from parts import lines
from pole import PARTS
from test_engine import LEAVING_ARMS, MANY, PIECE, assert_same_runs, leaving, pieces

from jaxdyna.experiments.engine import checkpoint, main, progress, runs_of, shown
from jaxdyna.experiments.engine.checkpoint import Store
from jaxdyna.experiments.engine.progress import Log
from jaxdyna.experiments.engine.work import Engine

__all__ = ["leaving"]
WHO = [(str(number), seed) for number in range(len(LEAVING_ARMS)) for seed in MANY]
RUN = ["--arms", "model_free", "--seeds", "3", "--episodes", "12", "--threshold", "19",
       "--stop-after-solved", "0"]  # fmt: skip


@dataclass
class Recorder:
    """Any object with ``log(step, scalars)``."""

    run: Log | None = None
    told: list = field(default_factory=list)

    def log(self, step, scalars):
        self.told.append((step, dict(scalars)))


def expected(curves, units, piece, names):
    """What is told of a run that came to these curves."""
    end = len(curves[names[0]])
    for first in range(0, end, piece):
        part = {name: curves[name][first : first + piece].astype(np.float64) for name in names}
        finite = {name: values[np.isfinite(values)] for name, values in part.items()}
        yield min(first + piece, units), {n: one.mean() for n, one in finite.items() if one.size}


def recorders():
    """What is called at a run's first line, and the list that it fills."""
    told = []

    def recording(run):
        told.append(Recorder(run))
        return told[-1]

    return recording, told


def assert_told(told, wanted):
    assert [step for step, _ in told] == [step for step, _ in wanted]
    for (_, ours), (_, theirs) in zip(told, wanted, strict=True):
        assert ours == pytest.approx(theirs, rel=1e-6)


@pytest.mark.parametrize("workers", [1, 2])
def test_means_of_pieces_are_told_whoever_is_beside(leaving, workers):
    """Runs leave, break, have other last units, and are packed anew; their bits are the same."""
    alone, _, programs = leaving
    recorders = [Recorder() for _ in WHO]
    played, _ = pieces(LEAVING_ARMS, MANY, workers=workers, programs=programs, log=recorders)
    assert_same_runs(played, alone)
    names = ("total", "unit", "rare", "diverged")
    for recorder, ((number, _), curves) in zip(recorders, alone.items(), strict=True):
        wanted = list(expected(curves, LEAVING_ARMS[number].units, PIECE, names))
        assert_told(recorder.told, wanted)
    lacking = [step for recorder in recorders for step, said in recorder.told if "rare" not in said]
    assert lacking, "what is never finite is left out"


def logged(folder, programs, trackers=(), store=Store):
    """Plays and logs into a folder, going on with what is there."""
    (folder / "checkpoints").mkdir(parents=True, exist_ok=True)
    progress.gather([folder], folder)
    since = progress.logged(folder)
    log = [
        Log(folder / progress.LOG, *who, trackers=trackers, since=since.get(who, 0)) for who in WHO
    ]
    kept = store(folder / "checkpoints" / "arm")
    return pieces(LEAVING_ARMS, MANY, programs=programs, store=kept, log=log)[0]


def test_killed_anywhere_no_line_is_lost_or_doubled(leaving, tmp_path, monkeypatch):
    """Also in the middle of a line, before its end, and after others are told of it."""
    monkeypatch.setattr(checkpoint, "CHECKPOINT_SECONDS", 0.0)
    monkeypatch.setattr(checkpoint, "CHECKPOINT_SHARE", 1e9)
    alone, _, programs = leaving
    folder, random, left = tmp_path / "now", np.random.default_rng(0), []

    def killed(torn=""):
        if random.random() < 0.05 and len(left) < 4:
            left.append(Path(shutil.copytree(folder, tmp_path / str(len(left)))))
            with (left[-1] / progress.LOG).open("a") as file:
                file.write(torn[: len(torn) // (1 + len(left) % 2)])

    class Killing(Recorder):
        def log(self, step, scalars):
            who = {"arm": self.run.arm, "seed": self.run.seed, "step": step, "time": 2e9}
            killed(json.dumps(who | scalars))

    class Saving(Store):
        def save(self, *run):
            killed()
            super().save(*run)
            killed()

    logged(folder, programs, [Killing], Saving)
    whole = lines(folder)
    assert len(whole) > 80 and len(left) == 4
    for copy in left:
        progress.gather([copy], copy)
        known, (recording, told) = lines(copy), recorders()
        assert_same_runs(logged(copy, programs, [recording]), alone)
        assert lines(copy) == whole
        again = {(one.run.arm, one.run.seed, step) for one in told for step, _ in one.told}
        assert again and not again & known.keys()


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """A run's folder, and who was told."""
    out, (recording, told) = tmp_path_factory.mktemp("logs") / "out", recorders()
    assert play(out, log=[recording]) == 0
    return out, told


def play(out, *arguments, **rest):
    with jax.debug_key_reuse(False):  # which mistakes a cond over several runs for two uses
        return main(*PARTS, argv=[*RUN, *arguments, "--out", str(out)], prog="pole", **rest)


def test_the_file_is_always_there_and_says_what_curves_say(played):
    out, told = played
    curves, said = np.load(out / "curves.npz"), lines(out)
    names = ("real_return", "real_length", "agent_loss", "diverged")
    runs = [(one.run.path, one.run.arm, one.run.seed) for one in told]
    assert sorted(runs) == [(out / progress.LOG, "model_free", seed) for seed in range(3)]
    for one in told:
        seed = one.run.seed
        own = {name: curves[f"model_free/{name}"][seed] for name in names}
        end = int(np.isfinite(own["real_return"]).sum())
        cut = {name: values[:end] for name, values in own.items()}
        assert_told(one.told, list(expected(cut, 12, 2, names)))
        for step, scalars in one.told:
            line = {name: float(f"{value:.6g}") for name, value in scalars.items()}
            line |= {"arm": "model_free", "seed": seed, "step": step}
            assert said.pop(("model_free", seed, step)) == line
    assert not said


FAKE = """
import json, pathlib
class SummaryWriter:
    def __init__(self, logdir, purge_step=None):
        self.path = pathlib.Path(logdir, "events")
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.lines = [f"purge {purge_step}"] if purge_step else []
    def add_scalar(self, tag, value, step):
        self.lines.append(f"{tag} {step} {value:.6g}")
    def flush(self):
        with self.path.open("a") as file:
            print(*self.lines, sep="\\n", file=file)
        self.lines = []
    def close(self):
        self.lines.append("closed")
        self.flush()
"""


@pytest.fixture
def board(tmp_path, monkeypatch):
    """TensorBoard's package as far as it is called."""
    (tmp_path / "modules").mkdir()
    (tmp_path / "modules" / "tensorboardX.py").write_text(FAKE)
    monkeypatch.syspath_prepend(tmp_path / "modules")
    monkeypatch.delitem(sys.modules, "tensorboardX", raising=False)
    yield
    sys.modules.pop("tensorboardX", None)


def test_a_command_goes_on_with_its_log_and_with_tensorboard(board, played, tmp_path, monkeypatch):
    """Each run has a folder there; a crash comes between what TensorBoard and the log are told."""
    monkeypatch.setattr(progress, "TRACKED", 2)
    out, (recording, told) = tmp_path / "out", recorders()

    class Crashing(Recorder):
        def log(self, step, scalars):
            if step == 4:
                raise RuntimeError("crash")

    with pytest.raises(RuntimeError, match="crash"):
        play(out, "--log", "tensorboard", log=[Crashing])
    before = lines(out)
    assert before and all(step == 2 or seed == 2 for _, seed, step in before)
    assert play(out, "--log", "tensorboard", "--resume", log=[recording]) == 0
    said = lines(out)
    assert said == lines(played[0])
    assert {(one.run.arm, one.run.seed, step) for one in told for step, _ in one.told} == {
        run for run in said.keys() - before.keys() if run[1] < 2
    }
    assert {path.name for path in out.glob("tensorboard/model_free/*")} == {"0", "1"}
    for seed in (0, 1):
        shown = []
        events = out / "tensorboard" / "model_free" / str(seed) / "events"
        for line in events.read_text().splitlines():
            name, _, number = line.partition(" ")
            if name == "purge":
                shown = [one for one in shown if one[1] < int(number)]
            elif name != "closed":
                shown.append((name, int(number.split()[0]), number.split()[1]))
        assert name == "closed" and shown == [
            (name, step, f"{line[name]:.6g}") for (_, own, step), line in said.items()
            if own == seed for name in line if name not in ("arm", "seed", "step")
        ]  # fmt: skip


def test_what_the_log_does_not_know_is_purged(board, tmp_path):
    run = Log(tmp_path / progress.LOG, "dyna@a/b=1", 3, since=8)
    progress.tensorboard()(run).log(10, {"a": 1.0})
    progress.tensorboard()(run).log(10, {"a": 1.0})
    (path,) = tmp_path.glob("tensorboard/dyna@a%2Fb=1/3/events")
    assert path.read_text().splitlines() == ["a 10 1", "purge 9", "a 10 1"]


class Offline:
    """A run of wandb as far as it is called."""

    every = []

    def __init__(self, **how):
        self.how, self.told = how, []
        self.every.append(self)

    def log(self, data, step):
        self.told.append((step, data))

    def finish(self):
        self.told.append("finished")


def test_wandb_is_told_of_each_run(played, tmp_path, monkeypatch, capsys):
    """Where it knows no account, and is not offline, nothing is played."""
    package, known = ModuleType("wandb"), []
    package.Error, package.Settings, package.init = OSError, dict, Offline

    def login():
        if not known:
            raise package.Error("No API key configured.")

    package.login = login
    monkeypatch.setitem(sys.modules, "wandb", package)
    out = tmp_path / "out"
    with pytest.raises(SystemExit, match="2"):
        play(out, "--log", "wandb")
    said = "pole: error: --log wandb: No API key configured. WANDB_MODE=offline needs no account\n"
    assert capsys.readouterr().err == said and not out.exists()
    known.append("an account")
    monkeypatch.setattr(Offline, "every", [])
    assert play(out, "--log", "wandb") == 0
    runs = sorted(played[1], key=lambda one: one.run.seed)
    ours = sorted(Offline.every, key=lambda one: one.how["name"])
    for run, one in zip(runs, ours, strict=True):
        assert one.how["name"] == f"model_free {run.run.seed}" and one.how["dir"] == out
        assert one.how["config"]["episodes"] == 12
        assert one.told == [*run.told, "finished"]


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("tensorboard", "--log tensorboard needs tensorboardX: pip install 'jaxdyna[logging]'"),
        ("wandb", "--log wandb needs wandb: pip install 'jaxdyna[wandb]'"),
        ("mlflow", "--log mlflow: there are tensorboard, wandb"),
    ],
)
def test_who_is_missing_is_named_before_anything_is_played(
    name, said, tmp_path, capsys, monkeypatch
):
    for module in ("tensorboardX", "wandb"):
        monkeypatch.setitem(sys.modules, module, None)  # importing it fails
    with pytest.raises(SystemExit, match="2"):
        play(tmp_path / "out", "--log", name)
    assert capsys.readouterr().err == f"pole: error: {said}\n"
    assert not (tmp_path / "out").exists()


def test_there_is_a_logger_for_each_run(leaving):
    with pytest.raises(ValueError, match="log has 1 loggers for 22 runs: give one a run"):
        pieces(LEAVING_ARMS, MANY, programs=leaving[2], log=[Recorder()])


def test_progress_from_python(leaving, capsys):
    """Lines, where there is no terminal."""
    runs = runs_of(LEAVING_ARMS[:1], [0, 1], 0)
    with shown(runs, "mine") as say:
        Engine(workers=1, programs=leaving[2]).play(LEAVING_ARMS[0].work, runs, say=say)
    told = capsys.readouterr().out.splitlines()
    assert told[0].startswith("mine: 4 of 42, ") and "mine: done" in told


def test_tensorboard_reads_its_files(played, tmp_path):
    """Also where a process was killed after it had told TensorBoard what the log does not know."""
    pytest.importorskip("tensorboardX")
    reading = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    out = tmp_path / "out"
    assert play(out, "--log", "tensorboard") == 0
    for seed in range(3):
        run = Log(out / progress.LOG, "model_free", seed, since=4)
        for purged in (False, True):
            folder = out / "tensorboard" / "model_free" / str(seed)
            if purged:
                again = progress.tensorboard()(run)
                again.log(6, {"real_return": -1.0})
                again.close()
            events = reading.EventAccumulator(str(folder))
            events.Reload()
            found = [(one.step, one.value) for one in events.Scalars("real_return")]
            own = [line for line in lines(out).values() if line["seed"] == seed]
            wanted = [(line["step"], line["real_return"]) for line in own]
            if purged:
                wanted = [*(one for one in wanted if one[0] <= 4), (6, -1.0)]
            np.testing.assert_allclose(found, wanted, rtol=1e-5)
