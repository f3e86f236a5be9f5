# SPDX-License-Identifier: GPL-3.0-or-later
"""Errors about a setting name the option that was typed."""

from __future__ import annotations

from ...core.errors import SettingError
from .setting_options import option_of


def with_option_name(error: SettingError) -> SettingError:
    """Return the same error, naming the option where a setting is named."""
    return SettingError(error.setting, error.wanted, called=option_of(error.setting))
