# SPDX-License-Identifier: GPL-3.0-or-later
"""The report's section on what a scene needed: what was decided, why, how to decide otherwise."""

from __future__ import annotations

from typing import Any

from .text import escaped, escaped_or, items, part, table

_TITLES = {
    "harmonics": "Colours that change with the viewing direction (gloss)",
    "exposure": "Brightness and tint of each photo on its own",
    "multi_view": "Comparing photos taken from similar places",
    "wrapping": "Thin parts: surfaces with two sides",
    "growth": "Number of Gaussians",
    "full_size": "Size of the training images",
}
"""Of each decision, what it is about in an artist's words."""

_EFFECTS = {
    "harmonics": (
        '"on" uses all degrees up to `sh_degree`; "off" gives every point one colour from all sides'
    ),
    "exposure": '"on" corrects every photo; "off" takes them as they are',
    "multi_view": '"on" or "off"',
    "wrapping": '"on" or "off"',
    "full_size": '"on" trains on the full size up to `max_image_px`; "off" on half of it',
    "growth": '"on" lets the number grow up to `max_gaussians`; "off" adds none',
}

_DECIDED_BY = {"auto": "the photos", "on": "you (on)", "off": "you (off)"}


def selection_lines(training: dict[str, Any]) -> list[str]:
    """Return the Markdown lines of the section, with its heading; none where nothing was decided.

    Parameters
    ----------
    training : dict
        The report's training figures; its entry ``decisions`` holds what
        :meth:`~.model_selection.ModelSelection.to_json` wrote. Entries of newer versions are shown
        as they are.
    """
    decisions = [part(entry) for entry in items(training.get("decisions"))]
    decisions = [entry for entry in decisions if entry.get("name")]
    if not decisions:
        return []
    rows = [
        (_title(entry), escaped_or(entry.get("chosen")), _decided_by(entry)) for entry in decisions
    ]
    lines = [
        "## What this scene needed",
        "",
        (
            "More model than a scene needs costs time and can even harm. So the photos decide what "
            "is used, unless you do."
        ),
        "",
        *table(("about", "used", "decided by"), rows, "lll"),
        "",
    ]
    for entry in decisions:
        lines += [f"- **{_title(entry)}: {escaped_or(entry.get('chosen'))}.** {_evidence(entry)}"]
        lines += [f"    - *To decide otherwise:* {_override(entry)}."]
    return lines


def _title(entry: dict[str, Any]) -> str:
    return _TITLES.get(str(entry["name"]), escaped(entry["name"]))


def _decided_by(entry: dict[str, Any]) -> str:
    return _DECIDED_BY.get(str(entry.get("setting")), escaped_or(entry.get("setting")))


def _evidence(entry: dict[str, Any]) -> str:
    evidence = escaped_or(entry.get("evidence"), "No evidence was recorded.")
    measured = entry.get("measured") is not False  # version 0.1.0 did not tell
    if entry.get("setting") in ("on", "off") and measured:
        return f"You decided this. What the photos say: {evidence}"
    return evidence


def _override(entry: dict[str, Any]) -> str:
    name = str(entry["name"])
    effect = f": {_EFFECTS[name]}" if name in _EFFECTS else ""
    back = '; "auto" leaves it to the photos' if entry.get("setting") in ("on", "off") else ""
    return f"setting `{escaped(name) if name not in _TITLES else name}`{effect}{back}"
