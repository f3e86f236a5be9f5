# SPDX-License-Identifier: GPL-3.0-or-later
"""Add command-line options generated from the declarations of the settings."""

from __future__ import annotations

from argparse import ArgumentTypeError, Namespace
from collections.abc import Callable
from typing import Any

from ...core.settings import Declaration, JobSettings, declarations
from ...core.settings.declaration import Scope


def declared_options(scope: Scope) -> tuple[Declaration, ...]:
    """Return the settings that have an option in a scope."""
    return tuple(
        entry
        for entry in declarations(JobSettings)
        if entry.option is not None and entry.scope == scope
    )


def add_options(parser: Any, scope: Scope) -> None:
    """Add the options of a scope to a parser or group. Options that are not given are ``None``."""
    exclusive: dict[str, Any] = {}
    for entry in declared_options(scope):
        assert entry.option is not None
        target: Any = parser
        if entry.option.exclusive:
            if entry.option.exclusive not in exclusive:
                exclusive[entry.option.exclusive] = parser.add_mutually_exclusive_group()
            target = exclusive[entry.option.exclusive]
        add_option(target, entry)


def add_option(parser: Any, entry: Declaration, **changes: Any) -> None:
    """Add the option of one setting to a parser or argument group.

    Parameters
    ----------
    changes : dict
        Keywords of ``add_argument`` that replace the declared ones.
    """
    option = entry.option
    assert option is not None
    keywords: dict[str, Any] = {
        "dest": entry.path,
        "help": (option.help or entry.help).replace("%", "%%"),
    }
    if option.flag:
        keywords |= {"action": "store_const", "const": option.flag}
    else:
        # Without a metavar or choices, argparse would show the dotted path.
        shown = option.metavar or option.name.lstrip("-").replace("-", "_").upper()
        keywords["metavar"] = option.metavar or (None if entry.choices else shown)
        keywords["choices"] = entry.choices or None
        if option.parse is None and entry.kind in (int, float):
            keywords["type"] = _number_reader(entry)
    if option.many:
        keywords |= {"nargs": "+", "action": "extend"}
    parser.add_argument(option.name, **(keywords | changes))


def _number_reader(entry: Declaration) -> Callable[[str], Any]:
    """Return what reads the number of an option; its error gives the valid ones."""

    def read(text: str) -> Any:
        try:
            return entry.kind(text)
        except ValueError:
            valid = f"; give {entry.check.wanted}" if entry.check is not None else ""
            kind = entry.kind.__name__
            raise ArgumentTypeError(f"invalid {kind} value: {text!r}{valid}") from None

    return read


def given_settings(options: Namespace, scope: Scope) -> dict[str, Any]:
    """Return the settings, by path, whose options were given.

    Raises
    ------
    UsageError
        A value cannot be parsed.
    """
    values = {}
    for entry in declared_options(scope):
        assert entry.option is not None
        value = getattr(options, entry.path)
        if value is not None:
            values[entry.path] = entry.option.parse(value) if entry.option.parse else value
    return values


def option_of(path: str) -> str:
    """Return the name of a setting's option, ``""`` if it has none."""
    options = {e.path: e.option.name for e in declarations(JobSettings) if e.option is not None}
    return options.get(path, "")
