"""Every command line is either played or refused: with code 2 and one line that names the flag."""

import importlib
from functools import cache
from itertools import count
from pathlib import Path
from types import NoneType
from typing import get_args, get_origin

import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from jaxdyna import fields
from jaxdyna.experiments import merge, record
from jaxdyna.experiments.engine import Study, cli, main
from jaxdyna.experiments.engine.session import Session

TABLE = Path(__file__).with_name("data") / "refused.txt"
WORLDS = ("benchmark", "catch", "cartpole", "maze", "pong", "planning")
COMMANDS = {"merge": merge.main, "record": record.main}
UNIQUE = count()


@cache
def parts(world):
    return importlib.import_module(f"jaxdyna.experiments.{world}").PARTS


@pytest.fixture(scope="module")
def said(tmp_path_factory):
    """From a module and its arguments to the one line that refuses them, or "played": up to where
    the first run would be. What a flag is for is read out of no source: that takes long.
    """
    folder = tmp_path_factory.mktemp("command-lines")

    def said(capsys, world, *argv):
        out = ("--out", str(folder / str(next(UNIQUE))))
        try:
            if world in COMMANDS:
                COMMANDS[world](argv)
            elif any(word.startswith("--out") for word in argv):
                main(*parts(world), argv=argv, prog=world)
            else:
                main(*parts(world), argv=[*out, *argv], prog=world)
        except SystemExit as stop:
            printed = capsys.readouterr()
            [line] = printed.err.strip().splitlines()
            assert stop.code == 2 and printed.out == "", argv
            return line
        assert capsys.readouterr().err == "", argv
        return "played"

    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(Session, "run", lambda session: 0)
        patch.setattr("tyro._docstrings.get_field_docstring", lambda *_: None, raising=False)
        yield said


def outside(leaf, kinds):
    """Numbers just outside of a setting's range."""
    where, whole = leaf.range, float not in kinds
    step = 1 if whole else 0.5
    if where.low is not None:
        yield where.low if where.above else where.low - step
    if where.high is not None:
        yield where.high if where.below else where.high + step
    else:
        yield 2**31 if whole else 1e300


def wrong(leaf, number):
    """Words that are no value of a setting: just outside of its range, and two of another kind."""
    kinds = fields._union(leaf.hint)
    tuples = [kind for kind in kinds if get_origin(kind) is tuple]
    inner = {part for kind in tuples for part in get_args(kind)} or set(kinds)
    rest = map(str, leaf.value[1:] if tuples and Ellipsis not in inner else ())
    whole = float not in inner
    if bool in kinds:
        return [("yes",)]
    if not inner & {int, float}:
        return [] if inner & {str, Path} and not leaf.choices else [("nonsense",), ("",)]
    others = ["nonsense", "", "nan", "1e", "-inf", "1 2", "1,2", "0x", "True"]
    others += ["1.5", "1e3", "inf"] if whole else [] if leaf.range.infinite else ["1e999", "inf"]
    others += [] if NoneType in kinds else ["None"]
    chosen = [others[(number + more) % len(others)] for more in (0, 5)]
    rest = tuple(rest)
    return [(str(word), *rest) for word in (*outside(leaf, inner), *chosen)]


def declared():
    """``(module, words, what is to be named)``: every setting of every part once, at values that it
    cannot have.
    """
    known = set()
    for world in WORLDS:
        for part in parts(world):
            experiment = part.experiment() if isinstance(part, Study) else part
            for leaf in cli._shown(next(iter(experiment.presets.values()))):
                if (leaf.path, leaf.help) not in known:
                    known.add((leaf.path, leaf.help))
                    flag = f"--{leaf.path.replace('_', '-')}"
                    for words in wrong(leaf, len(known)):
                        named = flag if words != ("yes",) else "yes"
                        yield world, ("--part", part.name, flag, *words), named


def written():
    """Those of the table."""
    for line in TABLE.read_text().splitlines():
        if line and not line.startswith("#"):
            words, _, named = line.partition(" => ")
            world, *argv = words.split()
            yield world, tuple(argv), named


DECLARED = [*declared()]
TRIED = [*written(), *DECLARED[::2]]
"""The others are tried by the slow tests."""


def test_hundreds_of_lines_are_tried():
    assert len({line[:2] for line in TRIED}) == len(TRIED) >= 400


def unlike(lines, said, capsys):
    """The lines that are not refused by name, with what they are answered."""
    answers = [(said(capsys, world, *argv), world, *argv, named) for world, argv, named in lines]
    return [answer for answer in answers if answer[-1] not in answer[0]]


@pytest.mark.parametrize("world", [*WORLDS, *COMMANDS])
def test_what_cannot_be_is_refused_by_name(world, said, capsys):
    assert not unlike([line for line in TRIED if line[0] == world], said, capsys)


@pytest.mark.slow
def test_whatever_else_cannot_be_is_refused_by_name(said, capsys):
    assert not unlike(DECLARED[1::2], said, capsys)


CALLS = """--quick | --no-quick | --fresh | --resume | --shard 1/2 | --shard 2/1 | --bogus 1
| --seeds | word | -- | -x | --preset tuned | --preset lean | --preset nonsense | --arms dyna
| --arms | --arms model_free lean | --sweep = | --sweep seed=1
| --sweep hparams.agent.discount=0.5,1 | --episodes 4 | --dyna.num-real-first 2 | --shard 20/20"""


@cache
def flags(world):
    """What may be typed of each part: about the call, settings as they are, others. Not of parts
    that play something at once.
    """
    found = []
    for part in parts(world):
        if part.name in ("levers", "accuracy"):
            continue
        experiment = part.experiment() if isinstance(part, Study) else part
        usual, other = [], []
        for number, leaf in enumerate(cli._shown(next(iter(experiment.presets.values())))):
            flag, value = f"--{leaf.path.replace('_', '-')}", fields.plain(leaf.value)
            words = value if isinstance(value, list) else [value]
            usual += [(flag, *map(str, words))] * (not isinstance(value, bool))
            other += [(flag, "1"), (f"{flag}=2",), (flag, "0.5", "0.5"), (flag,)]
            other += [(flag, *words) for words in wrong(leaf, number)]
        calls = [tuple(call.split()) for call in CALLS.split("|")]
        found.append((part.name, [calls, usual, other]))
    return found


@given(data=st.data(), world=st.sampled_from(WORLDS))
@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_line_is_played_or_refused_in_one_line(data, world, said, capsys):
    part, pools = data.draw(st.sampled_from(flags(world)))
    pool = st.one_of(*map(st.sampled_from, pools))
    typed = data.draw(st.lists(pool, max_size=4))
    said(capsys, world, "--part", part, *(word for words in typed for word in words))
