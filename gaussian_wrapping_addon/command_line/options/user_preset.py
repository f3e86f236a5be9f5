# SPDX-License-Identifier: GPL-3.0-or-later
"""The option that takes the settings of a preset saved in the panel."""

from __future__ import annotations

import logging
from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import Any

from ...core.errors import UsageError
from ...core.settings import JobSettings
from ...core.settings.job import read_saved_settings, savable_settings

OPTION = "--user-preset"

_logger = logging.getLogger("gaussian_wrapping")


def add_user_preset(parser: ArgumentParser) -> None:
    """Add the option."""
    parser.add_argument(
        OPTION, type=Path, metavar="FILE.json",
        help="settings of training and texture of a preset saved in the panel (My Presets); other "
        "options override it",
    )  # fmt: skip


def saved_values(options: Namespace, given_preset: str | None) -> dict[str, Any]:
    """Return the settings of the option's file, by path, as Wrap Scene in the panel takes them.

    Settings of meshes are left out, and what the file leaves to the preset.

    Parameters
    ----------
    given_preset : str, optional
        Overrides that of the file.

    Raises
    ------
    UsageError, ParseError
        The file cannot be used.
    """
    if options.user_preset is None:
        return {}
    try:
        saved = read_saved_settings(options.user_preset)
    except OSError as error:
        raise UsageError(
            f"{options.user_preset} cannot be read: {error.strerror or error}.",
            f"Check the path after {OPTION}.",
        ) from None
    for note in saved.notes:
        _logger.warning("warning: %s: %s", options.user_preset.name, note)
    preset = given_preset or saved.values.get("preset", JobSettings().preset)
    values = {}
    for declared in savable_settings():
        if declared.path not in saved.values or declared.group == "meshing":
            continue
        value, panel = saved.values[declared.path], declared.panel
        if panel is not None and panel.preset_if_zero and not value:
            continue
        if declared.model_selection and preset in declared.presets and value == declared.default:
            continue  # Auto leaves it to the preset
        values[declared.path] = value
    return values
