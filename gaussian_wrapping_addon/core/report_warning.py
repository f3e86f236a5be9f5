# SPDX-License-Identifier: GPL-3.0-or-later
"""Warnings of the stages: made where a fact is known, written to the report as they are."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

LEFT_OUT_HINT = "Check whether these are needed; if so, export the input again."
UNREADABLE_HINT = "Save these photos again as JPEG or PNG."


@dataclass(frozen=True)
class ReportWarning:
    """What a person must know before using a result."""

    code: str
    """Stable identifier for programs, such as ``"photos-not-placed"``; empty where a text of
    version 0.1.0 was read."""
    text: str
    """One sentence or more, for people."""
    hint: str = ""
    """What the person can do; empty where nothing is known to help."""

    def to_json(self) -> dict[str, str]:
        """Return plain JSON values."""
        return asdict(self)


def read_warnings(values: Any) -> tuple[ReportWarning, ...]:
    """Return the warnings of a list from JSON; entries that are none are passed over.

    Parameters
    ----------
    values : any
        List of :meth:`ReportWarning.to_json`, or of plain texts as version 0.1.0 wrote them.
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
