"""The lab book holds what its tables say, and what is stale in it is told by why."""

import json
import re
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import chex
import numpy as np
import pytest

from jaxdyna.experiments import record
from jaxdyna.experiments.engine import storage
from jaxdyna.experiments.engine.experiment import chosen
from jaxdyna.experiments.record import BOOK, Plan, State
from jaxdyna.statistics import ratio_of_means, summarise

ALL = record.read_plans(BOOK)
PLANS = {name: plan for name, plan in ALL.items() if plan.playable}
RECORDED = [path.parent.name for path in sorted(BOOK.glob("*/results.json"))]
SEEDS, PRIMARY = (tomllib.loads((BOOK / f"{name}.toml").read_text())
                  for name in ("seeds", "primary"))  # fmt: skip
TINY = "cartpole --seeds 2 --seed 3 --episodes 110 --arms model_free"


def seed_of(plan):
    said = re.search(r"--seed (\d+)", plan.command)
    return int(said[1]) if said else plan.session.options.seed


@pytest.mark.parametrize("name", PLANS)
def test_a_command_of_the_lab_book_resolves_today(name):
    session = PLANS[name].session
    assert chosen(session.every, session.options.arms) or session.experiment.measures
    assert "--out" not in PLANS[name].command and "--resume" not in PLANS[name].command


def test_a_record_whose_world_is_not_installed_is_left_out(tmp_path, capsys):
    for table in record.TABLES:
        (tmp_path / table).write_text((BOOK / table).read_text())
    with (tmp_path / "records.toml").open("a") as file:
        file.write('[far]\nasks = "?"\ncommand = "any --env gymnasium:Far-v0"\nneeds = "farther"\n')
    assert record.main(["--list", "--book", str(tmp_path)]) == 0
    assert "far is left out: farther is not installed\n" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="2"):
        record.main(["far", "--book", str(tmp_path)])
    assert "far needs farther: install it" in capsys.readouterr().err


def test_every_folder_is_a_record_and_every_record_a_folder_or_planned():
    assert set(RECORDED) <= ALL.keys()
    for name in ALL.keys() - set(RECORDED):
        assert ALL[name].hours, f"{name} is planned: guess its hours"


def test_the_index_of_the_lab_book_is_its_table():
    rows = [f"| [{plan.name}]({plan.name}/report.md) | {plan.asks} | {seed_of(plan)} |"
            for plan in ALL.values() if plan.name in RECORDED]  # fmt: skip
    index = "\n".join(["| folder | question | base seed |", "| --- | --- | --- |", *rows])
    assert f"## Index\n\n{index}\n\n" in (BOOK / "README.md").read_text(), index


def test_every_base_seed_of_a_record_is_listed():
    lines = {(said["seed"], said["by"]): said["looked_at"] for said in SEEDS["seeds"]}
    assert len(lines) == len(SEEDS["seeds"])
    for name, plan in ALL.items():
        assert lines[seed_of(plan), name] == (name in RECORDED)


def test_primary_comparisons_are_what_their_records_play():
    named = {said["record"] for said in PRIMARY["comparisons"]}
    assert len(PRIMARY["comparisons"]) <= 8 and named <= PLANS.keys()
    for said in PRIMARY["comparisons"]:
        if said["record"] in PLANS:
            plan = PLANS[said["record"]]
            options = plan.session.options
            planned = said["seed"], said["runs"], said["budget"]
            assert planned == (options.seed, options.seeds, options.episodes)
            assert set(said["arms"]) <= set(options.arms)
            record.check_seed(plan, BOOK)


def tables(book, command=TINY, seeds=(), comparisons=()):
    """A lab book of two records, one of which builds on the other."""
    book.mkdir(exist_ok=True)
    (book / "records.toml").write_text(
        f'[tiny]\nasks = "Is it quick?"\ncommand = "{command}"\nhours = 0.01\n'
        f'[later]\nasks = "And then?"\ncommand = "{TINY}"\nbuilds_on = ["tiny"]\n'
    )
    for name, lines in (("seeds", seeds), ("comparisons", comparisons)):
        file = book / {"seeds": "seeds.toml", "comparisons": "primary.toml"}[name]
        file.write_text(f'test = "a test"\n{name} = [{", ".join(lines)}]\n')
    return book


