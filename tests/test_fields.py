import importlib
import json
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import NoneType
from typing import Any, Literal, NamedTuple, get_args, get_origin

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import struct
from hypothesis import assume, given, settings, strategies as st

from jaxdyna import agents, envs, models, planners
from jaxdyna.agents.cloning import margin_loss
from jaxdyna.agents.reinforce import per_step
from jaxdyna.dyna import DynaConfig, DynaHParams
from jaxdyna.envs.pong_screen import CHANNELS
from jaxdyna.experiments.engine import Study
from jaxdyna.fields import (
    LARGEST,
    MOST,
    SettingError,
    _union,
    changed,
    check,
    leaves,
    plain,
    restored,
    setting,
    value_at,
)
from jaxdyna.losses import PixelLoss, l1
from jaxdyna.models.adversarial import gan_adam
from jaxdyna.networks import EncoderDecoder, GlimpseQ, JointReward, Resolution
from jaxdyna.statistics import SolveRule


class Pair(NamedTuple):
    left: tuple[int, int] = (1, 2)
    right: int = 3


def twice(x):
    return 2 * x


def thrice(x):
    return 3 * x


@struct.dataclass
class Rates:
    rate: float = setting(0.1, "Of a step.", at_least=0, everyday=True)
    limit: float | jax.Array = setting(math.inf, "Where it ends.", above=0, infinite=True)


@dataclass(frozen=True)
class Inner:
    count: int = setting(3, "How many.", at_least=1)
    widths: tuple[int, ...] = setting((8,), "Of layers.", at_least=1)
    share: float | None = setting(None, "Of all.", at_least=0, below=1)
    rule: Callable[[Any], Any] = setting(twice, "What is done.", choices=(twice, thrice))

    def __post_init__(self):
        check(self)
        if self.count > 99:
            raise SettingError("count", "is too much")


@dataclass(frozen=True)
class Outer:
    inner: Inner = setting(factory=Inner)
    rates: Rates = setting(factory=Rates)
    out: Path | None = setting(None, "A folder.")
    arms: tuple[str, ...] = setting(("a",), "Who plays.", choices=("a", "b"))
    version: Literal["v0", "v1"] = setting("v0", "Which.")
    pair: Pair = setting(Pair(), "A pair.")
    groups: tuple[tuple[int, ...], ...] = setting(((0,), (1, 2)), "Groups.", at_least=0)
    extra: tuple[str, ...] = setting((), "May be left out.")
    fast: bool = setting(False, "Hurry.")
    network: Any = setting(None, "Any module.")
    cell: tuple[int, int] | None = setting(None, "A place.")

    def __post_init__(self):
        check(self)


OUTER = Outer()


