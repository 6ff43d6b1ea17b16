"""``--sweep FIELD=V,V,...``: each row is the arm as it is when that value alone is played."""

import json

import jax
import numpy as np
import pytest
from pole import POLE

from jaxdyna.experiments.engine import InputError, main, memory, storage, work
from jaxdyna.experiments.report.tables import label

RATE, DREAMS = "hparams.agent.learning_rate", "dyna.dream_episodes"


@pytest.fixture(scope="module")
def play(tmp_path_factory):
    """Plays a command line, once each: ``results, curves, programs, folder``."""
    played = {}

    def one(*arguments):
        if arguments not in played:
            out = tmp_path_factory.mktemp("pole")
            programs = []
            with pytest.MonkeyPatch.context() as patch:
                build = work._Program.__init__
                patch.setattr(work._Program, "__init__", lambda *parts: (
                    programs.append(parts[1]), build(*parts))[1])  # fmt: skip
                argv = ["--seeds", "3", "--block", "2", *arguments, "--out", str(out)]
                assert main(POLE, argv=argv, prog="pole") == 0
            results = json.loads((out / "results.json").read_text())
            played[arguments] = results, np.load(out / "curves.npz"), programs, out
        return played[arguments]

    return one


def assert_rows_are(sweep, rows):
    """Each row of a sweep, bit for bit, is what its own command line plays."""
    results, curves, _, out = sweep
    assert list(results["arms"]) == list(rows)
    for name, (_, alone, _, _) in rows.items():
        for array in alone.files:
            own = f"{name}/{array.removeprefix('dyna/')}"
            np.testing.assert_array_equal(curves[own], alone[array], err_msg=own)
        arm, _, where = name.partition("@")
        assert (results["arms"][name]["arm"], results["arms"][name]["setting"]) == (arm, where)
    different = {curves[f"{name}/agent_loss"].tobytes() for name in rows}
    assert len(different) == len(rows)
    assert (out / "sweep.png").read_bytes().startswith(b"\x89PNG")
    text = (out / "report.md").read_text()
    assert "(sweep.png)" in text and all(f"| {label(name)} |" in text for name in rows)


def test_hyper_parameters_are_swept_in_one_program(play):
    sweep = play("--sweep", f"{RATE}=0.01,0.1")
    assert len(sweep[2]) == 1
    assert sweep[0]["sweep"] == {RATE: [0.01, 0.1]}
    assert list(sweep[0]["timing"]["arms"]) == ["dyna"]
    rows = {f"dyna@{RATE}={rate}": play(f"--{RATE}", str(rate)) for rate in (0.01, 0.1)}
    assert_rows_are(sweep, rows)


def test_from_plays_a_result_again(play):
    sweep = play("--sweep", f"{RATE}=0.01,0.1")
    again = play("--from", str(sweep[3] / "results.json"))
    for name in ("config", "sweep", "runs", "preset", "source"):
        assert again[0][name] == sweep[0][name]
    assert again[1].files == sweep[1].files
    for array in again[1].files:
        np.testing.assert_array_equal(again[1][array], sweep[1][array], err_msg=array)


@pytest.mark.parametrize(
    ("changes", "more", "said"),
    [
        ({}, ["--preset", "lean"], "--preset: --from says which"),
        ({}, ["--dyna.num-episodes", "7"], "--dyna.num-episodes is decided by --episodes"),
        ({}, ["--hparams.agent.learning-rate", "-1"], "--hparams.agent.learning-rate"),
        ({"experiment": "maze"}, [], "is a result of maze"),
        ({"config": {"episodes": -3}}, [], "episodes is -3"),
        ({"config": {"height": 3}}, [], "height"),
        (None, [], "there is no result"),
    ],
)
def test_from_is_refused_by_name(changes, more, said, play, tmp_path, capsys):
    results = play("--sweep", f"{RATE}=0.01,0.1")[0]
    if changes is not None:
        storage.write_json(tmp_path / "results.json", results | changes)
    argv = ["--from", str(tmp_path / "results.json"), *more, "--out", str(tmp_path / "out")]
    with pytest.raises(SystemExit, match="2"):
        main(POLE, argv=argv, prog="pole")
    line = capsys.readouterr().err.strip()
    assert said in line and "\n" not in line
    assert not (tmp_path / "out").exists()


def test_what_does_not_fit_into_memory_is_refused_before_it_is_compiled(
    play, tmp_path, capsys, monkeypatch
):
    """And leaves nothing in the way."""
    argv = ["--seeds", "4", "--block", "2", "--out", str(tmp_path / "out")]
    with monkeypatch.context() as patch, pytest.raises(SystemExit, match="2"):
        patch.setattr(memory, "available", lambda place: 10**4)
        patch.setattr(work._Program, "compile", None)
        main(POLE, argv=argv, prog="pole")
    line = capsys.readouterr().err.strip()
    assert "x 2 runs at a time take" in line and "0.0 GiB are free: lower --block" in line
    with pytest.raises(SystemExit, match="2"):
        main(POLE, argv=[*argv, "--arms", "nobody"], prog="pole")
    assert "nobody" in capsys.readouterr().err  # not: unfinished work


