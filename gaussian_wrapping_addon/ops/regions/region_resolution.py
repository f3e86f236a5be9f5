# SPDX-License-Identifier: GPL-3.0-or-later
"""Resolution of a region's mesh: its own edge length, or that of the scene's panels."""

from __future__ import annotations

import math

import bpy
import numpy as np

from ...core.errors import UsageError
from ..common import tags
from ..common.addon import properties_of
from .region_objects import hull_in_blender, scene_from_blender

COARSEST_SHARE = 0.5
"""Of a region's diagonal: longer edges are refused as typing errors."""
FINEST_SHARE = 1e-6
"""Of the diagonal: the worker refuses shorter edges as well."""


def has_own(scene: bpy.types.Scene, region: bpy.types.Object) -> bool:
    """Return whether a region's own edge length applies; meshes by pivots have none."""
    return bool(properties_of(region).own_edge_length) and properties_of(scene).method != "PIVOTS"


def edge_length_in_blender(scene: bpy.types.Scene, region: bpy.types.Object) -> float:
    """Return the edge length that applies, in Blender units; 0 if none does."""
    if has_own(scene, region):
        return float(properties_of(region).edge_length)
    return (
        float(properties_of(scene).edge_length)
        if properties_of(scene).resolution == "EDGE_LENGTH"
        else 0.0
    )


def checked_edge_length(scene: bpy.types.Scene, region: bpy.types.Object) -> float:
    """Return :func:`edge_length_in_blender`, checked against the region's size.

    Raises
    ------
    UsageError
        The region encloses no volume, or the length is no positive number, too long or too short.
    """
    edge_length = edge_length_in_blender(scene, region)
    diagonal = float(np.linalg.norm(np.ptp(hull_in_blender(region)[0], 0)))
    if not has_own(scene, region) and properties_of(scene).resolution != "EDGE_LENGTH":
        return 0.0
    if not math.isfinite(edge_length) or edge_length <= 0.0:
        raise UsageError(
            f"Edge length {edge_length:g} of region {region.name} is not valid.",
            "Give a positive length.",
        )
    if edge_length > COARSEST_SHARE * diagonal:
        raise UsageError(
            f"Edge length {edge_length:g} is too coarse for region {region.name}, "
            f"which measures {diagonal:.3g} from corner to corner.",
            "Choose a smaller edge length.",
        )
    if edge_length < FINEST_SHARE * diagonal:
        raise UsageError(
            f"The diagonal of region {region.name} has {diagonal / edge_length:.2g} edges of "
            f"{edge_length:g}: too many.",
            "Choose a larger edge length, or a smaller region.",
        )
    return edge_length


def world_per_blender(frame: bpy.types.Object) -> float:
    """Return how many world units of the input a length of 1 in Blender is."""
    scale = abs(np.linalg.det(scene_from_blender(frame)[:3, :3])) ** (1.0 / 3.0)
    return float(scale * tags.world_from_scene(frame).scale)


def own_lengths(
    scene: bpy.types.Scene, regions: list[bpy.types.Object], frame: bpy.types.Object
) -> list[float | None]:
    """Return each region's own edge length in world units, None if it has none.

    Raises
    ------
    UsageError
        A region or its edge length cannot be used.
    """
    lengths = [checked_edge_length(scene, region) for region in regions]
    scale = world_per_blender(frame)
    return [
        length * scale if has_own(scene, region) else None
        for region, length in zip(regions, lengths, strict=True)
    ]
