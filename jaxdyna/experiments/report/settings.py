"""The settings of a run as a table."""

from __future__ import annotations

import dataclasses
from typing import Any

from jaxdyna import fields
from jaxdyna.experiments.report.tables import Table

NOT_SHOWN = ("preset", "quick", "arms", "seeds", "seed")


def settings_table(options: Any) -> Table:
    """Everyday settings, and those that are not as they are declared."""
    declared = _declared(options)
    rows = [
        [f"`{leaf.path}`", _said(leaf.value), leaf.help]
        for leaf in fields.leaves(options)
        if leaf.path not in (*NOT_SHOWN, *options.decided)
        and (leaf.everyday or (leaf.path in declared and declared[leaf.path] != leaf.value))
    ]
    return ["setting", "value", "what it is"], rows


def _declared(options: Any, prefix: str = "") -> dict[str, Any]:
    """The values that the declarations give, by dotted path."""
    values: dict[str, Any] = {}
    for item in dataclasses.fields(options):
        value, path = getattr(options, item.name), f"{prefix}{item.name}"
        if dataclasses.is_dataclass(value):
            values |= _declared(value, f"{path}.")
        elif item.default is not dataclasses.MISSING:
            values[path] = item.default
    return values


def _said(value: Any) -> str:
    said = fields.plain(value)
    if isinstance(said, list):
        return " ".join(map(str, said))
    return f"{said:g}" if isinstance(said, float) else str(said)