def state(book, name="tiny"):
    plans = record.read_plans(book)
    return State.of(plans[name], plans, book)


def call(book, *words):
    return record.main([*words, "--book", str(book), "--unclean"])


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """Recorded in two shards, the first call of which leaves one to be played."""
    book = tables(tmp_path_factory.mktemp("book"))
    assert call(book, "tiny", "--shard", "2/2") == 0
    assert str(state(book)) == record.MISSING
    assert call(book, "tiny", "--shard", "1/2") == 0
    return book


@pytest.fixture
def book(played, tmp_path):
    """A copy of it."""
    folder = tables(tmp_path / "book")
    for file in ("results.json", "curves.npz", "report.md"):
        (folder / "tiny").mkdir(exist_ok=True)
        (folder / "tiny" / file).write_bytes((played / "tiny" / file).read_bytes())
    return folder


def edit(book, name="tiny", **changes):
    path = book / name / "results.json"
    storage.write_json(path, storage.read_json(path) | changes)


def test_a_record_is_made_in_shards_and_merged(played, capfd):
    assert str(state(played)) == "as today"
    results = storage.read_json(played / "tiny" / "results.json")
    assert results["runs"]["seeds"] == [0, 1] and results["timing"]["shards"] == 2
    assert (played / "tiny" / "parts" / "2-of-2" / "results.json").exists()
    assert call(played, "tiny", "--shard", "1/2") == 0
    assert call(played, "tiny") == 0
    told = capfd.readouterr().out
    assert "$" not in told and told.count("tiny: as today, nothing to play\n") == 1
    assert told.count("1-of-2: as today, nothing to play\n") == 1
    assert call(played) == 0
    told = capfd.readouterr().out
    assert "as today" in told and "builds on" not in told and record.MISSING in told


def test_what_is_stale_is_told_by_why(book):
    command = "cartpole --seeds 2 --seed 3 --episodes 111"
    tables(book, f"{command} --arms model_free dyna --hparams.agent.learning-rate 0.5")
    said = "other settings (--episodes, --dyna.num-episodes, --hparams.agent.learning-rate, --arms)"
    assert sorted(str(state(book)).split(", ")) == sorted(said.split(", "))
    tables(book, f"{TINY} --sweep hparams.agent.learning_rate=0.01,0.02")
    assert str(state(book)).startswith("other settings (--sweep")
    tables(book, TINY.replace("cartpole", "cartpole --preset lean"))
    assert "--preset" in str(state(book))
    tables(book)
    assert str(state(book, "later")) == record.MISSING
    results = storage.read_json(book / "tiny" / "results.json")
    edit(book, source="0123")
    assert str(state(book)) == record.OTHER_CODE and not state(book).stale
    edit(book, versions=results["versions"] | {"jax": "0.0"}, source=results["source"])
    assert str(state(book)) == record.OTHER_CODE
    edit(book, config=results["config"] | {"env_version": "v9"}, versions=results["versions"])
    assert str(state(book)).startswith("other settings (") and "v9" in str(state(book))
    edit(book, runs=results["runs"] | {"shard": [1, 2]}, config=results["config"])
    assert str(state(book)) == "other settings (--shard)"
    edit(book, runs=results["runs"])
    assert str(state(book)) == "as today"
    (book / "tiny" / "checkpoints").mkdir()
    assert str(state(book)) == record.UNFINISHED
    (book / "tiny" / "checkpoints").rmdir()
    older = {name: value for name, value in results.items() if name != "part"}
    (book / "tiny" / "results.json").write_text(json.dumps(older))
    assert str(state(book)) == record.OLDER


def test_what_builds_on_a_stale_record_is_stale(book):
    (book / "tiny").rename(book / "later")
    assert str(state(book, "later")) == "builds on tiny"


