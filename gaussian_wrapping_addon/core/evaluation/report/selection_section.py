# SPDX-License-Identifier: GPL-3.0-or-later
"""Report section on model selection: each choice, its evidence, the setting to override it."""

from __future__ import annotations

from typing import Any

from .text import escaped, escaped_or, items, part, table

_TITLES = {
    "harmonics": "View-dependent colour (gloss)",
    "exposure": "Brightness and tint of each photo",
    "multi_view": "Comparison of neighbouring photos",
    "wrapping": "Thin parts (two-sided surfaces)",
    "growth": "Number of Gaussians",
    "full_size": "Size of the training images",
    "dense_start": "Start on surfaces found by matching photos",
    "refine_poses": "Camera poses refined",
}
"""Title of each choice, in an artist's words."""

_EFFECTS = {
    "harmonics": ('"on" uses all degrees up to `sh_degree`; "off" gives each point one colour'),
    "exposure": '"on" corrects every photo; "off" uses them unchanged',
    "multi_view": '"on" or "off"',
    "wrapping": '"on" or "off"',
    "full_size": '"on" trains at full size up to `max_image_px`; "off" at half of it',
    "refine_poses": '"on" refines them in any case; "off" takes them as given',
    "dense_start": '"on" starts on whatever is found; "off" starts from the sparse points',
    "growth": '"on" lets the number grow up to `max_gaussians`; "off" adds none',
}

_DECIDED_BY = {"auto": "the photos", "on": "you (on)", "off": "you (off)"}


def selection_lines(training: dict[str, Any]) -> list[str]:
    """Return the Markdown lines of the section with its heading; none if nothing was selected.

    Parameters
    ----------
    training : dict
        The report's training figures; its entry ``decisions`` holds what
        :meth:`~.model_selection.ModelSelection.to_json` wrote. Unknown entries of newer versions
        are shown unchanged.
    """
    decisions = [part(entry) for entry in items(training.get("decisions"))]
    decisions = [entry for entry in decisions if entry.get("name")]
    if not decisions:
        return []
    rows = [
        (_title(entry), escaped_or(entry.get("chosen")), _decided_by(entry)) for entry in decisions
    ]
    lines = [
        "## Model selection",
        "",
        (
            "A larger model than the scene needs costs time and can lower the quality. Each part "
            "is therefore chosen from the photos, unless you set it."
        ),
        "",
        *table(("part", "used", "chosen by"), rows, "lll"),
        "",
    ]
    for entry in decisions:
        lines += [f"- **{_title(entry)}: {escaped_or(entry.get('chosen'))}.** {_evidence(entry)}"]
        lines += [f"    - *To change this:* {_override(entry)}."]
    return lines


def _title(entry: dict[str, Any]) -> str:
    return _TITLES.get(str(entry["name"]), escaped(entry["name"]))


def _decided_by(entry: dict[str, Any]) -> str:
    return _DECIDED_BY.get(str(entry.get("setting")), escaped_or(entry.get("setting")))


def _evidence(entry: dict[str, Any]) -> str:
    evidence = escaped_or(entry.get("evidence"), "No evidence was recorded.")
    measured = entry.get("measured") is not False  # absent in version 0.1.0
    if entry.get("setting") in ("on", "off") and measured:
        return f"Set by you. Evidence from the photos: {evidence}"
    return evidence


def _override(entry: dict[str, Any]) -> str:
    name = str(entry["name"])
    effect = f": {_EFFECTS[name]}" if name in _EFFECTS else ""
    back = '; "auto" chooses from the photos' if entry.get("setting") in ("on", "off") else ""
    return f"setting `{escaped(name) if name not in _TITLES else name}`{effect}{back}"