@pytest.mark.parametrize(
    ("path", "value", "complaint"),
    [
        ("inner.count", 0, "inner.count is 0: it must be at least 1"),
        ("inner.count", 2.5, "inner.count is 2.5: it must be a whole number"),
        ("inner.count", 3.0, "a whole number"),
        ("inner.count", True, "a whole number"),
        ("inner.count", math.inf, "a whole number"),
        ("inner.count", "3", "a whole number"),
        ("inner.count", None, "a whole number"),
        ("inner.count", np.float32(2.5), "a whole number"),
        ("inner.count", np.int64(0), "at least 1"),
        ("inner.count", 10**400, "inner.count is 1000"),
        ("inner.count", 2**31, "at most 2147483647"),
        ("inner.count", 100, "inner.count is too much"),
        ("inner.widths", (8, 0), r"inner.widths is \(8, 0\): it must be at least 1"),
        ("inner.widths", (8.5,), r"a tuple \(a whole number, \.\.\.\)"),
        ("inner.widths", [8], "a tuple"),
        ("inner.widths", 8, "a tuple"),
        ("inner.widths", (), r"inner.widths is \(\): it must not be empty"),
        ("inner.share", 1, "inner.share is 1: it must be at least 0 and below 1, or None"),
        ("inner.share", math.nan, "at least 0 and below 1"),
        ("inner.share", "half", "a number or None"),
        ("inner.rule", "thrice", "inner.rule is thrice: it must be one of twice, thrice"),
        ("inner.rule", 3, "a function"),
        ("rates.rate", -0.1, "rates.rate is -0.1: it must be at least 0"),
        ("rates.rate", math.inf, "at least 0"),
        ("rates.rate", 1e300, r"rates.rate is 1e\+300: it must be at most 3.4e\+38"),
        ("rates.rate", jnp.array([2.0, -1.0]), "it must be at least 0"),
        ("rates.rate", np.array([2.0, math.nan]), "it must be at least 0"),
        ("rates.limit", 0, "rates.limit is 0: it must be above 0"),
        ("rates.limit", math.nan, "above 0"),
        ("arms", ("a", "c"), "one of a, b"),
        ("arms", (), "must not be empty"),
        ("version", "v2", "version is v2: it must be v0 or v1"),
        ("groups", ((0,), (1, -2)), "at least 0"),
        ("groups", (0, 1), "a tuple"),
        ("fast", 2, "fast is 2: it must be True or False"),
        ("cell", (1, 2, 3), r"a tuple \(a whole number, a whole number\) or None"),
    ],
)
def test_what_cannot_be_is_named_with_what_can(path, value, complaint):
    with pytest.raises(SettingError, match=complaint) as caught:
        changed(OUTER, {path: value})
    assert caught.value.path == path
    assert str(caught.value) == f"{path} {caught.value.said}"


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("inner.count", np.int32(7)),
        ("inner.widths", (1, 2, 3)),
        ("inner.share", 0),
        ("inner.share", 0.999),
        ("inner.rule", lambda x: x),
        ("inner.rule", partial(thrice, 3)),
        ("rates.rate", 1),
        ("rates.limit", math.inf),
        ("rates.rate", jnp.array([0.0, 2.0])),
        ("rates.limit", np.ones(3)),
        ("extra", ()),
        ("out", Path("runs")),
        ("cell", (1, 2)),
        ("network", "anything"),
        ("fast", np.bool_(True)),
    ],
)
def test_what_can_be_passes(path, value):
    assert value_at(changed(OUTER, {path: value}), path) is value


def test_tracers_pass():
    @jax.jit
    def traced(rate):
        check(changed(OUTER, {"rates.rate": rate}))
        return rate

    traced(-1.0)


def test_declared_once():
    known = {leaf.path: leaf for leaf in leaves(OUTER)}
    assert [*known][:5] == [
        "inner.count",
        "inner.widths",
        "inner.share",
        "inner.rule",
        "rates.rate",
    ]
    rate = known["rates.rate"]
    assert (rate.value, rate.help, rate.everyday, rate.hint) == (0.1, "Of a step.", True, float)
    assert known["inner.rule"].choices == {"twice": twice, "thrice": thrice}
    assert str(known["inner.share"].range) == "at least 0 and below 1"
    assert str(known["out"].range) == "a finite number"


def test_changed_reaches_in_and_checks_once_all_are_in_place():
    with pytest.raises(SettingError):
        changed(OUTER, {"inner.count": 100})
    deep = {"inner.widths": (4,), "rates.rate": 0.5, "fast": True}
    now = changed(OUTER, deep)
    assert now == replace(
        OUTER, inner=replace(OUTER.inner, widths=(4,)), rates=Rates(0.5), fast=True
    )
    assert changed(OUTER, {}) == OUTER
    assert changed(OUTER, {"inner.count": 5, "inner": Inner(widths=(2,))}).inner == Inner(5, (2,))
    few = DynaConfig(num_episodes=10, num_real_first=5)
    assert changed(few, {"num_real_first": 50, "num_episodes": 60}).num_real_first == 50


@pytest.mark.parametrize(
    ("path", "near"),
    [
        ("inner.cuont", "did you mean inner.count"),
        ("count", "did you mean inner.count"),
        ("rates.rate.x", "did you mean rates.rate"),
        ("inner.rule.__name__", "is the name of no setting"),
        ("zzz", "is the name of no setting$"),
    ],
)
def test_unknown_names_are_answered_with_the_closest(path, near):
    with pytest.raises(SettingError, match=near) as caught:
        changed(OUTER, {path: 1})
    assert caught.value.path == path
    with pytest.raises(SettingError, match=near):
        value_at(OUTER, path)


