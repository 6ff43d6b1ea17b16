"""Settings declared once: default, a sentence, range, and whether they are everyday ones.

A setting is a field of a dataclass (frozen, or ``flax.struct``) made by `setting`. Its declaration
is what library checks, command lines, ``--help`` and a report's table of settings read. Settings
nest, and are named by dotted paths: ``"dyna.num_real_first"``.
"""

import dataclasses
import difflib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, NamedTuple, TypeVar, Union, get_args, get_origin, get_type_hints

import jax
import numpy as np

T = TypeVar("T")
MISSING = dataclasses.MISSING
LARGEST = 2**31 - 1
MOST = 3.4e38
"""The most that whole numbers, and others, may be whose range has no end: int32, and float32."""
_DECLARED = "jaxdyna"
_NAMES = {bool: "True or False", int: "a whole number", float: "a number", str: "text"}
_type_hints: Callable[[Any], dict[str, Any]] = cache(get_type_hints)


class SettingError(ValueError):
    """A setting that cannot be.

    Attributes:
        path: its dotted path.
        said: what is wrong, and what to change.
    """

    def __init__(self, path: str, said: str):
        super().__init__(f"{path} {said}")
        self.path, self.said = path, said


class Range(NamedTuple):
    """Where a number may lie; NaN is outside of every range."""

    low: float | None = None  #: the least, None without one
    high: float | None = None  #: the most, None without one
    above: bool = False  #: whether ``low`` itself is excluded
    below: bool = False  #: whether ``high`` itself is excluded
    infinite: bool = False  #: whether infinity is allowed

    def holds(self, value: Any) -> bool:
        """Whether it does."""
        low = -math.inf if self.low is None else self.low
        high = math.inf if self.high is None else self.high
        inside = (value > low if self.above else value >= low) and (
            value < high if self.below else value <= high
        )
        return inside and (self.infinite or -math.inf < value < math.inf)

    def __str__(self) -> str:
        if None not in (self.low, self.high) and not (self.above or self.below):
            return f"between {self.low:.12g} and {self.high:.12g}"
        least, most = "above" if self.above else "at least", "below" if self.below else "at most"
        ends = (least, self.low), (most, self.high)
        bounds = " and ".join(f"{word} {end:.12g}" for word, end in ends if end is not None)
        return bounds or ("a number" if self.infinite else "a finite number")


class Leaf(NamedTuple):
    """One setting of a tree of them."""

    help: str = ""  #: its sentence
    range: Range = Range()  #: where it may lie
    everyday: bool = False  #: whether it is an everyday one
    choices: Mapping[str, Any] = {}  #: what can be chosen, by name
    empty: bool = True  #: whether it may be an empty tuple
    path: str = ""  #: dotted
    value: Any = None  #: as it is
    default: Any = MISSING  #: as declared, `MISSING` where it is made
    hint: Any = Any  #: its type


