# SPDX-License-Identifier: GPL-3.0-or-later
"""Name the command-line option in errors about a setting."""

from __future__ import annotations

from ...core.errors import SettingError
from .setting_options import option_of


def with_option_name(error: SettingError) -> SettingError:
    """Return the error with the setting's option in place of its path."""
    return SettingError(error.setting, error.wanted, called=option_of(error.setting))