CARTPOLE = (agents.ReinforceHParams(), models.SupervisedHParams(), envs.CartPoleParams())
ALL = {
    "outer": OUTER,
    "changed": changed(
        OUTER,
        {
            "inner.rule": thrice, "inner.share": 0.25, "rates.limit": 2.0, "out": Path("runs/x"),
            "arms": ("b", "a"), "version": "v1", "pair": Pair((5, 6), 7), "groups": ((3,),),
            "extra": ("x",), "cell": (1, 2),
        },
    ),
    "dyna": DynaConfig(50, 10, dream_steps=5, rare_share=0.25),
    "hparams": DynaHParams(
        agents.DQNHParams(), models.SupervisedHParams(2e-3), envs.CartPoleParams(max_steps=500)
    ),
    "reinforce": agents.ReinforceConfig((4, 4), per_step, optax.sgd),
    "dqn": agents.DQNConfig(n_step=3, double=False, optimizer=optax.adamw),
    "cloning": agents.CloningConfig(loss=margin_loss, learning_rate=1e-3),
    "supervised": models.SupervisedConfig((4,), spread=3.0, optimizer=optax.adam),
    "pixels": models.PixelConfig(loss=l1, threshold=None, reward=None, optimizer=gan_adam),
    "adversary": models.AdversaryConfig(optimizer=optax.adam),
    "rectangles": models.RectangleConfig(Resolution((2, 2)), groups=((0, 1), (2,)), dropout=0.1),
    "shooting": planners.ShootingConfig(temperature=math.inf),
    "cross_entropy": planners.CrossEntropyConfig(elites=4),
    "search": planners.SearchConfig(max_depth=3),
    "stack": envs.FrameStack(envs.Pong(scale=4, palette=CHANNELS), 2),
    "maze": envs.Maze(8, goal=(1, 1)),
    "pong": envs.PongParams(repeat_action_probability=0.25),
    "rule": SolveRule(50, 0.95, "optimal_return"),
}  # fmt: skip


@pytest.mark.parametrize("name", ALL)
def test_what_json_keeps_comes_back(name):
    """Into the defaults, and into settings that differ wherever a number can."""
    settings = ALL[name]
    kept = json.loads(json.dumps(plain(settings), allow_nan=False))
    assert restored(settings, kept) == settings
    if name in ("hparams", "stack", "rule"):
        return
    back = restored(type(settings)(), kept)
    assert back == settings and hash(plain_types(back)) == hash(plain_types(settings))
    check(back)


def plain_types(settings):
    return tuple((leaf.path, type(leaf.value)) for leaf in leaves(settings))


def test_objects_are_named_with_what_they_are_made_of():
    own = PixelLoss(twice, thrice)
    pixels = models.PixelConfig(EncoderDecoder(3, dense=16), own, reward=JointReward())
    kept = plain(replace(pixels, optimizer=partial(optax.adamw, b1=0.5)))
    assert kept["network"] == "EncoderDecoder(channels=3, dense=16)"
    assert kept["optimizer"] == "adamw(b1=0.5)"
    assert restored(pixels, plain(pixels)) == pixels
    for like, name in ((models.PixelConfig(), "network"), (pixels, "optimizer")):
        with pytest.raises(SettingError, match=f"{name} is .* cannot be read back"):
            restored(like, kept)
    dqn = agents.DQNConfig(network=GlimpseQ(5), optimizer=twice)
    assert plain(dqn)["optimizer"] == "twice" and restored(dqn, plain(dqn)) == dqn
    with pytest.raises(SettingError, match="give one of sgd, adam, adamw, rmsprop"):
        restored(agents.DQNConfig(network=GlimpseQ(5)), plain(dqn))


def test_json_of_another_experiment_is_refused():
    with pytest.raises(SettingError, match=r"inner\.cuont is the name of no setting: did you mean"):
        restored(OUTER, {"inner": {"cuont": 3}})
    with pytest.raises(SettingError, match=r"inner\.count is 0: it must be at least 1"):
        restored(OUTER, {"inner": {"count": 0}})
    assert restored(OUTER, {"rates": {"rate": 1}}).rates.rate == 1.0
    assert plain(replace(OUTER, rates=Rates(np.float32(0.5), jnp.ones(2))))["rates"] == {
        "rate": 0.5,
        "limit": [1.0, 1.0],
    }


