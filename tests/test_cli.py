"""What a command line says, up to the first run."""

import contextlib
import importlib
import io
import subprocess
import sys
from dataclasses import replace

import pytest

from jaxdyna import fields
from jaxdyna.experiments import cartpole, catch
from jaxdyna.experiments.engine import Experiment, cli
from jaxdyna.experiments.engine.session import main, prepared

PROG = "python -m jaxdyna.experiments.it"
PARTS = [
    part
    for world in ("cartpole", "maze", "pong", "catch", "planning", "benchmark")
    for part in importlib.import_module(f"jaxdyna.experiments.{world}").PARTS
    if isinstance(part, Experiment)
]


def typed(leaf):
    """A flag with what is the setting's own already, as somebody types it."""
    value, flag = fields.plain(leaf.value), f"--{leaf.path.replace('_', '-')}"
    if isinstance(value, bool):
        return [flag if value else _no(flag)]
    return [flag, *map(str, value if isinstance(value, list) else [value])]


def _no(flag):
    *owners, name = flag.removeprefix("--").split(".")
    return "--" + ".".join([*owners, f"no-{name}"])


def test_another_broken_pipe_is_an_error():
    with pytest.raises(BrokenPipeError), cli.while_read():
        raise BrokenPipeError  # such as that of a process which makes a film


@pytest.mark.parametrize("command", ["merge", "cartpole"])
def test_a_command_ends_silently_where_nobody_reads_on(command):
    words = [sys.executable, "-m", f"jaxdyna.experiments.{command}", "--help"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as running:
        running.stdout.close()
        assert running.stderr.read() == b"" and running.wait() == 141


@pytest.mark.parametrize("part", PARTS, ids=lambda part: part.title)
def test_every_setting_that_help_shows_can_be_typed(part):
    default = next(iter(part.presets.values()))
    shown = cli._shown(default)
    words = [word for leaf in shown for word in typed(leaf)]
    assert shown and cli.parse(default, words, PROG) == default


def test_an_optimiser_is_typed_by_its_name(capsys):
    tuned = catch.CATCH.presets["tuned"]
    for words in (["--agent.optimizer", "adamw"], ["--agent.optimizer=adamw"]):
        assert cli.parse(tuned, words, PROG).agent.optimizer.__name__ == "adamw"
    with pytest.raises(SystemExit):
        main(*catch.PARTS, argv=["--preset", "tuned", "--agent.optimizer", "lion"], prog=PROG)
    assert "--agent.optimizer is lion" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (
            ["--agent.batchs", "3"],
            "--agent.batchs is the name of no setting: did you mean agent.ba",
        ),
        (["--hparams.env.catch-rewrd=3"], "did you mean hparams.env.catch-reward?"),
        (["--no-agent.doubl"], "--no-agent.doubl is the name of no setting"),
        (["--agent", "3"], "--agent is several settings: name one of them"),
        (["--part", "frames", "--preset", "tuned", "--seeds"], "--seeds"),
    ],
)
def test_what_is_misspelt_is_named(words, complaint, capsys):
    with pytest.raises(SystemExit) as stop:
        main(*catch.PARTS, argv=words, prog=PROG)
    said = capsys.readouterr().err
    assert stop.value.code == 2 and complaint in said and len(said.splitlines()) == 1


def shown(part, capsys, *words):
    with pytest.raises(SystemExit) as stop:
        prepared((part,), [*words, "--help"], PROG)
    assert stop.value.code == 0
    return capsys.readouterr().out


def test_help_lists_the_arms_and_what_is_left_open(capsys):
    said = shown(catch.CATCH, capsys)
    for arm in ("model_free", "dyna", "placebo", "oracle", "more_updates", "max_updates"):
        assert arm in said
    assert "--quick" in said and "--stop-after-solved  [0]" in said
    assert "--dyna.replay-capacity  [None]" in shown(catch.CATCH, capsys, "--help-all")
    assert max(map(len, shown(cartpole.LEVERS, capsys).splitlines())) <= 100


def test_quick_is_offered_where_it_changes_something(capsys):
    bare = replace(catch.CATCH, quick={})
    assert "--quick" not in shown(bare, capsys)
    with pytest.raises(ValueError, match="--quick: catch has none: lower --seeds and --episodes"):
        prepared((bare,), ["--quick"], PROG)


def test_every_shard_has_its_own_folder():
    folders = [
        prepared(catch.PARTS, [*shard, "--seeds", "4"], PROG).out
        for shard in ([], ["--shard", "1/2"], ["--shard", "2/2"])
    ]
    assert len(set(folders)) == 3 and folders[2] == folders[0] / "parts" / "2-of-2"


def test_swept_values_that_differ_have_names_that_do():
    words = ["--sweep", "hparams.agent.learning_rate=0.12345678,0.12345679,0.1"]
    session = prepared(catch.PARTS, words, PROG)
    names = {entry.name for entry in session.every if entry.arm == "dyna"}
    assert len(names) == 3 and "dyna@hparams.agent.learning_rate=0.1" in names


def test_a_row_is_described_by_its_own_settings_and_none_is_swept_over_them():
    words = ["--part", "levers", "--sweep", "dyna.model_updates=2,3"]
    rows = {entry.name: entry.options.dyna for entry in prepared(cartpole.PARTS, words, PROG).every}
    assert rows["N = 1@dyna.model_updates=3"].num_real_first == 1
    assert rows["N = 1@dyna.model_updates=3"].model_updates == 3
    words = ["--part", "levers", "--sweep", "dyna.num_real_first=2,50"]
    arms = {entry.arm for entry in prepared(cartpole.PARTS, words, PROG).every}
    assert "N = 1" not in arms and len(arms) > 3


@pytest.mark.parametrize("encoding", ["ascii", "cp1252", "utf-8"])
def test_a_terminal_need_not_have_every_sign(monkeypatch, encoding):
    """The help says §, which is not in ASCII, and ≥ is in tables, of which Latin-1 has none."""
    terminal = io.TextIOWrapper(io.BytesIO(), encoding)
    monkeypatch.setattr("sys.stdout", terminal)
    with contextlib.suppress(SystemExit):
        main(*catch.PARTS, argv=["--help"], prog=PROG)
    print("≥ 12", flush=True)
    said = terminal.buffer.getvalue().decode(encoding)
    assert "--episodes" in said
    assert said.endswith("≥ 12\n" if encoding == "utf-8" else "\\u2265 12\n")
