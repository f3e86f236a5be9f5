# SPDX-License-Identifier: GPL-3.0-or-later
"""What the solver's check of its own cameras found: facts and warnings of the report."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ...files import read_json
from ...report_warning import ReportWarning
from ..readers.source_model import SourceModel

SOLUTION_NAME = "solution.json"
"""Of the helper, in its folder."""
_NAMED = 5
"""Most photos or pairs that a warning names."""
_MIN_PART = 3
"""Photos of a part that is worth a warning; single ones hang on few matches everywhere."""
_logger = logging.getLogger(__name__)


def with_findings(model: SourceModel, folder: Path, source_names: Mapping[str, str]) -> SourceModel:
    """Add facts and warnings to a solved model; warnings also go to the log.

    Parameters
    ----------
    folder : Path
        The solver's.
    source_names : mapping of str to str
        Photos by the solver's names.
    """
    found = read_json(folder / SOLUTION_NAME)
    warnings = findings(found, source_names)
    for warning in warnings:
        _logger.warning("%s %s", warning.text, warning.hint)
    facts = {
        **model.facts,
        "pairs_matched": found["pairs_matched"],
        "pairs_verified": found["pairs"],
        "pairs_contradicting_cameras": found["contradicting_pairs"],
        "photos_joined": found["joined"],
        "mapper": found["mapper"],
    }
    return dataclasses.replace(model, facts=facts, warnings=(*model.warnings, *warnings))


def photos_in_parts(folder: Path) -> frozenset[str]:
    """Return the photos, by the solver's names, of parts that a warning says stay apart."""
    return frozenset(name for part in read_json(folder / SOLUTION_NAME)["apart"] for name in part)


def findings(found: Mapping[str, Any], source_names: Mapping[str, str]) -> list[ReportWarning]:
    """Return the warnings of ``solution.json``."""
    warnings = []
    share = f"{100 * found['contradicting_share']:.0f} %"
    if found["is_doubtful"]:
        strongest = "; ".join(
            f"{source_names[one]} and {source_names[other]} ({agreeing} of {matches} matches fit)"
            for one, other, matches, agreeing in found["strongest"][:_NAMED]
        )
        warnings.append(
            ReportWarning(
                "cameras-contradicted",
                f"The solved cameras may be wrong: {found['contradicting_pairs']} of "
                f"{found['strong_pairs']} strong pairs of photos, with {share} of the matches, "
                f"contradict them, as where things look alike or repeat. Strongest: {strongest}.",
                "Look at the cameras before the mesh. Take photos that show what is different "
                "from place to place, or mask what repeats.",
            )
        )
    if found["is_mended"]:
        warnings.append(
            ReportWarning(
                "cameras-mended",
                "The cameras solved first contradicted many matches. These are solved again from "
                "the photos that have most in common, and contradict fewer of their matches.",
                "Look at the cameras before the mesh.",
            )
        )
    weak = [part for part in found["parts"][1:] if len(part) >= _MIN_PART]
    if weak:
        warnings.append(
            ReportWarning(
                "cameras-weakly-linked",
                f"{_count(weak)} placed photos are linked to the others by few matches; where they "
                f"stand is uncertain: {_listed(weak, source_names)}.",
                "Take photos in between, with more overlap.",
            )
        )
    if found["apart"]:
        warnings.append(
            ReportWarning(
                "cameras-in-parts",
                f"{_count(found['apart'])} photos fit each other but not the rest, in "
                f"{len(found['apart'])} parts, and are not used: "
                f"{_listed(found['apart'], source_names)}.",
                "Take photos that connect the parts.",
            )
        )
    return warnings


def _count(parts: Sequence[Sequence[str]]) -> int:
    return sum(len(part) for part in parts)


def _listed(parts: Sequence[Sequence[str]], source_names: Mapping[str, str]) -> str:
    names = [source_names[name] for part in parts for name in part]
    return ", ".join(names[:_NAMED]) + (" ..." if len(names) > _NAMED else "")
