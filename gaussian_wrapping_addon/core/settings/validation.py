# SPDX-License-Identifier: GPL-3.0-or-later
"""Validate settings by their declarations."""

from __future__ import annotations

from typing import Any

from ..errors import SettingError
from .declaration import declarations, value_at


def validate(settings: Any) -> None:
    """Raise :class:`SettingError` for the first setting whose value is invalid."""
    kind: type = type(settings)
    for declared in declarations(kind):
        check = declared.check
        if check is not None and not check.holds(value_at(settings, declared.path)):
            raise SettingError(declared.path, check.wanted)
