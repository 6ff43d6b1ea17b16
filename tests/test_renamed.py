"""Recorded commands, and those in the texts, parse today, and to what was recorded."""

import json
import re
import shlex
import tomllib
from pathlib import Path

import pytest
from renamed import respelled, respelled_settings

from jaxdyna import fields
from jaxdyna.experiments.engine.distributed import taken
from jaxdyna.experiments.engine.record import command_of
from jaxdyna.experiments.engine.session import prepared

ROOT = Path(__file__).parents[1]
PROG = "python -m jaxdyna.experiments."
RECORDS = sorted((ROOT / "experiments").glob("*/results.json"))
PLANS = tomllib.loads((ROOT / "experiments" / "records.toml").read_text())
DIARIES = [ROOT / "experiments" / "README.md", ROOT / "docs" / "development-log.md"]
"""Their commands keep the spelling of their day."""
TEXTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
PAGES = sorted({*TEXTS, *DIARIES})
NO_EXPERIMENT = "(?:merge|record|evaluate|compare|any)"
"""Or experiments of worlds that need not be here: `test_any` parses these."""


def parsed(module, arguments):
    """The settings that a command line comes to."""
    parts, flags, prog = command_of(f"jaxdyna.experiments.{module}", *taken(arguments)[0])
    return prepared(parts, flags, prog).options


def commands(text):
    """Those of experiments in a text; a line's comment is none of it."""
    found = re.findall(rf"{PROG}(?!{NO_EXPERIMENT})((?:(?! && )[^`\n])+)", text)
    return [shlex.split(said, comments=True) for said in found]


@pytest.mark.parametrize("path", RECORDS, ids=lambda path: path.parent.name)
def test_a_recorded_command_parses_to_its_own_settings(path):
    if needs := PLANS.get(path.parent.name, {}).get("needs"):
        pytest.importorskip(needs)
    record = json.loads(path.read_text())
    said = [shlex.split(said.removeprefix(PROG)) for said in record["command"].split(" && ")]
    typed = [command for command in said if command[0] != "merge"]  # which puts shards together
    for command in typed:
        todays = "part" in record  # and whose preset `paper` is today's
        today = command if todays else respelled(command)
        assert today is not None, "a record whose command was cut goes too"
        options = parsed(today[0], today[1:])
        expected = respelled_settings(command, record["config"])
        expected |= {"preset": record["preset"]} if todays else {}
        arms = expected.pop("arms", None)
        if "--arms" in typed[-1] and command == typed[-1]:  # a resumed run may change them
            played = {arm.partition("@")[0] for arm in arms}  # of what is swept each setting
            assert set(fields.plain(options.arms)) <= {*arms, *played}
        for setting, value in expected.items():
            assert fields.plain(fields.value_at(options, setting)) == value, setting
    spell = (lambda command: command) if "part" in record else respelled
    today = [f"{PROG}{shlex.join(spell(command))}" for command in typed]
    if [shlex.split(said.removeprefix(PROG)) for said in today] != typed:
        said = f"Typed today: `{' && '.join(today)}`"
        assert said in path.with_name("report.md").read_text()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_a_command_in_a_text_parses(page):
    for command in commands(page.read_text()):
        today = respelled(command)
        assert today is not None
        again = "paper" in command  # was the name of another preset
        assert page in DIARIES or again or today == command, "spell it as today"
        today = today if page in DIARIES else command
        parsed(today[0], today[1:])


def test_commands_are_found_in_texts():
    text = (
        "`python -m jaxdyna.experiments.maze --part frames && python -m jaxdyna.experiments.pong`"
    )
    line = "\npython -m jaxdyna.experiments.maze --quick   # in 2 minutes, not --part frames"
    found = [["maze", "--part", "frames"], ["pong"], ["maze", "--quick"]]
    assert commands(f"{text}, then `python -m jaxdyna.experiments.merge A B`{line}") == found


def test_old_spellings_become_todays():
    def spelled(text):
        return shlex.join(respelled(shlex.split(text)) or ["cut"])

    for old, new in {
        "cartpole --preset paper --real-first 4 --no-rest-when-safe --terminal-share=0.5 --block 2":
        "cartpole --preset tuned --dyna.num-real-first 4 --no-rest-when-safe "
        "--dyna.rare-share 0.5 --block 2",
        "cartpole_accuracy --arms 'dyna (paper preset)' model-free":
        "cartpole --part accuracy --arms 'dyna (tuned preset)' model-free",
        "maze --part train --rare_share None --model paper":
        "maze --dyna.rare-share None --model paper",
        "pong --preset=paper --part=model --paper.updates 3 --steps 9 --stages 1 2":
        "pong --part frames --preset tuned --paper.updates 3 --steps 9 --stages 1 2",
        "pong --arms more_updates dyna": "pong --arms max_updates dyna",
        "pong_likeness --seed 1": "cut",
    }.items():  # fmt: skip
        assert spelled(old) == new
        assert new == "cut" or spelled(new) == new
