# SPDX-License-Identifier: GPL-3.0-or-later
"""All cases of the suite, by number."""

from __future__ import annotations

from tests.hostile.case import Case, Group, Variant, row_id
from tests.hostile.cases import (
    colmap_binary,
    colmap_sets,
    colmap_values,
    commands,
    farms,
    findings,
    job_folders,
    job_places,
    masks,
    meshes,
    photos,
    regions,
    splats,
    transforms,
)

GROUPS: tuple[Group, ...] = (
    colmap_binary.GROUP,
    colmap_values.GROUP,
    colmap_sets.GROUP,
    transforms.GROUP,
    photos.GROUP,
    splats.GROUP,
    regions.GROUP,
    job_folders.GROUP,
    job_places.GROUP,
    meshes.GROUP,
    commands.GROUP,
    findings.GROUP,
    masks.GROUP,
    farms.GROUP,
)


def cases() -> list[Case]:
    """Return all cases in the order of their groups."""
    return [case for group in GROUPS for case in group.cases]


def rows() -> dict[str, Variant]:
    """Return the variants by the id of their rows."""
    return {row_id(case, variant): variant for case in cases() for variant in case.variants}
