# SPDX-License-Identifier: GPL-3.0-or-later
"""What the pose solver found of a turntable: facts, warnings and masks of the photos' full size."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ...files import read_json
from ...report_warning import ReportWarning
from ..photos.photo_file import MASK_THRESHOLD, read_mask, write_mask
from ..readers.source_model import SourceModel
from .standing_still import MIN_GROUP, TURNING_FOLDER, TURNTABLE_NAME

_NOT_FOUND = ReportWarning(
    "no-turntable",
    f"No turntable was found: fewer than {MIN_GROUP} photos are of one size.",
    "Take more photos from one place, or set Turntable to Auto.",
)
_NOT_MASKED_HINT = "Give masks, or put a background behind the object that looks different from it."


def with_turntable(
    model: SourceModel,
    folder: Path,
    sizes: Mapping[str, tuple[int, int]],
    target: Path,
    *,
    wanted: bool,
) -> SourceModel:
    """Add what the solver found to a model that still has the solver's names.

    Parameters
    ----------
    folder : Path
        The solver's.
    sizes : mapping of str to (int, int)
        Width and height of the photos.
    target : Path
        New folder for the masks.
    wanted : bool
        The user says that there is a turntable.

    Returns
    -------
    SourceModel
        With the facts ``turntable_photos`` and, where masks were made,
        ``photos_masked_as_turning``.
    """
    from PIL import Image

    found = read_json(folder / TURNTABLE_NAME)
    warnings = list(model.warnings)
    if not found["photos"]:
        warnings += [_NOT_FOUND] if wanted else []
        return dataclasses.replace(model, warnings=tuple(warnings))
    facts = {**model.facts, "turntable_photos": found["photos"]}
    photos = model.photos
    if any((folder / "masks").iterdir()):
        text = (
            f"{found['photos']} photos show a turntable. Their background is not masked, because "
            "photos have masks of their own."
        )
        hint = "Set Masks to Background if they leave out all but the object."
        warnings.append(ReportWarning("turntable-with-masks", text, hint))
    elif not found["is_masked"]:
        text = (
            f"The camera stands still in {found['photos']} photos, but what turns cannot be told "
            "from what stands still: its masks would be wrong, so none are used."
        )
        warnings.append(ReportWarning("turntable-not-masked", text, _NOT_MASKED_HINT))
    else:
        target.mkdir()
        masked = []
        for posed in photos:
            path = folder / TURNING_FOLDER / f"{posed.name}.png"
            if path.is_file():
                grey = Image.fromarray(read_mask(path))
                whole = np.asarray(grey.resize(sizes[posed.name], Image.Resampling.BILINEAR))
                write_mask(target / path.name, whole >= MASK_THRESHOLD)
                posed = dataclasses.replace(posed, mask_path=target / path.name)
            masked.append(posed)
        photos = tuple(masked)
        facts["photos_masked_as_turning"] = sum(p.mask_path is not None for p in photos)
    return dataclasses.replace(model, photos=photos, facts=facts, warnings=tuple(warnings))
