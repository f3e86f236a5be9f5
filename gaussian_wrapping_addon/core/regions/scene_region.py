# SPDX-License-Identifier: GPL-3.0-or-later
"""Regions in the scene frame, on its grid: the same bits for every similarity of the input."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ..dataset.frames.scene_grid import CENTER_STEP, snapped
from ..dataset.similarity import Similarity
from ..errors import MeshingError
from .convex_region import Region

STEP_BITS = 20
"""The step is at most this many halvings of the body's diagonal (one millionth of it), and at most
that of camera centres."""

_TIE_STEP = 2.0**-12
"""Distances that differ by less, as a share of the largest, count as equal: corners of a box can be
equally far from its diagonal, up to rounding."""


def region_in_scene(world: Region, world_from_scene: Similarity) -> Region:
    """Return a region of the world frame in the scene frame, see :func:`on_scene_grid`."""
    return on_scene_grid(world.transformed(world_from_scene.inverse()))


def on_scene_grid(region: Region) -> Region:
    """Return a body of the scene frame whose corners are rounded (docs/method.md, section 1.7).

    Four corners are rounded to the grid of camera centres. The others keep their affine
    coordinates with respect to these four, rounded as well, so that the faces of boxes, prisms and
    frusta stay plane. A body whose number of plane faces would change is returned as it is.

    Corners move by at most a few steps: 1e-5 scene units or a few millionths of the diagonal.
    Rounding twice changes nothing, even by way of the world frame.
    """
    exponent = math.frexp(region.diagonal)[1] - 1
    step = min(CENTER_STEP, 2.0 ** (exponent - STEP_BITS))
    vertices = region.vertices
    anchors = vertices[_spread_corners(vertices)]  # (4, 3)
    axes = (anchors[1:] - anchors[0]).T  # (3, 3), one axis a column
    shares = np.linalg.solve(axes, (vertices - anchors[0]).T).T  # (v, 3)
    anchors = snapped(anchors, step)
    rounded = anchors[0] + snapped(shares, 2.0**-STEP_BITS) @ (anchors[1:] - anchors[0])
    try:
        result = replace(region, vertices=rounded)
    except MeshingError:  # thinner than the steps
        return region
    same = len(result.half_spaces[1]) == len(region.half_spaces[1])
    return result if same else region


def _spread_corners(vertices: np.ndarray) -> list[int]:
    """Return four corners that span space: the first, and each time the farthest from those."""
    found = [0]
    rest = vertices - vertices[0]  # (v, 3), what is orthogonal to the corners found
    for _ in range(3):
        lengths = np.linalg.norm(rest, axis=1)
        index = int(np.argmax(snapped(lengths / lengths.max(), _TIE_STEP)))
        axis = rest[index] / lengths[index]
        rest = rest - np.outer(rest @ axis, axis)
        found.append(index)
    return found