def test_memory_counts_every_array_and_whatever_is_known_to_be_free():
    tree = {"a": np.zeros((3, 4), np.float32), "b": np.zeros(5, np.uint8)}
    assert memory.held(tree, tree) == 2 * (48 + 5)
    place = jax.devices()[0]
    assert 0 < memory.available(place) < 2**50
    memory.afford(memory.available(place) // 3, 1, 2, place)
    with pytest.raises(InputError, match="2 x 7 runs at a time take"):
        memory.afford(memory.available(place), 7, 2, place)


def test_blocks_may_fill_half_of_what_is_free(monkeypatch):
    monkeypatch.setattr(memory, "available", lambda place: 100)
    assert [memory.spare(need, 8, None) for need in (0, 5, 10, 49, 51)] == [8, 8, 5, 1, 0]
    monkeypatch.setattr(memory, "available", lambda place: None)
    assert memory.spare(10, 8, None) == 8


@pytest.mark.slow
def test_what_decides_the_program_is_swept_in_several(play):
    """Bit for bit as alone: the next test says it of a grid."""
    sweep = play("--sweep", f"{DREAMS}=1,3")
    assert len(sweep[2]) == 2 and (sweep[3] / "sweep.png").exists()
    assert [arm["dreams"] for arm in sweep[0]["arms"].values()] == [1, 3]


@pytest.mark.slow  # of one field the others say so
@pytest.mark.parametrize("turned", [False, True])
def test_a_grid_is_every_value_with_every_other(play, turned):
    """As many programs as they need, in whichever order."""
    fields = [f"{RATE}=0.01,0.1", f"{DREAMS}=1,3"]
    grid = [(rate, count) for rate in (0.01, 0.1) for count in (1, 3)]
    if turned:
        fields, grid = fields[::-1], sorted(grid, key=lambda point: point[1])
    sweep = play(*(word for field in fields for word in ("--sweep", field)))
    assert len(sweep[2]) == 2

    def name(rate, count):
        parts = [f"{RATE}={rate}", f"{DREAMS}={count}"]
        return f"dyna@{','.join(parts[::-1] if turned else parts)}"

    alone = {
        point: play(f"--{RATE}", str(point[0]), f"--{DREAMS}", str(point[1])) for point in grid
    }
    assert_rows_are(sweep, {name(*point): alone[point] for point in grid})
    assert len(sweep[0]["timing"]["arms"]) == 2


def test_an_interrupted_sweep_is_reported_and_goes_on(tmp_path, capsys):
    """Ctrl-C between two programs: of the first value there is a table, and no figure yet."""
    argv = ["--seeds", "3", "--block", "2", "--sweep", f"{DREAMS}=1,3", "--out", str(tmp_path)]
    asked = []

    def stop(self, *rest):
        asked.append(rest)
        if len(asked) == 2:
            raise KeyboardInterrupt
        return playing(self, *rest)

    with pytest.MonkeyPatch.context() as patch:
        playing = work.Engine.play
        patch.setattr(work.Engine, "play", stop)
        assert main(POLE, argv=argv, prog="pole") == 130
    text = (tmp_path / "report.md").read_text()
    rows = [f"| {label(f'dyna@{DREAMS}={value}')} |" in text for value in (1, 3)]
    assert rows == [True, False]
    assert f"**Interrupted: dyna@{DREAMS}=3 not finished; --resume goes on.**" in text
    assert "Figures of solving have no interval" in text and f"| `{DREAMS}` | 1 3 |" in text
    lines = capsys.readouterr().out.splitlines()  # no terminal: a line a stage
    assert f"dyna@{DREAMS}=1: compiling" in lines
    assert main(POLE, argv=[*argv, "--resume"], prog="pole") == 0
    ours = storage.read_curves(tmp_path / "curves.npz")
    assert list(ours) == [f"dyna@{DREAMS}={value}" for value in (1, 3)]
    assert (tmp_path / "sweep.png").exists()
    assert "Interrupted" not in (tmp_path / "report.md").read_text()


@pytest.mark.parametrize(
    ("said", "complaint"),
    [
        *((f"{name}=1,2", f"{name} makes no sense") for name in (
            "seeds", "seed", "arms", "out", "episodes", "block", "stop_after_solved",
        )),
        ("learning_rate=0.1,0.2", "did you mean hparams.agent.learning_rate?"),
        ("hparams.agent.learning_rat=0.1,0.2", "did you mean hparams.agent.learning_rate?"),
        ("dyna.dream-episode=1,2", "did you mean dyna.dream_episodes?"),
        ("dyna=1,2", "name one setting of it"),
        ("dyna.num_episodes=1,2", "decided by --episodes"),
        ("window=2,3", "several rules"),
        ("hparams.agent.learning_rate", "FIELD=V,V,..."),
        ("hparams.agent.learning_rate=", "FIELD=V,V,..."),
        ("hparams.agent.learning_rate=0.1,0.1", "twice"),
        ("hparams.agent.learning_rate=0.1,-1", "at least 0"),
        ("hparams.agent.learning_rate=0.1,much", "is much: it must be a number"),
        ("dyna.dream_episodes=1,1.5", "is 1.5: it must be a whole number"),
    ],
)  # fmt: skip
def test_refused_by_name(said, complaint, tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        main(POLE, argv=["--sweep", said, "--out", str(tmp_path / "out")], prog="pole")
    captured = capsys.readouterr()
    assert stop.value.code == 2 and captured.out == ""
    assert complaint in captured.err and len(captured.err.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_a_field_twice_is_refused(tmp_path, capsys):
    argv = ["--sweep", f"{RATE}=0.1", "--sweep", f"{RATE}=0.2", "--out", str(tmp_path)]
    with pytest.raises(SystemExit):
        main(POLE, argv=argv, prog="pole")
    assert "twice" in capsys.readouterr().err