def test_reports_are_drawn_anew_from_curves(book, capsys):
    results = (book / "tiny" / "results.json").read_bytes()
    (report := book / "tiny" / "report.md").write_text("")
    assert record.main(["--redraw", "--book", str(book)]) == 0
    assert capsys.readouterr().out == "tiny: drawn\nlater: not drawn (not recorded yet)\n"
    assert (book / "tiny" / "results.json").read_bytes() == results
    figures = {path.name for path in report.parent.glob("*.png")}
    assert figures and all(f"]({figure})" in report.read_text() for figure in figures)


def test_drawn_anew_by_later_settings_results_and_curves_are_of_the_same_run(book):
    folder = book / "tiny"
    results = json.loads((folder / "results.json").read_text())
    del results["checksum"], results["config"]["dyna"]["eval_every"]  # as of before there was one
    curves = storage.read_curves(folder / "curves.npz")
    storage.write_json(folder / "results.json", results)
    storage.write_curves(folder / "curves.npz", curves, storage.identity(results))
    for _ in range(2):
        assert record.main(["--redraw", "tiny", "--book", str(book)]) == 0
        results = storage.read_json(folder / "results.json")
        assert "eval_every" in results["config"]["dyna"]
        again = storage.read_curves(folder / "curves.npz", storage.identity(results))
        chex.assert_trees_all_equal(again, curves)


@pytest.mark.parametrize("name", RECORDED)
def test_curves_are_those_of_their_results(name):
    results = storage.read_json(BOOK / name / "results.json")
    if "part" in results:  # of today's format
        curves = storage.read_curves(BOOK / name / "curves.npz", storage.identity(results))
        assert curves.keys() == results["arms"].keys()


@pytest.fixture
def commands(monkeypatch):
    """What would be run."""
    ran = []
    monkeypatch.setattr(record, "_run", lambda *words: ran.append(words) or 0)
    return ran


def test_unfinished_work_is_gone_on_with_or_dropped(book, commands, monkeypatch):
    (book / "tiny" / "checkpoints").mkdir()
    monkeypatch.chdir(book.parent)
    call(book, "tiny")
    call(book, "tiny", "--fresh")
    call(book, "tiny", "--out", "elsewhere", "--shard", "1/2")
    out = ("--keep-runs", "0", "--out", "book/tiny")  # they name no folder above this one
    asked = (*TINY.split(),)
    assert commands == [
        (*asked, "--resume", *out), (*asked, "--fresh", *out),
        (*asked, "--shard", "1/2", *out[:3], "elsewhere/tiny/parts/1-of-2"),
    ]  # fmt: skip


def refused(book, capsys, *words):
    with pytest.raises(SystemExit) as stop:
        record.main([*words, "--book", str(book)])
    assert stop.value.code == 2
    [line] = capsys.readouterr().err.splitlines()
    return line


@pytest.mark.parametrize("commit", [None, {"id": "0123", "clean": False}])
def test_what_no_commit_names_is_not_recorded(commit, tmp_path, commands, capsys, monkeypatch):
    monkeypatch.setattr(storage, "commit", lambda: commit)
    book = tables(tmp_path / "book")
    assert "commit them, or add --unclean" in refused(book, capsys, "tiny") and not commands
    monkeypatch.setattr(storage, "commit", lambda: {"id": "0123", "clean": True})
    assert record.main(["tiny", "--book", str(book)]) == 0 and len(commands) == 1
    for words in (["init", "-q"], ["status"]):
        subprocess.run(["git", "-C", str(book), *words], check=True, capture_output=True)
    assert "commit them" in refused(book, capsys, "tiny")  # the tables are in no commit


def test_a_seed_that_was_looked_at_confirms_nothing(tmp_path, commands, capsys):
    def line(by, looked_at, seed=3):
        return (f'{{seed = {seed}, date = 2026-11-29, commit = "0123", by = "{by}", '
                f"looked_at = {looked_at}}}")  # fmt: skip

    compared = ['{record = "tiny"}']
    for seeds in ([line("other", "false")], [line("tiny", "true")], [line("other", "true", 4)]):
        assert call(tables(tmp_path / "book", TINY, seeds, compared), "tiny") == 0
    book = tables(tmp_path / "book", TINY, [line("other", "true")], compared)
    told = refused(book, capsys, "tiny", "--unclean")
    assert "seed 3 was looked at by other on 2026-11-29" in told
    assert call(book, "later") == 0 and len(commands) == 4  # explores


