# SPDX-License-Identifier: GPL-3.0-or-later
"""Accuracy, completeness and Chamfer distance by the protocol of the DTU data set.

See docs/method.md, section 9.2.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import MeshingError, ResourceError, UsageError
from ..files import finite_json
from ..limits import MAX_POINTS
from ..mesh.sampling import distances_to_cloud, thin

DENSITY_MM = 0.2  # minimum distance of predicted points, and maximum gap of a resampled mesh
PATCH_MM = 60.0  # predicted points farther than this outside the observed box are ignored
MAX_DISTANCE_MM = 20.0  # distances of this or more are dropped from the means
MAX_CELLS = 2e6
"""Maximum extent in densities: indices of cells over three such axes fit into 64 bits."""
ROW_SHARE = math.sqrt(0.75)
"""Distance of rows in densities: a position just below the next row is still nearer than one
density to a point of its own row, half a density away along it."""

_MORE = "Check that the mesh is in the truth's unit (mm), or give a larger density."


@dataclass(frozen=True)
class ObservationMask:
    """Volume observed by the data set's cameras (``ObsMask``, ``BB``, ``Res``)."""

    volume: np.ndarray
    """(x, y, z) bool; voxel (i, j, k) is centred at ``low + resolution * (i, j, k)``."""
    low: np.ndarray
    high: np.ndarray
    """(3,) float64, corners of the box, rows of ``BB``."""
    resolution: float  # distance between voxel centres

    def __post_init__(self) -> None:
        is_valid = (
            self.volume.ndim == 3
            and self.volume.dtype == np.bool_
            and np.shape(self.low) == (3,)
            and np.shape(self.high) == (3,)
            and bool(np.isfinite(self.low).all() and np.isfinite(self.high).all())
            and bool((np.asarray(self.high) > np.asarray(self.low)).all())
            and math.isfinite(self.resolution)
            and self.resolution > 0
        )
        if not is_valid:
            raise UsageError(
                "The observation mask is not a bool volume with a box and a resolution > 0.",
                "Read it from the data set's ObsMask file again.",
            )

    def within(self, points: np.ndarray, margin: float) -> np.ndarray:
        """Return whether (n, 3) points are in the box or at most ``margin`` outside, (n,) bool."""
        return ((points >= self.low - margin) & (points <= self.high + margin)).all(1)

    def observed(self, points: np.ndarray) -> np.ndarray:
        """Return whether (n, 3) points lie in an observed voxel, (n,) bool."""
        # Clipped before the cast: far points would overflow an integer.
        place = np.floor((points - self.low) / self.resolution + 0.5)
        index = np.clip(place, -1.0, self.volume.shape).astype(np.int64)  # (n, 3)
        inside = ((index >= 0) & (index < self.volume.shape)).all(1)
        result = np.zeros(len(points), np.bool_)
        i, j, k = index[inside].T
        result[inside] = self.volume[i, j, k]
        return result


