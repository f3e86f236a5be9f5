# SPDX-License-Identifier: GPL-3.0-or-later
"""How far apart the vertices may be: long edges where the surface is flat, short where it curves.

The height of a surface over triangles with edges ``e`` is about ``curvature * e**2 / 8``. Equal
heights everywhere (edges in proportion to ``curvature**-0.5``) spend the vertices on the worst
places and leave the mean height as it is; the power :data:`CURVATURE_POWER` lessens both.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ..dataset.camera import Camera
from .sampling import EDGE_PER_RADIUS, POINTS_PER_SQUARE

CURVATURE_POWER = 1 / 3
"""Edges go with this power of 1 / curvature. For a given number of vertices 1/4 makes the mean
height smallest, 1/3 the mean square, 1/2 the maximum."""

NEIGHBOURS = 24
"""Points that the shape around a point is taken from, at each scale."""
SCALE_STEP = 1.6
"""From one scale to the next."""

SHORTEST_SHARE, LONGEST_SHARE = 0.3, 6.0
"""Edges, in edges of the uniform mesh with as many points."""

HEIGHT_OF_CURVATURE = 0.135
"""Standard deviation of heights over a disc, in curvature times squared radius (a sphere has 0.144,
a cylinder 0.125)."""

SAME_SIDE_COSINE = 0.0
OPPOSITE_COSINE = -0.5
"""Of the normals of points on one side, and on opposite sides, of a wall."""

TURN_PER_EDGE = 0.7
"""Angle that normals may turn along an edge: about nine edges around a wire. Noise of the normals
turns them less than that; where they turn more, no longer edge could follow the surface."""

EDGES_PER_THICKNESS = 3.0
"""On thin walls edges are not lengthened beyond this many thicknesses: the triangulation would
connect the two sides."""

EDGE_PER_PIXEL = 0.5
"""Shortest edge, in pixels of the nearest camera. The finest pattern that a photo holds repeats
after two pixels; four vertices show it."""

GRADING = 0.4
"""Edges grow by at most this share of the distance: neighbouring triangles stay well shaped."""

SHORT_SHARE = 0.25
"""A requested edge length is that of the most curved parts: those in which this share of the
vertices lies."""


@dataclass(frozen=True)
class Shape:
    """What the surface looks like around some points, at several scales."""

    scales: np.ndarray
    """(k,) float64 radii of the neighbourhoods, increasing."""
    curvatures: np.ndarray
    """(n, k) float64, 1 / length: height over the best plane at each scale, as a curvature."""
    turns: np.ndarray
    """(n, k) float64: quadratic mean of the angles between normals, per scale."""
    thickness: np.ndarray
    """(n,) float64: distance to the other side of a thin wall; infinite where none is near."""


def measure_shape(
    points: np.ndarray, normals: np.ndarray, area: float, longest: float, threads: int
) -> Shape:
    """Look at the surface around each point at growing scales.

    The smallest scale is what the density of the points allows; larger ones see fewer of them.
    Positions tell curvature: the heights of noise, which positions on the isosurface show at small
    scales, weigh less and less at larger ones.

    Parameters
    ----------
    points, normals : (n, 3) float64
        Spread evenly and at random over a surface, unit normals.
    area : float
        Of that surface.
    longest : float
        The largest scale.
    """
    count = len(points)
    reach = math.sqrt(NEIGHBOURS * area / (math.pi * max(count, 1)))
    steps = max(0, math.ceil(math.log(max(longest / reach, 1.0), SCALE_STEP)))
    scales = reach * SCALE_STEP ** np.arange(steps + 1)
    curvatures, turns = np.zeros((count, len(scales))), np.zeros((count, len(scales)))
    thickness = np.full(count, np.inf)
    for level, scale in enumerate(scales):
        # The points are in random order: a stride thins them evenly.
        chosen = np.arange(0, count, max(1, round((scale / reach) ** 2)))
        tree = cKDTree(points[chosen])
        for begin in range(0, count, 1 << 15):
            part = slice(begin, begin + (1 << 15))
            near, index = tree.query(
                points[part], k=NEIGHBOURS, distance_upper_bound=scale, workers=threads
            )
            known = np.isfinite(near)  # (p, NEIGHBOURS)
            index = chosen[np.where(known, index, 0)]
            offset = points[index] - points[part, None]
            cosine = (normals[index] * normals[part, None]).sum(2)
            same = known & (cosine > SAME_SIDE_COSINE)
            curvatures[part, level] = _heights(offset, same) / (HEIGHT_OF_CURVATURE * scale**2)
            square = np.where(same, np.maximum(2.0 - 2.0 * cosine, 0.0), 0.0).sum(1)
            turns[part, level] = np.sqrt(square / np.maximum(same.sum(1), 1))
            depth = np.abs((offset * normals[part, None]).sum(2))
            across = known & (cosine < OPPOSITE_COSINE) & (depth > 0)
            closest = np.where(across, depth, np.inf).min(1)
            thickness[part] = np.minimum(thickness[part], closest)
    return Shape(scales, curvatures, turns, thickness)


def _heights(offset: np.ndarray, same: np.ndarray) -> np.ndarray:
    """Return the standard deviation of points (p, k, 3) over their best plane, (p,)."""
    weight = same / np.maximum(same.sum(1), 1)[:, None]  # (p, k)
    local = offset - (offset * weight[:, :, None]).sum(1)[:, None]
    moments = np.einsum("pk,pka,pkb->pab", weight, local, local)
    # Three points lie in a plane whatever the surface does: the fit takes three degrees of freedom.
    count = same.sum(1)
    fair = count / np.maximum(count - 3, 1)
    return np.sqrt(np.maximum(np.linalg.eigvalsh(moments)[:, 0], 0.0) * fair)


def footprints(points: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """Return the size of a pixel at each point in the camera that shows it largest, (n,).

    0 where no camera looks.
    """
    finest = np.full(len(points), np.inf)
    for camera in cameras:
        pixel, depth = camera.project(points)
        inside = (depth > 0) & (pixel >= 0).all(1)
        inside &= (pixel[:, 0] <= camera.width) & (pixel[:, 1] <= camera.height)
        size = depth / max(camera.fx, camera.fy)
        finest = np.where(inside, np.minimum(finest, size), finest)
    return np.where(np.isfinite(finest), finest, 0.0)


@dataclass(frozen=True)
class Spacing:
    """Local thinning radii, known at some points of the surface."""

    points: np.ndarray
    """(n, 3) float64."""
    radii: np.ndarray
    """(n,) float64."""
    nominal: float
    """Radius that answers to the requested edge length."""
    limited: float
    """Share of the area where the photos resolve no finer edges."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "_tree", cKDTree(self.points))

    @classmethod
    def uniform(cls, radius: float) -> Spacing:
        """The same everywhere."""
        return cls(np.zeros((1, 3)), np.array([radius]), radius, 0.0)

    def at(self, where: np.ndarray, threads: int = 1) -> np.ndarray:
        """Return the radius at each of (m, 3) points, growing with the distance to known ones."""
        if len(self.points) == 1:
            return np.full(len(where), self.radii[0])
        k = min(4, len(self.points))
        distance, index = self._tree.query(where, k=k, workers=threads)  # type: ignore[attr-defined]
        weight = 1.0 / (distance**2 + (0.5 * self.radii[index]) ** 2)
        mean = (weight * self.radii[index]).sum(1) / weight.sum(1)
        return mean + GRADING / EDGE_PER_RADIUS * np.maximum(distance[:, 0] - mean, 0.0)