def test_everyday_settings_are_few():
    for trees, count in (
        ((ALL["dyna"], ALL["reinforce"], ALL["supervised"], *CARTPOLE), 12),
        ((ALL["dyna"], ALL["dqn"], agents.DQNHParams(), models.PixelHParams()), 13),
    ):
        shown = [leaf for part in trees for leaf in leaves(part) if leaf.everyday]
        assert len(shown) == count
    for tree in ALL.values():
        assert all(leaf.help.endswith(".") for leaf in leaves(tree))


WORLDS = ("cartpole", "maze", "pong", "catch", "planning", "benchmark")
PRESETS = {
    f"{world} {part.name} {name}": preset
    for world in WORLDS
    for part in importlib.import_module(f"jaxdyna.experiments.{world}").PARTS
    for name, preset in (part.experiment() if isinstance(part, Study) else part).presets.items()
}
TREES = [{leaf.path: leaf for leaf in leaves(tree)} for tree in [*ALL.values(), *PRESETS.values()]]


def whole(leaf):
    """Whole numbers within a setting's range."""
    where = leaf.range
    low = -LARGEST if where.low is None else math.floor(where.low) + where.above
    high = LARGEST if where.high is None else math.ceil(where.high) - where.below
    return st.integers(low, high)


def number(leaf):
    """Others."""
    where = leaf.range
    low, high = (-MOST if where.low is None else where.low), where.high or MOST
    floats = st.floats(
        low, high, exclude_min=where.above, exclude_max=where.below, allow_nan=False,
        allow_infinity=False,
    )  # fmt: skip
    return st.one_of(floats, st.just(math.inf)) if where.infinite else floats


def possible(leaf, hint):
    """Values of a type that a setting may have, by its declaration; none where nothing is said."""
    return st.one_of([of_kind(leaf, kind) for kind in _union(hint)])


def of_kind(leaf, kind):
    """The same of a type that is no union."""
    inner = get_args(kind)
    if get_origin(kind) is tuple and inner[1:] == (Ellipsis,):
        return st.lists(possible(leaf, inner[0]), min_size=not leaf.empty, max_size=3).map(tuple)
    if get_origin(kind) is tuple:
        return st.tuples(*[possible(leaf, part) for part in inner])
    if leaf.choices and kind is not NoneType:
        return st.sampled_from([*leaf.choices.values()])
    known = {
        bool: st.booleans(), int: whole(leaf), float: number(leaf), NoneType: st.none(),
        str: st.text(max_size=5), Path: st.sampled_from([Path("runs/x"), Path("inf"), Path("a b")]),
    }  # fmt: skip
    return known.get(kind, st.just(kind) if isinstance(kind, str) else st.nothing())


@given(data=st.data(), tree=st.one_of(st.just(1), st.integers(0, len(TREES) - 1)))
@settings(max_examples=100)
def test_whatever_may_be_set_is_kept_and_comes_back(data, tree):
    """Some settings of any tree, to anything that their declarations allow."""
    before = [*ALL.values(), *PRESETS.values()][tree]
    said = {}
    for path in data.draw(st.lists(st.sampled_from([*TREES[tree]]), min_size=1, max_size=4)):
        leaf = TREES[tree][path]
        values = possible(leaf, leaf.hint)
        assume(not values.is_empty and not isinstance(leaf.value, jax.Array))
        said[path] = data.draw(values)
    try:
        now = changed(before, said)
    except ValueError:
        assume(False)  # with others it does not go together
    for path, leaf in TREES[tree].items():
        assert value_at(now, path) == said.get(path, leaf.value)
    kept = json.loads(json.dumps(plain(now), allow_nan=False))
    assert restored(before, kept) == now
    step_by_step = before
    try:
        for path, value in said.items():
            step_by_step = changed(step_by_step, {path: value})
    except ValueError:
        return
    assert step_by_step == now
