# SPDX-License-Identifier: GPL-3.0-or-later
"""Convert settings to JSON values and back, as in ``job.json``."""

from __future__ import annotations

import dataclasses
import math
import typing
from typing import Any, cast

from ..errors import UsageError
from .declaration import declarations, value_at

_KINDS: dict[Any, str] = {int: "a whole number", float: "a number", str: "text"}
_SHOWN_NAME = 40
"""Characters of an unknown entry that a message shows."""


def to_json(settings: Any) -> dict[str, Any]:
    """Convert a settings dataclass to plain JSON values."""
    return dataclasses.asdict(settings)


def key_values(settings: Any) -> dict[str, Any]:
    """Return the JSON values that decide about the result of a stage, for its key.

    Settings without influence on the result are left out, and settings that 0.1.0 did not have
    where they have their default: results of earlier versions stay valid.
    """
    left_out = {
        entry.path
        for entry in declarations(cast(type, type(settings)))
        if not entry.affects_result
        or (entry.since and value_at(settings, entry.path) == entry.default)
    }
    return {name: value for name, value in to_json(settings).items() if name not in left_out}


def has_kind(kind: Any, value: Any) -> bool:
    """Return whether a JSON value is one of a setting of type ``int``, ``float`` or ``str``."""
    if kind is float:
        try:
            return not isinstance(value, bool) and math.isfinite(value)
        except (TypeError, OverflowError):
            return False
    return kind in (int, str) and type(value) is kind


def from_json(kind: type, values: Any, location: str = "settings") -> Any:
    """Build a settings dataclass from JSON values.

    Raises
    ------
    UsageError
        A key is unknown or a value has the wrong type; names the location and the expected type.
    """
    if not isinstance(values, dict):
        raise UsageError(f"{location} must be an object.", "Write it as {...}.")
    hints = typing.get_type_hints(kind)
    fields = {f.name for f in dataclasses.fields(kind)}
    unknown = sorted(set(values) - fields)
    if unknown:
        name = unknown[0][:_SHOWN_NAME]
        raise UsageError(f"{location} has an unknown entry {name!r}.", "Remove it.")
    arguments = {}
    for name, value in values.items():
        wanted = hints[name]
        where = f"{location}.{name}"
        if dataclasses.is_dataclass(wanted):
            arguments[name] = from_json(typing.cast(type, wanted), value, where)
        elif wanted is float and isinstance(value, (int, float)) and not isinstance(value, bool):
            try:
                arguments[name] = float(value)
            except OverflowError:
                raise UsageError(f"{where} is too large.", "Give a smaller number.") from None
        elif wanted is not float and has_kind(wanted, value):
            arguments[name] = value
        elif typing.get_origin(wanted) is tuple and isinstance(value, (list, tuple)):
            if not all(isinstance(v, str) for v in value):
                raise UsageError(f"{where} must hold only text.", "Use strings.")
            arguments[name] = tuple(value)
        else:
            kind_wanted = _KINDS.get(wanted, "a list of text")
            raise UsageError(f"{where} has the wrong type.", f"Give {kind_wanted}.")
    return kind(**arguments)