def setting(
    default: Any = MISSING, help: str = "", *, factory: Callable[[], Any] | Any = MISSING,
    at_least: float | None = None, above: float | None = None, at_most: float | None = None,
    below: float | None = None, infinite: bool = False,
    choices: Sequence[Any] | Mapping[str, Any] = (), everyday: bool = False,
) -> Any:  # fmt: skip
    """A field of a dataclass of settings.

    Args:
        default: its value where nobody says otherwise. A tuple may be empty only where this is.
        help: a sentence, with the unit.
        factory: makes the default, instead of ``default``.
        at_least: the least that it, or each number of a tuple, may be; None (the value) passes.
        above: likewise, but not that number itself.
        at_most: the most.
        below: likewise, but not that number itself.
        infinite: whether it may be infinite.
        choices: what can be chosen by name, as they are called or by the names given here. Of text
            nothing else may be chosen; of functions and the like one of the user's own may.
        everyday: whether ``--help`` shows it, not only ``--help-all``.
    """
    low, high = (above if at_least is None else at_least), (below if at_most is None else at_most)
    where = Range(low, high, above is not None, below is not None, infinite)
    named = choices if isinstance(choices, Mapping) else {_name(item): item for item in choices}
    empty = not isinstance(default, tuple) or not default
    metadata = {_DECLARED: Leaf(help, where, everyday, named, empty)}
    if factory is not MISSING:
        return dataclasses.field(default_factory=factory, metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


def leaves(settings: Any, prefix: str = "") -> Iterator[Leaf]:
    """The settings of a nested dataclass, in the order of their declaration."""
    hints = _type_hints(type(settings))
    for item in dataclasses.fields(settings):
        value, path = getattr(settings, item.name), f"{prefix}{item.name}"
        if _is_settings(value):
            yield from leaves(value, f"{path}.")
        else:
            yield _declared(item)._replace(
                path=path, value=value, default=item.default, hint=hints[item.name]
            )


def check(settings: Any, prefix: str = "") -> None:
    """Checks every value against its type, numbers against their range too, those of an array as
    well, and text against its choices. Tracers pass, and so do functions and other objects.
    `SettingError` names the first that cannot be, and what can.
    """
    for leaf in leaves(settings, prefix):
        if wanted := _wanted_instead(leaf):
            raise SettingError(leaf.path, f"is {_name(leaf.value)}: it must {wanted}")


def _wanted_instead(leaf: Leaf) -> str | None:
    """What the value must be, where it is something else."""
    parts = tuple(_parts(leaf.value))
    kinds = _union(leaf.hint)
    numbers: list[Any] = [part for part in parts if isinstance(part, int | float | np.number)]
    if {int, float} & set(kinds):
        numbers += [end for part in parts if _known(part) for end in (part.min(), part.max())]
    words = [part for part in parts if isinstance(part, str)]
    if leaf.choices and any(word not in leaf.choices.values() for word in words):
        return f"be one of {', '.join(leaf.choices)}"
    is_class = isinstance(leaf.value, type) and all(get_origin(k) is not Callable for k in kinds)
    if is_class or not _fits(leaf.value, leaf.hint):
        return f"be {'one made by that class' if is_class else _describe(leaf.hint)}"
    if not parts and not leaf.empty:
        return "not be empty"
    if not all(leaf.range.holds(number) for number in numbers):
        return f"be {leaf.range}{', or None' if NoneType in kinds else ''}"
    most = MOST if float in kinds else LARGEST
    if leaf.range.high is None and any(most < abs(n) < math.inf for n in numbers):
        return f"be at most {most:.12g}"
    return None


def _known(value: Any) -> bool:
    """Whether it is an array of numbers that are not traced."""
    array = isinstance(value, np.ndarray | jax.Array) and not isinstance(value, jax.core.Tracer)
    return array and np.issubdtype(value.dtype, np.number) and value.size > 0


class Checked:
    """A dataclass of settings whose values are checked as it is made, see `check`."""

    def __post_init__(self) -> None:
        check(self)


def check_kind(name: str, given: Any, kinds: Any) -> None:
    """Raises `SettingError` where an argument is of no such class (or of none of a tuple of them;
    None: of any), or a setting in it cannot be.
    """
    kinds = kinds if isinstance(kinds, tuple) else () if kinds is None else (kinds,)
    if kinds and not isinstance(given, kinds):
        names = " or ".join(kind.__name__ for kind in kinds)
        raise SettingError(name, f"is a {type(given).__name__}: give a {names}")
    if _is_settings(given):
        check(given, f"{name}.")


def check_counts(at_least: int = 1, **named: Any) -> None:
    """Raises `SettingError` where an argument is no whole number, or less than that."""
    for name, value in named.items():
        if not _counts(value, at_least):
            raise SettingError(name, f"is {value}: it must be a whole number, at least {at_least}")


def check_shape(*ranks: int, **named: Any) -> None:
    """Raises `SettingError` where an argument is no shape, or not of so many axes."""
    for name, value in named.items():
        shape = isinstance(value, tuple | list) and all(_counts(size, 1) for size in value)
        if not shape or (ranks and len(value) not in ranks):
            of = "".join(f" of {rank}," for rank in ranks)
            raise SettingError(name, f"is {value}: give a tuple{of} whole numbers, at least 1")


def _counts(value: Any, at_least: int) -> bool:
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    return whole and value >= at_least


def changed(settings: T, overrides: Mapping[str, Any]) -> T:
    """The settings with others at some dotted paths. They are checked once all are in place;
    `SettingError` where a path names no setting, or a value cannot be.
    """
    for path in overrides:
        value_at(settings, path)
    return _changed(settings, overrides)


def _changed(settings: T, overrides: Mapping[str, Any]) -> T:
    now = {path: value for path, value in overrides.items() if "." not in path}
    deeper: dict[str, dict[str, Any]] = {}
    for path, value in overrides.items():
        name, dot, rest = path.partition(".")
        if dot:
            deeper.setdefault(name, {})[rest] = value
    for name, inner in deeper.items():
        try:
            now[name] = _changed(now.get(name, getattr(settings, name)), inner)
        except SettingError as error:
            raise SettingError(f"{name}.{error.path}", error.said) from None
    return dataclasses.replace(settings, **now)  # type: ignore[type-var]


def value_at(settings: Any, path: str) -> Any:
    """The setting at a dotted path; `SettingError` where there is none."""
    value = settings
    for name in path.split("."):
        if not _is_settings(value) or all(name != item.name for item in dataclasses.fields(value)):
            known = [leaf.path for leaf in leaves(settings)]
            same = [other for other in known if other.endswith(f".{path}")]
            near = same or difflib.get_close_matches(path, known, n=1)
            hint = f": did you mean {near[0]}?" if near else ""
            raise SettingError(path, f"is the name of no setting{hint}")
        value = getattr(value, name)
    return value


def plain(value: Any) -> Any:
    """Settings as JSON: dataclasses become objects; functions, modules and choices their names."""
    if _is_settings(value):
        return {
            item.name: _said(getattr(value, item.name), _declared(item).choices)
            for item in dataclasses.fields(value)
        }
    if isinstance(value, Mapping):
        return {name: plain(item) for name, item in value.items()}
    if isinstance(value, tuple | list):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if value is None or isinstance(value, bool | int | float | str):
        return value
    return plain(value.tolist()) if hasattr(value, "tolist") else _name(value)


def restored(like: T, said: Mapping[str, Any]) -> T:
    """The settings that `plain` turned into JSON; what it does not name, or is called the same
    there, stays as in ``like``. `SettingError` where there is no such setting, or it cannot be so.
    """
    known = {leaf.path: leaf for leaf in leaves(like)}

    def read(said: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
        for name, value in said.items():
            path = f"{prefix}{name}"
            if _is_settings(value_at(like, path)) and isinstance(value, Mapping):
                yield from read(value, f"{path}.")
            else:
                yield path, _read(value, known[path]) if path in known else value

    return changed(like, dict(read(said)))


def _read(value: Any, leaf: Leaf) -> Any:
    kinds = _union(leaf.hint)
    if value == _said(leaf.value, leaf.choices):
        return leaf.value
    if isinstance(value, list):
        hints = _elements(leaf.hint, len(value)) or [Any] * len(value)
        parts = [_read(value[i], Leaf(path=leaf.path, hint=hint)) for i, hint in enumerate(hints)]
        return type(leaf.value)(*parts) if hasattr(leaf.value, "_fields") else tuple(parts)
    if isinstance(value, str) and value in leaf.choices:
        return leaf.choices[value]
    whole = type(value) is int and int not in kinds
    if float in kinds and (whole or value in ("inf", "-inf", "nan")):
        return float(value)
    if isinstance(value, str) and str not in kinds and value not in kinds:
        if Path in kinds:
            return Path(value)
        if not all(kind in (*_NAMES, NoneType) or isinstance(kind, str) for kind in kinds):
            known = f": give one of {', '.join(leaf.choices)}" if leaf.choices else ""
            raise SettingError(leaf.path, f"is {value}, which cannot be read back{known}")
    return value  # the check says what it must be


def _said(value: Any, choices: Mapping[str, Any]) -> Any:
    for name, choice in choices.items():
        if choice is value or (type(choice) is type(value) and choice == value):
            return name
    return plain(value)


def _union(hint: Any) -> list[Any]:
    """The types that a type allows; of a literal its values."""
    if get_origin(hint) in (Union, UnionType):
        return [kind for part in get_args(hint) for kind in _union(part)]
    return list(get_args(hint)) if get_origin(hint) is Literal else [hint]


def _elements(hint: Any, count: int) -> Sequence[Any] | None:
    """The types of a tuple's elements, None where no tuple of so many is allowed."""
    for kind in _union(hint):
        inner = get_args(kind)
        if kind in (Any, tuple) or inner[1:] == (Ellipsis,):
            return [*inner[:1], Any][:1] * count
        if get_origin(kind) is tuple and len(inner) == count:
            return inner
    return None


def _fits(value: Any, hint: Any) -> bool:
    """Whether a plain value is of a type; what is no plain one always is."""
    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, tuple) and not hasattr(value, "_fields"):
        inner = _elements(hint, len(value))
        return inner is not None and all(map(_fits, value, inner))
    own = next((kind for kind in (*_NAMES, NoneType, list) if isinstance(value, kind)), None)
    return own is None or any(
        kind in (Any, own, value) or get_origin(kind) is own or (own is int and kind is float)
        for kind in _union(hint)
    )


def _describe(hint: Any) -> str:
    """A type in words."""
    words = []
    for kind in _union(hint):
        if get_origin(kind) is tuple:
            inner = ("..." if part is Ellipsis else _describe(part) for part in get_args(kind))
            words.append(f"a tuple ({', '.join(inner)})")
        elif get_origin(kind) is Callable:
            words.append("a function")
        else:
            words.append(_NAMES.get(kind) or ("None" if kind is NoneType else _name(kind)))
    return " or ".join(words)


def _parts(value: Any) -> Iterator[Any]:
    """The elements of nested tuples."""
    if isinstance(value, tuple):
        for part in value:
            yield from _parts(part)
    else:
        yield value


def _declared(item: dataclasses.Field) -> Leaf:
    return item.metadata.get(_DECLARED, Leaf())


def _is_settings(value: Any) -> bool:
    kind: Any = type(value)
    return _declares(kind)


@cache
def _declares(kind: Any) -> bool:
    return dataclasses.is_dataclass(kind) and any(
        _DECLARED in item.metadata for item in dataclasses.fields(kind)
    )


def _name(value: Any) -> str:
    """A function's name; what a partial one or another object is made with beside."""
    if isinstance(value, partial):
        inside = [*map(_name, value.args)]
        inside += [f"{name}={_name(item)}" for name, item in value.keywords.items()]
        return f"{_name(value.func)}({', '.join(inside)})"
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        inside = [
            f"{item.name}={_name(getattr(value, item.name))}"
            for item in dataclasses.fields(value)
            if item.name not in ("parent", "name") and getattr(value, item.name) != item.default
        ]
        return f"{type(value).__name__}({', '.join(inside)})"
    return getattr(value, "__name__", type(value).__name__) if callable(value) else str(value)