@dataclass(frozen=True)
class DtuScore:
    """Mean distances in the truth's unit (mm); infinite if there is no distance to average."""

    accuracy: float  # from predicted points in observed voxels to the truth
    completeness: float  # from true points above the ground plane to the prediction
    overall: float  # mean of the two: the data set's Chamfer distance
    accuracy_count: int
    completeness_count: int
    """Number of distances averaged."""
    accuracy_dropped: float
    completeness_dropped: float
    """Share of distances dropped because of the maximum distance; 0 without distances."""

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values; infinite distances become ``None``."""
        return dict(finite_json(dataclasses.asdict(self)))


def dtu_chamfer(
    points: np.ndarray, truth_points: np.ndarray, mask: ObservationMask, plane: np.ndarray, *,
    density: float = DENSITY_MM, patch: float = PATCH_MM, max_distance: float = MAX_DISTANCE_MM,
    seed: int = 0, threads: int = 1,
) -> DtuScore:  # fmt: skip
    """Compare points with a scan by the protocol of the data set (Jensen et al., CVPR 2014).

    1. Predicted points farther than ``patch`` outside the mask's box are removed.
    2. The others are visited in random order and removed if a point kept before is nearer than
       ``density``, so that dense parts do not weigh more.
    3. Accuracy: mean distance to the nearest true point, of those in an observed voxel.
    4. Completeness: mean distance to the nearest predicted point left by step 2 (observed or not),
       of the true points above the ground plane.
    5. Distances of ``max_distance`` and more are dropped from both means, as in the usual tool:
       gross errors do not affect the means. :class:`DtuScore` therefore holds their share.

    Parameters
    ----------
    points, truth_points : (n, 3), (m, 3) float64
        In the truth's frame; for a mesh, see :func:`resample_mesh`. The former may be empty.
    plane : (4,) float64
        A true point x is above the ground where ``plane . [x, 1] > 0``.
    density, patch, max_distance : float
        In the truth's unit (mm); ``density`` 0 keeps all points.
    seed : int
        Of the order in step 2.
    threads : int
        Of the search; the result does not depend on it.

    Raises
    ------
    UsageError
        Values that are not finite, lengths that are not positive, or no true point above the plane.
    """
    points = np.asarray(points, np.float64).reshape(-1, 3)
    truth_points = np.asarray(truth_points, np.float64).reshape(-1, 3)
    plane = np.asarray(plane, np.float64).reshape(-1)
    if not (np.isfinite(points).all() and np.isfinite(truth_points).all()):
        raise UsageError("A point is not finite.", "Remove such points.")
    if plane.shape != (4,) or not np.isfinite(plane).all():
        raise UsageError("The ground plane is not four finite numbers.", "Read it again.")
    if not (density >= 0 and patch >= 0 and max_distance > 0):
        raise UsageError("Density, patch or maximum distance is negative.", "Give lengths > 0.")
    above = truth_points[truth_points @ plane[:3] + plane[3] > 0]
    if len(above) == 0:
        raise UsageError("No true point is above the ground plane.", "Check the plane's sign.")
    points = thin_by_distance(points[mask.within(points, patch)], density, seed=seed)
    accuracy = _mean_below(
        distances_to_cloud(points[mask.observed(points)], truth_points, threads=threads)[0],
        max_distance,
    )
    completeness = _mean_below(distances_to_cloud(above, points, threads=threads)[0], max_distance)
    return DtuScore(
        accuracy[0], completeness[0], (accuracy[0] + completeness[0]) / 2,
        accuracy[1], completeness[1], accuracy[2], completeness[2],
    )  # fmt: skip


def thin_by_distance(points: np.ndarray, density: float, *, seed: int) -> np.ndarray:
    """Keep points, in random order, that are at least ``density`` from all points kept before.

    Returns (k, 3) float64 points in the original order; every removed point is nearer than
    ``density`` to one of them.

    Raises
    ------
    UsageError
        ``density`` is too small for the extent of the points.
    """
    if density == 0 or len(points) == 0:
        return points
    extent = float(np.ptp(points, axis=0).max())
    if not extent / density < MAX_CELLS:
        raise UsageError(
            f"Points that extend over {extent:.6g} cannot be thinned out to {density:.6g}.",
            "Give a larger density.",
        )
    order = np.random.default_rng(seed).permutation(len(points)).astype(np.float64)
    kept = thin(points, np.zeros_like(points), np.full(len(points), float(density)), order)
    return points[kept]


def resample_mesh(vertices: np.ndarray, faces: np.ndarray, density: float) -> np.ndarray:
    """Cover a mesh with points such that every position on it has one nearer than ``density``.

    Each face gets rows of points parallel to its longest edge, at most ``density`` apart along the
    row and :data:`ROW_SHARE` of it between rows. Edges are covered by both of their faces;
    :func:`dtu_chamfer` removes the duplicates.

    Of vertices (v, 3) float64 and faces (f, 3) int, with a density > 0 in the mesh's unit. Returns
    (n, 3) float64 points, none for a mesh without faces.

    Raises
    ------
    UsageError
        ``density`` is not positive.
    MeshingError
        A vertex is not finite.
    ResourceError
        More than :data:`~.limits.MAX_POINTS` points are needed.
    """
    if not (math.isfinite(density) and density > 0):
        raise UsageError(f"A density of {density} cannot be used.", "Give a length > 0.")
    corners = np.asarray(vertices, np.float64)[np.asarray(faces, np.int64).reshape(-1, 3)]
    if len(corners) == 0:
        return np.zeros((0, 3))
    if not np.isfinite(corners).all():
        raise MeshingError("The mesh has a vertex that is not finite.", "Remove it.")
    edges = np.roll(corners, -1, axis=1) - corners  # (f, 3, 3), a to b, b to c, c to a
    first = np.linalg.norm(edges, axis=2).argmax(1)  # (f,), start of the longest edge
    turn = (first[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(corners, turn[:, :, None], 1).transpose(1, 0, 2)
    base = b - a
    length = np.linalg.norm(base, axis=1)
    along = ((c - a) * base).sum(1) / np.where(length > 0, length**2, 1.0)
    height = np.linalg.norm(c - a - along[:, None] * base, axis=1)
    # Checked first: lengths in a wrong unit would need more rows than fit into memory.
    if not float((height / density + 2) @ (length / density + 2)) < 4.0 * MAX_POINTS:
        raise ResourceError("The mesh would need too many points.", _MORE)
    rows = np.ceil(height / (density * ROW_SHARE)).astype(np.int64)  # from the edge to the corner
    face, row = _counted(rows + 1)
    share = row / np.maximum(rows[face], 1)  # (r,), 0 on the longest edge, 1 at the corner
    steps = np.ceil(length[face] * (1.0 - share) / density).astype(np.int64)
    line, step = _counted(steps + 1)
    if len(line) > MAX_POINTS:
        raise ResourceError(f"The mesh would need {len(line)} points.", _MORE)
    along_row = step / np.maximum(steps[line], 1)  # (n,), along the row
    lift, owner = share[line], face[line]
    weights = np.stack([(1 - lift) * (1 - along_row), (1 - lift) * along_row, lift], 1)  # (n, 3)
    result = weights[:, :1] * a[owner]
    result += weights[:, 1:2] * b[owner]
    result += weights[:, 2:] * c[owner]
    return result


def _counted(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Repeat row i ``counts[i]`` times; return its index and the repetition number from 0."""
    owner = np.repeat(np.arange(len(counts)), counts)
    starts = np.cumsum(counts) - counts
    return owner, np.arange(len(owner)) - starts[owner]


def _mean_below(distances: np.ndarray, limit: float) -> tuple[float, int, float]:
    """Return the mean of the distances below a limit, their number, and the share dropped."""
    below = distances[distances < limit]
    if len(distances) == 0:
        return math.inf, 0, 0.0
    mean = float(below.mean()) if len(below) else math.inf
    return mean, len(below), 1.0 - len(below) / len(distances)
