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
            found.append(ReportWarning("", value))
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
