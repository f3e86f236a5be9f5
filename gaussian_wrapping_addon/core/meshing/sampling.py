# SPDX-License-Identifier: GPL-3.0-or-later
"""Points spread evenly over triangles: uniform samples, curvature, Poisson thinning."""

from __future__ import annotations

import numpy as np

from ..compiled import kernel
from ..parallel import even_bounds, run_chunks

POINTS_PER_SQUARE = 0.56
"""Points that thinning leaves per squared radius of area, with the numbers of candidates that
surface_points uses (measured on a sphere; the densest random packing has 0.70)."""

EDGE_PER_RADIUS = 1.5
"""Mean edge of the triangulated rest, in radii (measured with it)."""

SAME_SIDE_COSINE = -0.2
OTHER_SIDE_SHARE = 0.1
"""Two points on opposite sides of a thin wall do not crowd each other, unless they are closer
than this share of the radius."""

CURVATURE_STEP = 0.7
"""Spacing times curvature where samples become denser: about nine around a wire."""


def triangle_normals(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit normals (f, 3), zero for degenerate faces, and areas (f,)."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    length = np.linalg.norm(cross, axis=1)
    return cross / np.where(length > 0, length, 1.0)[:, None], length / 2


def sample_triangles(
    vertices: np.ndarray,
    faces: np.ndarray,
    count: int,
    rng: np.random.Generator,
    density: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Draw ``count`` points evenly over the area (stratified along the list of faces).

    Parameters
    ----------
    density : (f,) float64, optional
        Relative number of points per area of each face.

    Returns
    -------
    points : (count, 3) float64
    face : (count,) int64
    """
    _, areas = triangle_normals(vertices, faces)
    total = np.cumsum(areas if density is None else areas * density)
    where = (np.arange(count) + rng.random(count)) / count * total[-1]
    face = np.minimum(np.searchsorted(total, where, side="right"), len(faces) - 1)
    root, second = np.sqrt(rng.random(count)), rng.random(count)
    weights = np.stack([1 - root, root * (1 - second), root * second], 1)  # (count, 3)
    return np.einsum("kc,kcx->kx", weights, vertices[faces[face]]), face


class _Grid:
    """Points sorted by cell; neighbours within one cell side are found in 27 cells."""

    def __init__(self, points: np.ndarray, side: float) -> None:
        low = points.min(0)
        self.cells = np.floor((points - low) / side).astype(np.int64)  # (n, 3)
        self.size = self.cells.max(0) + 3
        # One empty layer around, so that neighbours of border cells have keys of their own.
        self.keys = self.key_of(self.cells + 1)
        self.order = np.argsort(self.keys, kind="stable")
        self.unique, self.starts = np.unique(self.keys[self.order], return_index=True)
        self.starts = np.append(self.starts, len(points)).astype(np.int64)

    def key_of(self, cells: np.ndarray) -> np.ndarray:
        return (cells[:, 0] * self.size[1] + cells[:, 1]) * self.size[2] + cells[:, 2]

    @property
    def strides(self) -> np.ndarray:
        return np.array([self.size[1] * self.size[2], self.size[2], 1], np.int64)


def thin(
    points: np.ndarray, normals: np.ndarray, radii: np.ndarray, priority: np.ndarray
) -> np.ndarray:
    """Keep a subset whose points are at least a radius apart, greedily in order of priority.

    Two points conflict where they are closer than the smaller of their radii and lie on the same
    side of a wall (their normals agree).

    Parameters
    ----------
    points, normals : (n, 3) float64
        Normals may be zero: such a point conflicts with all.
    radii : (n,) float64
    priority : (n,) float64
        Smaller comes first; ties by index.

    Returns
    -------
    (n,) bool
    """
    if len(points) == 0:
        return np.zeros(0, np.bool_)
    grid = _Grid(points, float(radii.max()))
    kept = np.zeros(len(points), np.bool_)
    _thin_kernel(
        np.argsort(priority, kind="stable"), points, normals, radii, grid.keys,
        np.searchsorted(grid.unique, grid.keys), grid.unique, grid.strides, SAME_SIDE_COSINE,
        OTHER_SIDE_SHARE, kept,
    )  # fmt: skip
    return kept


@kernel(fast=False)
def _thin_kernel(  # type: ignore[no-untyped-def]
    sequence, points, normals, radii, keys, own_cell, unique, strides, same, share, kept
):
    # Accepted points of each cell, as linked lists: the others need not be looked at again.
    head = np.full(len(unique), -1, np.int64)
    following = np.full(len(points), -1, np.int64)
    for i in sequence:
        free = True
        for dx in range(-1, 2):
            for dy in range(-1, 2):
                key = keys[i] + dx * strides[0] + dy * strides[1]
                cell = np.searchsorted(unique, key - 1)
                # The three cells along z have consecutive keys.
                while free and cell < len(unique) and unique[cell] <= key + 1:
                    j = head[cell]
                    while j >= 0:
                        x = points[i, 0] - points[j, 0]
                        y = points[i, 1] - points[j, 1]
                        z = points[i, 2] - points[j, 2]
                        limit = min(radii[i], radii[j])
                        square = x * x + y * y + z * z
                        if square < limit * limit:
                            cosine = (
                                normals[i, 0] * normals[j, 0]
                                + normals[i, 1] * normals[j, 1]
                                + normals[i, 2] * normals[j, 2]
                            )
                            if cosine >= same or square < share * share * limit * limit:
                                free = False
                                break
                        j = following[j]
                    cell += 1
                if not free:
                    break
            if not free:
                break
        if free:
            kept[i] = True
            following[i] = head[own_cell[i]]
            head[own_cell[i]] = i


def curvature(points: np.ndarray, normals: np.ndarray, radius: float, threads: int) -> np.ndarray:
    """Estimate how fast normals turn around each point, 1 / length.

    Mean of ``|n_i - n_j| / |x_i - x_j|`` over same-side neighbours between half and one radius
    away: near neighbours would measure the noise of the normals.

    Returns
    -------
    (n,) float64
        0 where there is no such neighbour.
    """
    grid = _Grid(points, radius)
    result = np.zeros(len(points))
    arguments = (
        points, normals, radius, grid.keys, grid.order, grid.unique, grid.starts, grid.strides,
        SAME_SIDE_COSINE, result,
    )  # fmt: skip
    run_chunks(
        lambda begin, end: _curvature_kernel(begin, end, *arguments),
        even_bounds(len(points), threads),
        threads,
    )
    return result


@kernel(fast=False)
def _curvature_kernel(  # type: ignore[no-untyped-def]
    begin, end, points, normals, radius, keys, order, unique, starts, strides, same, result
):
    for i in range(begin, end):
        total, count = 0.0, 0
        for dx in range(-1, 2):
            for dy in range(-1, 2):
                for dz in range(-1, 2):
                    key = keys[i] + dx * strides[0] + dy * strides[1] + dz
                    cell = np.searchsorted(unique, key)
                    if cell == len(unique) or unique[cell] != key:
                        continue
                    for slot in range(starts[cell], starts[cell + 1]):
                        j = order[slot]
                        square, turn, cosine = 0.0, 0.0, 0.0
                        for k in range(3):
                            square += (points[i, k] - points[j, k]) ** 2
                            turn += (normals[i, k] - normals[j, k]) ** 2
                            cosine += normals[i, k] * normals[j, k]
                        if square < 0.25 * radius * radius or square > radius * radius:
                            continue
                        if cosine < same:
                            continue
                        total += np.sqrt(turn / square)
                        count += 1
        if count > 0:
            result[i] = total / count


def local_radii(
    curvatures: np.ndarray, radius: float, most_points: float, smallest_share: float = 0.3
) -> np.ndarray:
    """Return the thinning radius of each candidate: smaller where the surface turns quickly.

    The lower bound rises until the expected number of points is at most ``most_points`` times
    that of the uniform radius.
    """
    edge = radius * EDGE_PER_RADIUS
    wanted = CURVATURE_STEP / np.maximum(curvatures * edge, CURVATURE_STEP)  # (n,) in (0, 1]
    for floor in np.linspace(smallest_share, 1.0, 15):
        factors = np.maximum(wanted, floor)
        if float(np.mean(factors**-2)) <= most_points:
            break
    return radius * factors
