# SPDX-License-Identifier: GPL-3.0-or-later
"""Settings that a user saves under a name, as JSON (docs/file-formats.md).

Values are by path and in the words of the settings, so that they outlive changes of the panel. A
file of another version is used as far as it goes: what is unknown or out of range is named and left
out.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from ..errors import ParseError
from ..files import read_json, write_json
from .declaration import Declaration, declarations
from .job import JobSettings
from .json_values import has_kind

FORMAT: Final = "GaussianWrappingSettings"
VERSION: Final = 1
MAX_BYTES: Final = 64 * 1024
"""A file with every setting has about 2 kB."""
MAX_NOTES: Final = 5
"""Of a file that holds something else; the others are counted."""
_SHOWN_NAME: Final = 40
"""Characters of an unknown entry that a note shows."""


@dataclass(frozen=True)
class SavedSettings:
    """Contents of a file of saved settings."""

    values: dict[str, Any]
    """By path; 0 leaves a number to the preset."""
    panel: dict[str, Any]
    """Choices of the panel that are no settings of a job, by property, not validated."""
    notes: tuple[str, ...]
    """What was left out, a sentence each."""


def savable_settings() -> list[Declaration]:
    """Return the settings that are saved: those of a panel, without paths and the machine's."""
    return [
        declared
        for declared in declarations(JobSettings)
        if declared.panel is not None
        and declared.property_owner != "preferences"
        and declared.panel_name != "computers"
        and not (declared.kind is str and not declared.choices)
    ]


def write_saved_settings(path: Path, values: Mapping[str, Any], panel: Mapping[str, Any]) -> None:
    """Write saved settings atomically; the parameters are as in :class:`SavedSettings`."""
    write_json(
        path,
        {"format": FORMAT, "version": VERSION, "settings": dict(values), "panel": dict(panel)},
    )


def read_saved_settings(path: Path) -> SavedSettings:
    """Read saved settings.

    Raises
    ------
    ParseError
        The file holds something else; names the entry and what to do.
    OSError
        It cannot be read.
    """
    hint = "Delete this preset, and save it again."
    stored = read_json(path, most_bytes=MAX_BYTES)
    if not isinstance(stored, dict) or stored.get("format") != FORMAT:
        raise ParseError(path, "format", f"is not {FORMAT!r}.", hint)
    if type(stored.get("version")) is not int or stored["version"] != VERSION:
        raise ParseError(path, "version", f"is not {VERSION}.", hint)
    settings, panel = stored.get("settings"), stored.get("panel", {})
    for name, part in (("settings", settings), ("panel", panel)):
        if not isinstance(part, dict):
            raise ParseError(path, name, "is not an object.", hint)
    assert isinstance(settings, dict)
    assert isinstance(panel, dict)
    known = {declared.path: declared for declared in savable_settings()}
    values, notes = {}, []
    for name, value in settings.items():
        declared = known.get(name)
        if declared is None:
            notes.append(f"{name[:_SHOWN_NAME]!r} is no setting of this version.")
        elif not _is_valid(declared, value):
            notes.append(f"{name} is out of range, and stays as it is.")
        else:
            values[name] = float(value) if declared.kind is float else value
    if len(notes) > MAX_NOTES:
        notes[MAX_NOTES:] = [f"{len(notes) - MAX_NOTES} more entries were left out."]
    return SavedSettings(values, panel, tuple(notes))


def _is_valid(declared: Declaration, value: Any) -> bool:
    if not has_kind(declared.kind, value):
        return False
    if declared.panel is not None and declared.panel.preset_if_zero and value == 0:
        return True
    return declared.check is None or declared.check.holds(value)
