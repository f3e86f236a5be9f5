# SPDX-License-Identifier: GPL-3.0-or-later
"""Colours in space fitted to photos, whatever the mesh's faces."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..compiled import inline, kernel
from ..parallel import even_bounds, run_chunks
from ..progress import Progress
from ..scene.camera import Camera

# -- Contract unbounded space to a ball in which a pixel's footprint hardly grows with distance


MIN_RADIUS_SHARE = 0.1
"""Least radius as a share of the distance to what is seen: without it cameras in one place would
leave no inside."""


@dataclass(frozen=True)
class Contraction:
    """Identity within a ball around the cameras, ``(2 - 1 / n) x / n`` outside (n in radii).

    The map of Mip-NeRF 360 (docs/method.md, section 9.3), which the published colour field uses.
    """

    center: np.ndarray  # (3,) float64, world frame
    radius: float  # world units

    @classmethod
    def of_cameras(cls, cameras: Sequence[Camera], distance: float) -> Contraction:
        """Return the contraction around the mean camera centre, out to the farthest one.

        ``distance`` is a typical one of the surface from the cameras, world units, > 0.
        """
        centers = np.array([camera.center for camera in cameras])
        center = centers.mean(axis=0)
        spread = float(np.linalg.norm(centers - center, axis=1).max())
        return cls(center, max(spread, MIN_RADIUS_SHARE * distance))

    def points(self, points: np.ndarray) -> np.ndarray:
        """Map (n, 3) world points into the ball of radius 2; float64."""
        local = (np.asarray(points, np.float64) - self.center) / self.radius
        norm = np.maximum(np.linalg.norm(local, axis=1, keepdims=True), 1.0)
        return local * ((2.0 - 1.0 / norm) / norm)

    def scales(self, points: np.ndarray) -> np.ndarray:
        """Return (n,) contracted lengths per world length, across the direction to the centre."""
        local = (np.asarray(points, np.float64) - self.center) / self.radius
        norm = np.maximum(np.linalg.norm(local, axis=1), 1.0)
        return (2.0 - 1.0 / norm) / (norm * self.radius)


# -- Sparse cubic lattice: only the cells that hold a sample exist, in two nested sizes -----------


RATIO = 4  # coarse cells are this many fine cells wide
_AXIS_BITS = 19
"""Bits of a coarse cell's index along an axis: three of them and a fine cell's number within the
coarse one (6 bits) fill 63 bits."""
MIN_CELL = 4.0 / (RATIO * ((1 << _AXIS_BITS) - 2))
"""Smallest side of a fine cell, so that all of the contracted space (4 across) can be numbered."""
CORNERS = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)], np.int64)
"""(8, 3) offsets of a cell's corners; corner ``4 i + 2 j + k``."""


@dataclass(frozen=True)
class Level:
    """Cells of one size and their corners."""

    cells: np.ndarray  # (c,) int64 keys, increasing
    corners: np.ndarray  # (c, 8) int32: vertices of each cell
    vertices: np.ndarray  # (v,) int64 keys, increasing
    incident: np.ndarray
    """(v, 8) int32: ``8 cell + corner`` of the cells around a vertex, -1 where there is none."""

    @classmethod
    def of_cells(cls, keys: np.ndarray, indices: np.ndarray) -> Level:
        """Return the level of cells of increasing keys (c,), from their indices (c, 3) int64."""
        corner_keys = pack(indices[:, None, :] + CORNERS)  # (c, 8)
        vertices, inverse = np.unique(corner_keys, return_inverse=True)
        corners = inverse.reshape(corner_keys.shape).astype(np.int32)
        incident = np.full((len(vertices), 8), -1, np.int32)
        numbers = np.arange(len(keys), dtype=np.int32) * 8
        for corner in range(8):
            incident[corners[:, corner], corner] = numbers + corner
        return cls(keys, corners, vertices, incident)

    def find(self, keys: np.ndarray, indices: np.ndarray) -> np.ndarray:
        """Return (n, 8) int32 vertices of the given cells, -1 where the lattice has none."""
        found = _search(self.cells, keys)
        vertices = self.corners[found.clip(0)]
        missing = np.flatnonzero(found < 0)
        vertices[missing] = _search(self.vertices, pack(indices[missing][:, None, :] + CORNERS))
        return vertices