def test_names_and_tables_are_refused_by_name(tmp_path, capsys):
    book = tables(tmp_path / "book", "cartpole_levers --seed 7")
    assert "there are tiny, later" in refused(book, capsys, "tinny")
    assert "no such experiment: python -m jaxdyna.experiments.cartpole_levers" in refused(
        book, capsys, "--list"
    )
    assert "--episods" in refused(tables(book, f"{TINY} --episods 3"), capsys, "--list")
    (book / "records.toml").write_text('[tiny]\nasks = "?"\ncommand = "catch"\nour = 3\n')
    assert "our" in refused(book, capsys)
    (book / "records.toml").write_text(
        '[tiny]\nasks = "?"\ncommand = "catch"\nbuilds_on = ["tiny"]\n'
    )
    assert "tiny builds on tiny: no record above it" in refused(book, capsys)
    (book / "records.toml").write_text("[tiny]\nasks = ?\n")
    assert "no table of a lab book" in refused(book, capsys)


def test_primary_comparisons_by_hand(tmp_path):
    def line(name, n=6, seed=3):
        return (f'{{record = "{name}", arms = ["dyna", "model_free"], measure = "episodes_to_solve"'
                f", runs = {n}, budget = 100, seed = {seed}}}")  # fmt: skip

    dyna, free = np.array([30.0, 32, 35, 31, 36, 40]), np.array([60.0, 80, np.inf, 70, 75, 66])
    arms = {
        name: {"episodes_to_solve": summarise(values, at_least=100.0)}
        for name, values in (("dyna", dyna), ("model_free", free))
    }
    (tmp_path / "book" / "tiny").mkdir(parents=True)
    runs, config = {"seeds": list(range(6)), "of": 6}, {"seed": 3, "episodes": 100}
    path = tmp_path / "book" / "tiny" / "results.json"
    storage.write_json(path, {"arms": arms, "runs": runs, "config": config})
    planned = [line("tiny"), line("tiny", n=7), line("tiny", seed=4), line("later")]
    book = tables(tmp_path / "book", TINY, (), planned)
    told = record.primary(book, book)
    ratio = ratio_of_means(dyna, np.where(np.isfinite(free), free, 100.0))
    low, high = ratio["ci95"]
    said = f"{34 / (451 / 6):.2f} ({low:.2f} to {high:.2f}) | {ratio['p']:.4f}"
    assert f"| {said} | {4 * ratio['p']:.4f} |" in told  # of four, three of which count as 1
    assert told.count(record.MISSING) == 3 and told.endswith("a test")


def test_hours_are_the_records_own_where_there_is_one():
    plan = Plan("tiny", "?", TINY, hours=2.0)
    assert record.cost(plan, None) == 2.0
    assert record.cost(plan, {"timing": {"total_s": 1800}}) == 0.5


def test_an_interruption_says_how_to_go_on(tmp_path):
    long = TINY.replace("110", "100000") + " --stop-after-solved None"
    book = tables(tmp_path / "book", long)
    asked = ["tiny", "--book", str(book), "--unclean", "--fresh"]
    words = [sys.executable, "-m", "jaxdyna.experiments.record", *asked]
    root = Path(record.__file__).parents[2]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True, cwd=root) as running:
        begun = book / "tiny" / "checkpoints" / "settings.json"
        while not begun.exists() and running.poll() is None:
            time.sleep(0.1)
        time.sleep(1)
        running.send_signal(signal.SIGINT)
        told, _ = running.communicate(timeout=120)
    assert running.returncode == 130, told
    assert f"tiny was interrupted: `{record.PROG} tiny --book {book} --unclean` goes on" in told
    assert str(state(book)) == record.UNFINISHED