def adaptive_spacing(
    points: np.ndarray,
    shape: Shape,
    pixels: np.ndarray,
    area: float,
    *,
    edge_length: float,
    budget: int,
    uniform_edge: float,
) -> Spacing:
    """Choose edge lengths by curvature and footprint, for an edge length or a number of points.

    Parameters
    ----------
    points : (n, 3) float64
        Of ``shape``, spread evenly.
    pixels : (n,) float64
        From :func:`footprints`.
    area : float
        Of the surface.
    edge_length : float
        Of strongly curved parts, or 0.
    budget : int
        Number of points where no edge length is given.
    uniform_edge : float
        Edges of the mesh with as many points, or the edge length itself.
    """
    low, high = SHORTEST_SHARE * uniform_edge, LONGEST_SHARE * uniform_edge
    thin = np.maximum(EDGES_PER_THICKNESS * shape.thickness, uniform_edge)
    turning = _turn_limits(shape)
    floor = edge_length if edge_length > 0 else low
    pixel_floor = EDGE_PER_PIXEL * pixels
    neighbours = cKDTree(points).query(points, k=min(8, len(points)))

    def edges(factor: float) -> np.ndarray:
        wanted = np.clip(_by_curvature(shape, factor), floor, high)
        wanted = np.maximum(wanted, pixel_floor)
        # Thin parts must stay whole, whatever was asked for.
        wanted = np.minimum(wanted, np.maximum(np.minimum(turning, thin), low))
        return graded(wanted, *neighbours)

    if edge_length > 0:
        factor = _factor_where(lambda f: _short_edge(shape, f) - edge_length)
    else:
        factor = _factor_where(lambda f: budget - points_for(edges(f), area))
    chosen = edges(factor)
    nominal = edge_length or float(np.sqrt(1.0 / np.mean(chosen**-2.0)))
    limited = float(np.mean(_by_curvature(shape, factor) < pixel_floor))
    return Spacing(points, chosen / EDGE_PER_RADIUS, nominal / EDGE_PER_RADIUS, limited)


