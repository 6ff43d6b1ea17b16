"""Environments by what they are called, as on a command line."""

import ast
import difflib
import importlib
import sys
from functools import cache, partial
from inspect import isclass, isfunction
from types import ModuleType
from typing import Any

import numpy as np

from jaxdyna.actions import actions_of
from jaxdyna.envs.gxm import from_gxm
from jaxdyna.envs.hosted import from_gymnasium
from jaxdyna.types import check_part

AT_ONCE = 4096  #: the most episodes of a Gymnasium world at a time; worlds are made as needed
BRIDGES: dict[str, Any] = {"gymnasium": partial(from_gymnasium, num_envs=AT_ONCE), "gxm": from_gxm}
"""What makes the worlds of another library, by the prefix of their names."""
FORMS = "gymnasium:ID, gxm:ID, jaxdyna:NAME, MODULE:NAME or 'MODULE:NAME(FIELD=VALUE, ...)'"


@cache
def named(said: str) -> Any:
    """The environment that is called so: of Gymnasium or gxm by its id; or made by a class or
    function of `jaxdyna.envs` or of another module, which may also make one of Gymnasium's.
    `ValueError` where there is none, with what is called almost so.
    """
    bridge, _, world = said.partition(":")
    if bridge in BRIDGES:
        return BRIDGES[bridge](world)
    name, given = _call(said)
    found = _module(module_of(said))
    make: Any = getattr(found, name, None)
    if make is None:
        near = difflib.get_close_matches(name, dir(found), n=1)
        hint = f": did you mean {near[0]}?" if near else ""
        raise ValueError(f"{found.__name__} has no {name}{hint}")
    home = str(getattr(make, "__module__", "")).partition(".")[0]
    if home in sys.stdlib_module_names or not (isclass(make) or isfunction(make)):
        raise ValueError(f"{said}: {name} makes no environment: name a class or function that does")
    try:
        made = make(**given)
    except TypeError as error:
        raise ValueError(f"{said}: {error}") from None
    if hasattr(made, "default_params"):
        return _checked(made)
    if not hasattr(made, "action_space") and not hasattr(made, "single_action_space"):
        raise ValueError(f"{said} makes a {type(made).__name__}, no environment: name another")
    if hasattr(made, "close"):  # the host makes its own
        made.close()
    again: Any = partial(make, **given)
    return from_gymnasium(again, AT_ONCE)


def _checked(env: Any) -> Any:
    """The pure environment, where it is seen as `jaxdyna.dyna.frames.parts` takes it."""
    check_part("the world", env, "reset", "step", "observation_space")
    actions_of(env)
    if not hasattr(env.default_params, "max_steps"):
        raise ValueError(f"{type(env).__name__}'s default_params have no max_steps: add it")
    space = env.observation_space(env.default_params)
    if len(space.shape) == 1 or (len(space.shape) == 3 and space.dtype == np.uint8):
        return env
    kinds = "a vector, or as frames of bytes [height, width, channels]"
    raise ValueError(f"{type(env).__name__} is seen as {space}: let it be seen as {kinds}")


def whole(said: str) -> str:
    """The name with its module: ``maze`` is ``jaxdyna:Maze``."""
    own = {name.lower(): name for name in importlib.import_module("jaxdyna.envs").__all__}
    return f"jaxdyna:{own[said.lower()]}" if said.lower() in own else said


def module_of(said: str) -> str:
    """The module that an environment's name begins with."""
    module = said.partition(":")[0]
    return "jaxdyna.envs" if module in ("jaxdyna", *BRIDGES) else module


def _call(said: str) -> tuple[str, dict[str, Any]]:
    """The name after the module, and what is given to it."""
    try:
        call = ast.parse(said.partition(":")[2], mode="eval").body
        name = ast.unparse(call.func if isinstance(call, ast.Call) else call)
        keywords = call.keywords if isinstance(call, ast.Call) else []
        if getattr(call, "args", []) or not all(one.arg for one in keywords):
            raise ValueError
        given = {str(one.arg): ast.literal_eval(one.value) for one in keywords}
    except (SyntaxError, ValueError):
        known = importlib.import_module("jaxdyna.envs").__all__
        near = difflib.get_close_matches(said.capitalize(), known, n=1)
        meant = f"gymnasium:{said}" if "-v" in said else f"jaxdyna:{near[0]}" if near else ""
        hint = f"did you mean {meant}? Give" if meant and ":" not in said else "give"
        raise ValueError(f"{said} is no world: {hint} {FORMS}") from None
    return name, given


def _module(name: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name not in (name, name.partition(".")[0]):
            raise ValueError(f"{name} cannot be imported: {error}") from None
        said = f"there is no module {error.name}: put its folder on PYTHONPATH, or give {FORMS}"
        raise ValueError(said) from None
