# SPDX-License-Identifier: GPL-3.0-or-later
"""What cameras cover: photos with few sparse points, and photos that show nothing of the others."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...report_warning import ReportWarning
from ..readers.source_model import SourceModel
from .sparse_points import MIN_POINTS, in_field

_WEAK_SHARE = 0.1
"""Of the median number of sparse points in a photo: with fewer, its pose hangs on few matches."""
_WEAK_POINTS = 30
"""With fewer points than this, a pose is not sure (solvers ask for 15 to 30)."""
_COMMON_POINTS = 20
"""Points of a sample in the field of a photo and of two others, with fewer of which it shows
something else."""
_SAMPLE = 20000
_MOST_NAMES = 5


def coverage_warnings(model: SourceModel) -> list[ReportWarning]:
    """Return warnings about photos that contribute little; none where points are too few to tell.

    Parameters
    ----------
    model : SourceModel
        Poses and sparse points of an input, or solved ones.
    """
    if len(model.points) < MIN_POINTS or len(model.photos) < 3:
        return []
    found = []
    names = [photo.name for photo in model.photos]
    alone = [names[i] for i in looking_elsewhere(model)]
    if alone:
        found.append(
            ReportWarning(
                "photos-elsewhere",
                f"{listed(alone)}: hardly any sparse point of other photos is in view.",
                "Check their poses, remove them, or take photos in between.",
            )
        )
    weak = [names[i] for i in weakly_matched(model) if names[i] not in alone]
    if weak:
        found.append(
            ReportWarning(
                "photos-weak",
                f"{listed(weak)}: far fewer sparse points than in the other photos.",
                "Take more photos with more overlap there, or remove these.",
            )
        )
    return found


def weakly_matched(model: SourceModel) -> list[int]:
    """Return the photos in which few sparse points were found, where the input tells."""
    counts = [photo.observed for photo in model.photos]
    known = [count for count in counts if count is not None]
    if len(known) < len(counts) or not any(known):
        return []
    limit = max(_WEAK_SHARE * float(np.median(known)), min(_WEAK_POINTS, float(np.median(known))))
    return [i for i, count in enumerate(known) if count < limit]


def looking_elsewhere(model: SourceModel) -> list[int]:
    """Return the photos in whose field hardly any point lies that two other photos may see."""
    step = max(1, len(model.points) // _SAMPLE)
    points = model.points[::step].astype(np.float64)
    fields = np.zeros((len(model.photos), len(points)), bool)
    with np.errstate(over="ignore", invalid="ignore"):
        for k, photo in enumerate(model.photos):
            local = points @ photo.cam_from_world[:, :3].T + photo.cam_from_world[:, 3]
            fields[k] = in_field(local, photo)
    shared = (fields & (fields.sum(0) >= 3)).sum(1)
    limit = min(_COMMON_POINTS, 0.5 * float(np.median(shared)))
    return [int(i) for i in np.flatnonzero(shared < limit)]


def listed(names: Sequence[str]) -> str:
    """Return names for a message: the first few, and how many others."""
    others = len(names) - _MOST_NAMES
    if others <= 0:
        return ", ".join(names)
    return f"{', '.join(names[:_MOST_NAMES])} and {others} other{'s' * (others > 1)}"