def pack(indices: np.ndarray) -> np.ndarray:
    """Return one int64 for three indices (..., 3), each >= 0 and below 2^21."""
    return (indices[..., 0] << 42) | (indices[..., 1] << 21) | indices[..., 2]


def locate(points: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the fine cells of contracted points and the positions in them.

    Points are (n, 3) float64 in [-2, 2]; ``cell`` is the side of a fine cell, at least
    :data:`MIN_CELL`.

    Returns
    -------
    keys : (n,) int64
        ``key // RATIO^3`` numbers the coarse cell, so that in increasing order all fine cells of a
        coarse one are together.
    indices : (n, 3) int64
        Of the fine cells along each axis.
    places : (n, 3) float32
        In [0, 1).
    """
    scaled = (points + 2.0) / cell
    indices = np.floor(scaled).astype(np.int64)
    places = (scaled - indices).astype(np.float32)
    coarse, sub = indices // RATIO, indices % RATIO
    inside = (sub[:, 0] * RATIO + sub[:, 1]) * RATIO + sub[:, 2]
    number = (coarse[:, 0] << _AXIS_BITS | coarse[:, 1]) << _AXIS_BITS | coarse[:, 2]
    return number * RATIO**3 + inside, indices, places


def _search(sorted_keys: np.ndarray, keys: np.ndarray) -> np.ndarray:
    """Return the positions of keys in an increasing array, int32, -1 where absent."""
    at = np.searchsorted(sorted_keys, keys).clip(0, len(sorted_keys) - 1)
    return np.where(sorted_keys[at] == keys, at, -1).astype(np.int32)


# -- Compiled products of the colour field: samples from coefficients, and back -------------------
#
# The colour of a sample is that of two lattices: three values at each fine vertex, and harmonics
# of degree 0 to 2 (9 x 3 values) at each coarse vertex, both interpolated trilinearly.


HARMONICS = 9  # real spherical harmonics of degree 0 to 2
COARSE_VALUES = 3 * HARMONICS


@inline
def _corner_weights(x: Any, y: Any, z: Any, weights: Any) -> None:
    one = np.float32(1.0)
    ax, ay, az = one - x, one - y, one - z
    weights[0] = ax * ay * az
    weights[1] = ax * ay * z
    weights[2] = ax * y * az
    weights[3] = ax * y * z
    weights[4] = x * ay * az
    weights[5] = x * ay * z
    weights[6] = x * y * az
    weights[7] = x * y * z


@inline
def _harmonics(x: Any, y: Any, z: Any, basis: Any) -> None:
    # Scaled so that degree 0 is 1: its coefficient is the mean colour over directions.
    basis[0] = np.float32(1.0)
    basis[1] = np.float32(1.7320508) * x
    basis[2] = np.float32(1.7320508) * y
    basis[3] = np.float32(1.7320508) * z
    basis[4] = np.float32(3.8729833) * x * y
    basis[5] = np.float32(3.8729833) * y * z
    basis[6] = np.float32(1.1180340) * (np.float32(3.0) * z * z - np.float32(1.0))
    basis[7] = np.float32(3.8729833) * x * z
    basis[8] = np.float32(1.9364917) * (x * x - y * y)


@kernel(fast=True)
def normal_product(
    begin: int, end: int, coarse_starts: Any, fine_starts: Any, fine_corners: Any,
    coarse_corners: Any, places: Any, sub_places: Any, directions: Any, colors: Any, share: Any,
    fine: Any, coarse: Any, fine_sums: Any, coarse_sums: Any,
) -> None:  # fmt: skip
    """Write ``A^T (A p - share y)`` of the coarse cells from begin to end, by cell and corner.

    ``coarse_starts`` (c + 1,) numbers the fine cells of each coarse cell, ``fine_starts`` (f + 1,)
    the samples of each fine cell; ``sub_places`` (f, 3) is the fine cell's corner in its coarse
    one, in coarse cells. ``fine_sums`` (f, 8, 3) and ``coarse_sums`` (c, 8, 27) are overwritten.
    """
    weights = np.empty(8, np.float32)
    basis = np.empty(9, np.float32)
    wide = np.empty(8, np.float32)
    # One colour after the other, so that the inner loops run over neighbouring numbers.
    factors = np.empty(72, np.float32)
    own = np.empty((3, 72), np.float32)
    total = np.empty((3, 72), np.float32)
    near = np.empty((8, 3), np.float32)
    near_total = np.empty((8, 3), np.float32)
    quarter = np.float32(0.25)
    for c in range(begin, end):
        for k in range(8):
            vertex = coarse_corners[c, k]
            for h in range(9):
                for j in range(3):
                    own[j, 9 * k + h] = coarse[vertex, 3 * h + j]
                    total[j, 9 * k + h] = np.float32(0.0)
        for f in range(coarse_starts[c], coarse_starts[c + 1]):
            for k in range(8):
                vertex = fine_corners[f, k]
                for j in range(3):
                    near[k, j] = fine[vertex, j]
                    near_total[k, j] = np.float32(0.0)
            for s in range(fine_starts[f], fine_starts[f + 1]):
                x, y, z = places[s, 0], places[s, 1], places[s, 2]
                _corner_weights(x, y, z, weights)
                _corner_weights(
                    sub_places[f, 0] + quarter * x,
                    sub_places[f, 1] + quarter * y,
                    sub_places[f, 2] + quarter * z,
                    wide,
                )
                _harmonics(directions[s, 0], directions[s, 1], directions[s, 2], basis)
                for k in range(8):
                    for h in range(9):
                        factors[9 * k + h] = wide[k] * basis[h]
                red = -share * colors[s, 0]
                green = -share * colors[s, 1]
                blue = -share * colors[s, 2]
                for q in range(72):
                    red += factors[q] * own[0, q]
                    green += factors[q] * own[1, q]
                    blue += factors[q] * own[2, q]
                for k in range(8):
                    red += weights[k] * near[k, 0]
                    green += weights[k] * near[k, 1]
                    blue += weights[k] * near[k, 2]
                for q in range(72):
                    total[0, q] += factors[q] * red
                    total[1, q] += factors[q] * green
                    total[2, q] += factors[q] * blue
                for k in range(8):
                    near_total[k, 0] += weights[k] * red
                    near_total[k, 1] += weights[k] * green
                    near_total[k, 2] += weights[k] * blue
            for k in range(8):
                for j in range(3):
                    fine_sums[f, k, j] = near_total[k, j]
        for k in range(8):
            for h in range(9):
                for j in range(3):
                    coarse_sums[c, k, 3 * h + j] = total[j, 9 * k + h]


@kernel(fast=True)
def diagonal(
    begin: int, end: int, coarse_starts: Any, fine_starts: Any, places: Any, sub_places: Any,
    directions: Any, fine_sums: Any, coarse_sums: Any,
) -> None:  # fmt: skip
    """Write the diagonal of ``A^T A`` by cell and corner: (f, 8, 1) and (c, 8, 9)."""
    weights = np.empty(8, np.float32)
    basis = np.empty(9, np.float32)
    wide = np.empty(8, np.float32)
    quarter = np.float32(0.25)
    for c in range(begin, end):
        for k in range(8):
            for h in range(9):
                coarse_sums[c, k, h] = np.float32(0.0)
        for f in range(coarse_starts[c], coarse_starts[c + 1]):
            for k in range(8):
                fine_sums[f, k, 0] = np.float32(0.0)
            for s in range(fine_starts[f], fine_starts[f + 1]):
                x, y, z = places[s, 0], places[s, 1], places[s, 2]
                _corner_weights(x, y, z, weights)
                _corner_weights(
                    sub_places[f, 0] + quarter * x,
                    sub_places[f, 1] + quarter * y,
                    sub_places[f, 2] + quarter * z,
                    wide,
                )
                _harmonics(directions[s, 0], directions[s, 1], directions[s, 2], basis)
                for k in range(8):
                    fine_sums[f, k, 0] += weights[k] * weights[k]
                    for h in range(9):
                        coarse_sums[c, k, h] += (wide[k] * basis[h]) ** 2


@kernel(fast=True)
def gather(begin: int, end: int, incident: Any, sums: Any, out: Any) -> None:
    """Add up the parts (8 c, m) of the cells around each vertex from begin to end, into (v, m)."""
    for v in range(begin, end):
        for j in range(out.shape[1]):
            out[v, j] = np.float32(0.0)
        for k in range(8):
            at = incident[v, k]
            if at >= 0:
                for j in range(out.shape[1]):
                    out[v, j] += sums[at, j]


@kernel(fast=True)
def field_colors(
    begin: int, end: int, fine_vertices: Any, coarse_vertices: Any, places: Any,
    coarse_places: Any, directions: Any, fine: Any, coarse: Any, out: Any,
) -> None:  # fmt: skip
    """Write the colours (n, 3) at points whose corners are given, -1 where there is no vertex.

    A missing fine vertex has the value 0; missing coarse ones leave their weight to the others.
    """
    weights = np.empty(8, np.float32)
    basis = np.empty(9, np.float32)
    for s in range(begin, end):
        red = green = blue = np.float32(0.0)
        _corner_weights(coarse_places[s, 0], coarse_places[s, 1], coarse_places[s, 2], weights)
        _harmonics(directions[s, 0], directions[s, 1], directions[s, 2], basis)
        present = np.float32(0.0)
        for k in range(8):
            vertex = coarse_vertices[s, k]
            if vertex >= 0:
                w = weights[k]
                present += w
                for h in range(9):
                    red += w * basis[h] * coarse[vertex, 3 * h]
                    green += w * basis[h] * coarse[vertex, 3 * h + 1]
                    blue += w * basis[h] * coarse[vertex, 3 * h + 2]
        if present > np.float32(0.0):
            red, green, blue = red / present, green / present, blue / present
        _corner_weights(places[s, 0], places[s, 1], places[s, 2], weights)
        for k in range(8):
            vertex = fine_vertices[s, k]
            if vertex >= 0:
                red += weights[k] * fine[vertex, 0]
                green += weights[k] * fine[vertex, 1]
                blue += weights[k] * fine[vertex, 2]
        out[s, 0], out[s, 1], out[s, 2] = red, green, blue


# -- Fit a view-dependent field of colours to samples in space (docs/method.md, section 9.3) ------


@dataclass(frozen=True)
class ColorFieldSettings:
    """How fine the field is and how it is solved."""

    cell_px: float = 1.0  # side of a fine cell in median footprints of a pixel
    iterations: int = 20  # steps of conjugate gradients
    fine_ridge: float = 0.5
    """Pull of each fine value towards 0, in samples: a vertex with fewer samples than this takes
    its colour from the coarse lattice."""
    mean_ridge: float = 0.02  # pull of the coarse colours towards the mean colour, in samples
    view_ridge: float = 2.0  # pull of the harmonics of degree 1 and 2 towards 0, in samples


@dataclass(frozen=True)
class Samples:
    """Coloured points of a surface."""

    points: np.ndarray  # (n, 3) float64, world frame
    directions: np.ndarray  # (n, 3) float32, unit, from the camera to the point
    footprints: np.ndarray  # (n,) float32: side of a pixel at the point, world units
    colors: np.ndarray  # (n, 3) float32, white is 1


@dataclass(frozen=True)
class ColorField:
    """A fitted field."""

    contraction: Contraction
    cell: float  # side of a fine cell, contracted units
    mean: np.ndarray  # (3,) float32: colour far from every sample
    levels: tuple[Level, Level]  # fine and coarse
    fine: np.ndarray  # (v, 3) float32
    coarse: np.ndarray  # (w, 27) float32: harmonic by harmonic, red, green, blue

    def colors(self, points: np.ndarray, directions: np.ndarray, *, threads: int = 1) -> np.ndarray:
        """Return (n, 3) float32 colours in [0, 1] of (n, 3) world points seen along directions."""
        keys, indices, places = locate(self.contraction.points(points), self.cell)
        wide = indices // RATIO
        coarse_places = ((indices % RATIO + places) / RATIO).astype(np.float32)
        near = self.levels[0].find(keys, indices)
        far = self.levels[1].find(keys // RATIO**3, wide)
        directions = np.ascontiguousarray(directions, np.float32)
        out = np.empty((len(points), 3), np.float32)

        def run(begin: int, end: int) -> None:
            field_colors(
                begin, end, near, far, places, coarse_places, directions, self.fine, self.coarse,
                out,
            )  # fmt: skip

        run_chunks(run, even_bounds(len(points), threads), threads)
        return np.clip(out + self.mean, 0.0, 1.0)


def fit_color_field(
    samples: Samples, contraction: Contraction, settings: ColorFieldSettings, progress: Progress,
    *, threads: int = 1,
) -> ColorField:  # fmt: skip
    """Return the field of least squared error at the samples, by conjugate gradients.

    There must be a sample; the result does not depend on ``threads``.
    """
    scales = contraction.scales(samples.points)
    cell = settings.cell_px * float(np.median(samples.footprints * scales))
    system = _System.of(samples, contraction, max(cell, MIN_CELL), settings, threads)
    fine, coarse = system.solve(settings.iterations, progress)
    return ColorField(contraction, system.cell, system.mean, system.levels, fine, coarse)


@dataclass(frozen=True)
class _System:
    """The normal equations, never written out: samples sorted by coarse and fine cell."""

    cell: float
    mean: np.ndarray
    levels: tuple[Level, Level]
    coarse_starts: np.ndarray
    fine_starts: np.ndarray
    places: np.ndarray
    sub_places: np.ndarray
    directions: np.ndarray
    colors: np.ndarray
    ridges: tuple[np.ndarray, np.ndarray]
    threads: int

    @classmethod
    def of(
        cls, samples: Samples, contraction: Contraction, cell: float, settings: ColorFieldSettings,
        threads: int,
    ) -> _System:  # fmt: skip
        keys, indices, places = locate(contraction.points(samples.points), cell)
        order = np.argsort(keys, kind="stable")
        keys = keys[order]
        first = np.flatnonzero(np.diff(keys, prepend=-1))
        fine_keys, fine_indices = keys[first], indices[order[first]]
        coarse_keys = fine_keys // RATIO**3
        coarse_first = np.flatnonzero(np.diff(coarse_keys, prepend=-1))
        fine = Level.of_cells(fine_keys, fine_indices)
        coarse = Level.of_cells(coarse_keys[coarse_first], fine_indices[coarse_first] // RATIO)
        mean = samples.colors.mean(axis=0, dtype=np.float64).astype(np.float32)
        view = np.full(COARSE_VALUES, settings.view_ridge, np.float32)
        view[:3] = settings.mean_ridge
        return cls(
            cell, mean, (fine, coarse), np.append(coarse_first, len(fine_keys)),
            np.append(first, len(keys)), np.ascontiguousarray(places[order]),
            ((fine_indices % RATIO) / RATIO).astype(np.float32),
            np.ascontiguousarray(samples.directions[order], np.float32),
            np.ascontiguousarray(samples.colors[order] - mean, np.float32),
            (np.full(3, settings.fine_ridge, np.float32), view), threads,
        )  # fmt: skip

    def solve(self, iterations: int, progress: Progress) -> tuple[np.ndarray, np.ndarray]:
        """Run conjugate gradients from 0 with the diagonal as preconditioner."""
        fine, coarse = self.levels
        shapes = (len(fine.vertices), 3), (len(coarse.vertices), COARSE_VALUES)
        found = [np.zeros(shape, np.float32) for shape in shapes]
        residual = [-part for part in self._product(found, 1.0)]
        inverse = self._inverse_diagonal()
        steered = [a * b for a, b in zip(inverse, residual, strict=True)]
        direction = [part.copy() for part in steered]
        energy = _dot(residual, steered)
        for step in range(iterations):
            progress.update(step / iterations, "fitting the colour field")
            if energy <= 0.0:
                break
            image = self._product(direction, 0.0)
            for part, ridge, own in zip(image, self.ridges, direction, strict=True):
                part += ridge * own
            length = np.float32(energy / _dot(direction, image))
            for k in range(2):
                found[k] += length * direction[k]
                residual[k] -= length * image[k]
                np.multiply(inverse[k], residual[k], out=steered[k])
            before, energy = energy, _dot(residual, steered)
            for k in range(2):
                direction[k] *= np.float32(energy / before)
                direction[k] += steered[k]
        return found[0], found[1]

    def _product(self, values: list[np.ndarray], share: float) -> list[np.ndarray]:
        """Return ``A^T (A values - share colours)``."""
        fine, coarse = self.levels
        fine_sums = np.empty((len(fine.cells), 8, 3), np.float32)
        coarse_sums = np.empty((len(coarse.cells), 8, COARSE_VALUES), np.float32)

        def run(begin: int, end: int) -> None:
            normal_product(
                begin, end, self.coarse_starts, self.fine_starts, fine.corners, coarse.corners,
                self.places, self.sub_places, self.directions, self.colors, np.float32(share),
                values[0], values[1], fine_sums, coarse_sums,
            )  # fmt: skip

        self._over_cells(run)
        return [self._gathered(fine, fine_sums), self._gathered(coarse, coarse_sums)]

    def _inverse_diagonal(self) -> list[np.ndarray]:
        fine, coarse = self.levels
        fine_sums = np.empty((len(fine.cells), 8, 1), np.float32)
        coarse_sums = np.empty((len(coarse.cells), 8, HARMONICS), np.float32)

        def run(begin: int, end: int) -> None:
            diagonal(
                begin, end, self.coarse_starts, self.fine_starts, self.places, self.sub_places,
                self.directions, fine_sums, coarse_sums,
            )  # fmt: skip

        self._over_cells(run)
        near = self._gathered(fine, fine_sums)
        far = np.repeat(self._gathered(coarse, coarse_sums), 3, axis=1)
        return [1.0 / (near + self.ridges[0]), 1.0 / (far + self.ridges[1])]

    def _over_cells(self, run: Callable[[int, int], object]) -> None:
        run_chunks(run, even_bounds(len(self.levels[1].cells), self.threads, 16), self.threads)

    def _gathered(self, level: Level, sums: np.ndarray) -> np.ndarray:
        out = np.empty((len(level.vertices), sums.shape[2]), np.float32)
        flat = sums.reshape(-1, sums.shape[2])

        def run(begin: int, end: int) -> None:
            gather(begin, end, level.incident, flat, out)

        run_chunks(run, even_bounds(len(out), self.threads), self.threads)
        return out


def _dot(a: list[np.ndarray], b: list[np.ndarray]) -> float:
    """Return the scalar product; numpy's own sum, so that it does not depend on threads."""
    return sum(float(np.sum(x * y, dtype=np.float64)) for x, y in zip(a, b, strict=True))
