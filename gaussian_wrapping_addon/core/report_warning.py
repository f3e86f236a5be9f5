# SPDX-License-Identifier: GPL-3.0-or-later
"""Structured warnings of the stages, written to the report."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

LEFT_OUT_HINT = "Check whether these are needed; if so, export the input again."
UNREADABLE_HINT = "Save these photos again as JPEG or PNG."


@dataclass(frozen=True)
class ReportWarning:
    """A warning about a result: code, text and hint."""

    code: str
    """Stable identifier for programs, such as ``"photos-not-placed"``; empty for texts read from
    version 0.1.0."""
    text: str
    """One or more sentences for the user."""
    hint: str = ""
    """What the user can do; empty if nothing is known to help."""

    def to_json(self) -> dict[str, str]:
        """Return plain JSON values."""
        return asdict(self)


# Version 0.1.0 stored texts alone, and told what to do by these marks in them.
_HINTS_0_1_0 = (
    ("could not be placed", "Take more photos with more overlap there, or remove blurred ones."),
    ("cannot be read", "Save these photos again as JPEG or PNG."),
    ("start points", "Photos with more texture help, or a COLMAP model with its points."),
    ("points3D", "Export the COLMAP model together with its points."),
    ("held out for measuring", "Take more photos, from all around."),
    ("numbers were not finite", "If the figures below are poor, train again with another seed."),
    ("stand far away", "Check the poses of these cameras."),
    ("stand on one line", "Take photos from other heights and directions too."),
    ("models:", "Take photos that connect the parts, so that one model holds them all."),
    ("left out", "Check whether these are needed; if so, export the input again."),
    ("levels of detail were made", "Ask for fewer with --lods, or for a mesh with more faces."),
    ("ply_file_path", "Put the file where transforms.json says it is."),
)


def _hint_of_0_1_0(text: str) -> str:
    return next((hint for mark, hint in _HINTS_0_1_0 if mark in text), "")


def read_warnings(values: Any) -> tuple[ReportWarning, ...]:
    """Return the warnings of a JSON list; invalid entries are skipped.

    Parameters
    ----------
    values : any
        List of :meth:`ReportWarning.to_json` values, or of strings as written by version 0.1.0.
    """
    found = []
    for value in values if isinstance(values, list) else []:
        if isinstance(value, str):
            found.append(ReportWarning("", value, _hint_of_0_1_0(value)))
        elif isinstance(value, dict) and isinstance(value.get("text"), str):
            code, hint = (value.get(key) for key in ("code", "hint"))
            found.append(
                ReportWarning(
                    code if isinstance(code, str) else "",
                    value["text"],
                    hint if isinstance(hint, str) else "",
                )
            )
    return tuple(found)
