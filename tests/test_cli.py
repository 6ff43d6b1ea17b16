"""What ``--help-all`` shows is what the command line takes."""

import importlib

import pytest

from jaxdyna import fields
from jaxdyna.experiments.catch import CATCH
from jaxdyna.experiments.engine import Experiment, cli

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


@pytest.mark.parametrize("part", PARTS, ids=lambda part: part.title)
def test_every_setting_that_help_shows_can_be_typed(part):
    default = next(iter(part.presets.values()))
    shown = cli._shown(default)
    words = [word for leaf in shown for word in typed(leaf)]
    assert shown and cli.parse(default, words, PROG) == default


def test_an_optimiser_is_typed_by_its_name(capsys):
    catch = CATCH.presets["tuned"]
    for words in (["--agent.optimizer", "adamw"], ["--agent.optimizer=adamw"]):
        assert cli.parse(catch, words, PROG).agent.optimizer.__name__ == "adamw"
    with pytest.raises(SystemExit):
        cli.parse(catch, ["--agent.optimizer", "lion"], PROG)
    assert "--agent.optimizer is lion" in capsys.readouterr().err