def points_for(edges: np.ndarray, area: float) -> float:
    """Return about how many points a surface gets, from edge lengths at evenly spread places."""
    return POINTS_PER_SQUARE * area * float(np.mean((edges / EDGE_PER_RADIUS) ** -2.0))


def graded(edges: np.ndarray, distance: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Shorten edges until neighbours differ by at most :data:`GRADING` times their distance.

    Parameters
    ----------
    edges : (n,) float64
    distance, index : (n, k)
        Nearest neighbours of each point.
    """
    result = edges
    step = GRADING * distance
    while True:
        # Both ways: the nearest of a point need not have it among their own.
        lower = np.minimum(result, (result[index] + step).min(1))
        np.minimum.at(lower, index, lower[:, None] + step)
        if (lower > 0.99 * result).all():
            return lower
        result = lower


def _by_curvature(shape: Shape, factor: float) -> np.ndarray:
    """Return ``factor * curvature**-CURVATURE_POWER``, with the curvature at that very scale."""
    tiny = 1e-6 / shape.scales[-1]
    wanted = factor * np.maximum(shape.curvatures, tiny) ** -CURVATURE_POWER  # (n, k)
    room = np.log(wanted / shape.scales)  # positive: longer edges than this scale will do
    fits = room >= 0
    last = len(shape.scales) - 1
    # The largest scale that fits; between it and the next the crossing is interpolated.
    at = np.where(fits.any(1), last - fits[:, ::-1].argmax(1), 0)
    rows = np.arange(len(wanted))
    here, beyond = room[rows, at], room[rows, np.minimum(at + 1, last)]
    inner = (here >= 0) & (at < last)
    part = np.where(inner, here / np.where(inner, here - beyond, 1.0), 0.0)
    return np.where(inner, shape.scales[at] * SCALE_STEP**part, wanted[rows, at])


def _turn_limits(shape: Shape) -> np.ndarray:
    """Return the longest edge over which thin parts do not turn too far, infinite elsewhere."""
    most = TURN_PER_EDGE / math.sqrt(2.0)  # mean over a disc, instead of at its rim
    far = shape.turns > most
    first = far.argmax(1)
    rows = np.arange(len(far))
    limit = shape.scales[first] * np.minimum(1.0, most / np.maximum(shape.turns[rows, first], most))
    thin = shape.thickness < shape.scales[first]
    return np.where(far.any(1) & thin, limit, np.inf)


def _short_edge(shape: Shape, factor: float) -> float:
    """Return the edge length below which :data:`SHORT_SHARE` of the vertices would have theirs."""
    edges = np.sort(_by_curvature(shape, factor))
    vertices = np.cumsum(edges**-2.0)
    return float(edges[np.searchsorted(vertices, SHORT_SHARE * vertices[-1])])


def _factor_where(excess: Callable[[float], float]) -> float:
    """Return where an increasing function of the factor passes 0, or an end of the range."""
    low, high = -60.0, 60.0  # of its logarithm: lengths of any unit
    for _ in range(40):
        middle = (low + high) / 2
        if excess(math.exp(middle)) < 0:
            low = middle
        else:
            high = middle
    return math.exp((low + high) / 2)
