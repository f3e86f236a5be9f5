# SPDX-License-Identifier: GPL-3.0-or-later
"""Fit a view-dependent field of colours to samples in space (docs/method.md, section 9.3)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ...kernels.parallel import even_bounds, run_chunks
from ...progress import Progress
from .contraction import Contraction
from .field_kernels import COARSE_VALUES, HARMONICS, diagonal, field_colors, gather, normal_product
from .lattice import MIN_CELL, RATIO, Level, locate


@dataclass(frozen=True)
class ColorFieldSettings:
    """How fine the field is and how it is solved."""

    cell_px: float = 1.0
    """Side of a fine cell in median footprints of a pixel."""
    iterations: int = 20
    """Steps of conjugate gradients."""
    fine_ridge: float = 0.5
    """Pull of each fine value towards 0, in samples: a vertex with fewer samples than this takes
    its colour from the coarse lattice."""
    mean_ridge: float = 0.02
    """Pull of the coarse colours towards the mean colour, in samples."""
    view_ridge: float = 2.0
    """Pull of the harmonics of degree 1 and 2 towards 0, in samples."""


@dataclass(frozen=True)
class Samples:
    """Coloured points of a surface."""

    points: np.ndarray
    """(n, 3) float64, world frame."""
    directions: np.ndarray
    """(n, 3) float32, unit, from the camera to the point."""
    footprints: np.ndarray
    """(n,) float32: side of a pixel at the point, world units."""
    colors: np.ndarray
    """(n, 3) float32, white is 1."""


@dataclass(frozen=True)
class ColorField:
    """A fitted field."""

    contraction: Contraction
    cell: float
    """Side of a fine cell, contracted units."""
    mean: np.ndarray
    """(3,) float32: colour far from every sample."""
    levels: tuple[Level, Level]
    """Fine and coarse."""
    fine: np.ndarray
    """(v, 3) float32."""
    coarse: np.ndarray
    """(w, 27) float32: harmonic by harmonic, red, green, blue."""

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
    samples: Samples,
    contraction: Contraction,
    settings: ColorFieldSettings,
    progress: Progress,
    *,
    threads: int = 1,
) -> ColorField:
    """Return the field of least squared error at the samples, by conjugate gradients.

    Parameters
    ----------
    samples : Samples
        At least one.
    threads : int
        The result does not depend on it.
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
        cls,
        samples: Samples,
        contraction: Contraction,
        cell: float,
        settings: ColorFieldSettings,
        threads: int,
    ) -> _System:
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
            cell,
            mean,
            (fine, coarse),
            np.append(coarse_first, len(fine_keys)),
            np.append(first, len(keys)),
            np.ascontiguousarray(places[order]),
            ((fine_indices % RATIO) / RATIO).astype(np.float32),
            np.ascontiguousarray(samples.directions[order], np.float32),
            np.ascontiguousarray(samples.colors[order] - mean, np.float32),
            (np.full(3, settings.fine_ridge, np.float32), view),
            threads,
        )

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
