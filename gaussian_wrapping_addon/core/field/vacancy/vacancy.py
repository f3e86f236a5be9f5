# SPDX-License-Identifier: GPL-3.0-or-later
"""Vacancy field: the largest transmittance to a point from any camera that sees it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ... import tolerances
from ...dataset.camera import Camera
from ...errors import UsageError
from ...gaussians.model import GaussianArrays
from ...kernels.parallel import (
    CHUNKS_PER_THREAD,
    balanced_bounds,
    default_threads,
    even_bounds,
    run_chunks,
)
from ...machine import total_memory_bytes
from ...progress import Progress
from .camera_bins import TILE_PX, CameraBins, VirtualScreen, bin_camera
from .photo_masks import MaskMode, PackedMask, checked_masks, masked_points
from .vacancy_kernels import project_points, sort_by_cell, transmittance_of_cells

SETTLED = 1.0 - 1e-3
"""Points with a higher vacancy are not evaluated from further cameras."""
POINTS_PER_PASS = 1 << 21
CACHE_SHARE = 0.25
"""Share of the machine's memory for prepared cameras."""
CACHE_BYTES_UNKNOWN = 1 << 30
POINTS_PER_CELL = 40
"""Target number of points per cell: fewer waste SIMD lanes, more lengthen the lists of
Gaussians."""
MAX_CELL_SHIFT = 3

Unseen = Literal["empty", "occupied", "invalid"]
_UNSEEN_VALUES = {"empty": 1.0, "occupied": 0.0, "invalid": float("nan")}


@dataclass(frozen=True)
class VacancyResult:
    """Vacancy of points and their arg-max cameras."""

    vacancy: np.ndarray
    """(n,) float32 in [0, 1]; 1 is empty, the surface is at 0.5. Values above 0.999 are lower
    bounds, values below 1e-4 are 0. NaN where no camera sees the point, if unseen is invalid."""
    camera: np.ndarray
    """(n,) int32: the camera that sees the point best, or -1 where none sees it."""

    @property
    def filled(self) -> np.ndarray:
        """(n,) float32: vacancy with invalid points as empty, as in meshing."""
        return np.where(np.isnan(self.vacancy), np.float32(1.0), self.vacancy)


def default_cache_bytes() -> int:
    """Return the default memory for prepared cameras on this machine."""
    return int(CACHE_SHARE * total_memory_bytes()) or CACHE_BYTES_UNKNOWN


class VacancyField:
    """``v(x) = max over cameras c that see x of prod_i (1 - G_i(o_c + min(t, t*_i) w))``.

    The transmittance is that of training (docs/method.md, sections 2.4 and 5.1): exact in three
    dimensions, with Gaussians truncated to their footprint ``alpha >= 1/255``. Where the truncated
    tails of m Gaussians overlap, vacancy is too large by at most ``1 - (1 - 1/255)^m``: on a dense
    shell by 0.0045 (median) to 0.012 (largest) near the surface, and up to 0.018 where vacancy is
    0.9. In depth, only tails below 1e-5 are truncated. Gaussians whose centre is not deeper than
    ``near_z`` are ignored, as in training. A camera sees a point that lies in its image and deeper
    than ``near_z``. Pixels and depths are float32: a Gaussian thinner than about 1e-6 of its
    distance is blurred to that.

    Results do not depend on ``threads``. They depend on earlier calls only where vacancy exceeds
    0.999, as cameras that were the arg-max most often are evaluated first.

    Parameters
    ----------
    arrays : GaussianArrays
    cameras : sequence of Camera
        In the scene frame, of any resolution: vacancy does not depend on it.
    threads : int
        0 uses every core.
    unseen : {"empty", "occupied", "invalid"}
        Vacancy 1, 0 or NaN of points that no camera sees (docs/method.md, section 5.3). Invalid
        points count as empty in :meth:`is_empty`, and ``unseen_evaluations`` counts them.
    masks : sequence of (h, w) bool, PackedMask or None, optional
        One per camera, true where its photo counts, of any resolution.
    mask_mode : {"ignore", "background"}
        Points in masked pixels are unseen by the camera; or known to be empty, whatever other
        cameras see, provided that training used the same mode.
    region_bounds : (2, 3) float64, optional
        Box that contains all query points, scene frame. Cameras that do not see it and Gaussians
        that cannot affect it are skipped, which saves time and memory and changes no value. Points
        outside it count as unseen.
    near_z : float
        Scene units.
    cache_bytes : int, optional
        Memory for projected and binned cameras, by default a quarter of the machine's; other
        cameras are prepared again in each call (about 120 bytes per Gaussian).

    Raises
    ------
    UsageError
        There are no cameras, or the bounds, masks or ``unseen`` are invalid.
    """

    def __init__(
        self,
        arrays: GaussianArrays,
        cameras: Sequence[Camera],
        *,
        threads: int = 0,
        unseen: Unseen = "empty",
        region_bounds: np.ndarray | None = None,
        near_z: float = tolerances.NEAR_Z,
        cache_bytes: int | None = None,
        masks: Sequence[np.ndarray | PackedMask | None] | None = None,
        mask_mode: MaskMode = "ignore",
    ) -> None:
        if len(cameras) == 0:
            raise UsageError("Vacancy needs at least one camera.", "Check the scene's views.")
        if unseen not in _UNSEEN_VALUES:
            raise UsageError(f"unseen is {unseen!r}.", 'Use "empty", "occupied" or "invalid".')
        self.arrays = arrays
        self.cameras = tuple(cameras)
        self.threads = threads or default_threads()
        self.unseen: Unseen = unseen
        self.near_z = near_z
        self.device = "cpu"
        """Device of the evaluation, in torch's notation."""
        self.region_bounds: np.ndarray | None = None
        if region_bounds is not None:
            bounds = np.asarray(region_bounds, np.float64)
            if bounds.shape != (2, 3) or not (bounds[0] <= bounds[1]).all():
                raise UsageError("Region bounds are not a lowest and a highest corner.")
            self.region_bounds = bounds
        self.wins = np.zeros(len(self.cameras), np.int64)
        """Number of times that each camera was the arg-max."""
        self.evaluations = 0
        """Number of points evaluated."""
        self.unseen_evaluations = 0
        """Number of those points that no camera sees."""
        self._masks = checked_masks(masks, self.cameras, mask_mode)
        self._mask_mode = mask_mode
        self._screens = [VirtualScreen.of(camera, near_z) for camera in self.cameras]
        self._cache: dict[int, CameraBins | None] = {}
        self._cache_left = default_cache_bytes() if cache_bytes is None else cache_bytes

    def prepare(self, progress: Progress | None = None) -> None:
        """Project and bin the Gaussians for all cameras now, as far as memory allows.

        Otherwise this is done by the first query that needs a camera.
        """
        progress = progress or Progress()
        for done, index in enumerate(self.evaluation_order().tolist()):
            progress.update(done / len(self.cameras), "Preparing cameras")
            self._bins(index)

    def vacancy(self, points: np.ndarray, progress: Progress | None = None) -> VacancyResult:
        """Evaluate vacancy and its arg-max camera at (n, 3) float64 scene points."""
        points = np.ascontiguousarray(points, np.float64).reshape(-1, 3)
        vacancy = np.empty(len(points), np.float32)
        camera = np.empty(len(points), np.int32)
        progress = progress or Progress()
        for begin, end, part in self._passes(len(points), progress):
            best = np.full(end - begin, -1.0, np.float32)
            winner = np.full(end - begin, -1, np.int32)
            self._raise_best(points[begin:end], SETTLED, best, winner, None, part)
            seen = winner >= 0
            self.wins += np.bincount(winner[seen], minlength=len(self.cameras))
            self.unseen_evaluations += int((~seen).sum())
            vacancy[begin:end] = np.where(seen, best, self._unseen_value)
            camera[begin:end] = winner
        return VacancyResult(vacancy, camera)

    def is_empty(
        self,
        points: np.ndarray,
        progress: Progress | None = None,
        *,
        level: float = tolerances.ISO_LEVEL,
    ) -> np.ndarray:
        """Tell whether vacancy exceeds ``level``, without finding its value.

        Equal to ``vacancy(points).vacancy > level`` for levels from 1e-4 to 0.999, but a point is
        finished at the first camera that finds it empty, and the evaluation from a camera stops as
        soon as the point cannot be empty for it.

        Returns
        -------
        (n,) bool
        """
        points = np.ascontiguousarray(points, np.float64).reshape(-1, 3)
        level32 = np.float32(level)
        out = np.empty(len(points), bool)
        progress = progress or Progress()
        for begin, end, part in self._passes(len(points), progress):
            best = np.full(end - begin, level32)
            winner = np.full(end - begin, -1, np.int32)
            seen = np.zeros(end - begin, bool)
            self._raise_best(points[begin:end], float(level32), best, winner, seen, part)
            won = winner[best > level32]
            self.wins += np.bincount(won, minlength=len(self.cameras))
            self.unseen_evaluations += int((~seen).sum())
            out[begin:end] = np.where(seen, best > level32, not self._unseen_value <= level)
        return out

    def transmittance(self, points: np.ndarray, camera_index: int) -> np.ndarray:
        """Evaluate (n,) float32 transmittance from one camera; NaN where it does not see."""
        points = np.ascontiguousarray(points, np.float64).reshape(-1, 3)
        best = np.full(len(points), -1.0, np.float32)
        winner = np.full(len(points), -1, np.int32)
        for begin in range(0, len(points), POINTS_PER_PASS):
            end = min(begin + POINTS_PER_PASS, len(points))
            inside = self._in_region(points[begin:end])
            self._evaluate_camera(
                camera_index, points[begin:end], inside, 2.0, best[begin:end], winner[begin:end]
            )
        return np.where(winner >= 0, best, np.float32(np.nan))

    def evaluation_order(self) -> np.ndarray:
        """Return camera indices, most frequent arg-max first; ties are spread over the list."""
        count = len(self.cameras)
        bits = max(1, (count - 1).bit_length())
        index = np.arange(count)
        spread = np.zeros(count, np.int64)
        for bit in range(bits):  # bit reversal: neighbours in the list have similar views
            spread |= ((index >> bit) & 1) << (bits - 1 - bit)
        return np.lexsort((spread, -self.wins))

    # -- inside -----------------------------------------------------------------------------------

    @property
    def _unseen_value(self) -> float:
        return _UNSEEN_VALUES[self.unseen]

    def _passes(self, count: int, progress: Progress) -> list[tuple[int, int, Progress]]:
        self.evaluations += count
        begins = range(0, count, POINTS_PER_PASS)
        return [
            (
                b,
                min(b + POINTS_PER_PASS, count),
                progress.span(b / count, min(b + POINTS_PER_PASS, count) / count),
            )
            for b in begins
        ]

    def _in_region(self, points: np.ndarray) -> np.ndarray | None:
        if self.region_bounds is None:
            return None
        low, high = self.region_bounds
        return ((points >= low) & (points <= high)).all(1)

    def _bins(self, index: int) -> CameraBins | None:
        if index in self._cache:
            return self._cache[index]
        bins = bin_camera(
            self.arrays, self._screens[index], self.near_z, self.region_bounds, self.threads
        )
        size = 0 if bins is None else bins.size_bytes
        # Nothing is evicted: cameras are used cyclically, so the oldest is needed next.
        if size <= self._cache_left:
            self._cache[index] = bins
            self._cache_left -= size
        return bins

    def _apply_mask(
        self,
        index: int,
        screen: np.ndarray,
        cells: np.ndarray,
        best: np.ndarray,
        winner: np.ndarray,
        seen: np.ndarray | None,
    ) -> None:
        """Mark masked points as unseen by the camera, or settle them as empty."""
        mask, virtual = self._masks[index], self._screens[index].camera
        assert mask is not None
        masked = np.empty(len(cells), np.bool_)
        scale_x, scale_y = mask.shape[1] / virtual.width, mask.shape[0] / virtual.height
        run_chunks(
            lambda begin, end: masked_points(
                begin, end, screen, cells, mask.bits, mask.width, scale_x, scale_y, masked
            ),
            even_bounds(len(cells), self.threads),
            self.threads,
        )
        cells[masked] = -1
        if self._mask_mode == "background":
            best[masked], winner[masked] = 1.0, index
            if seen is not None:
                seen |= masked

    def _raise_best(
        self,
        points: np.ndarray,
        settled: float,
        best: np.ndarray,
        winner: np.ndarray,
        seen: np.ndarray | None,
        progress: Progress,
    ) -> None:
        inside = self._in_region(points)
        order = self.evaluation_order()
        for done, index in enumerate(order.tolist()):
            self._evaluate_camera(index, points, inside, settled, best, winner, seen)
            progress.update((done + 1) / len(order), "Evaluating transmittance per camera")

    def _evaluate_camera(
        self,
        index: int,
        points: np.ndarray,
        inside: np.ndarray | None,
        settled: float,
        best: np.ndarray,
        winner: np.ndarray,
        seen: np.ndarray | None = None,
    ) -> None:
        if len(points) == 0:
            return
        view = self._screens[index]
        shift = 0
        while (
            shift < MAX_CELL_SHIFT
            and view.tiles << (2 * shift + 2) <= len(points) // POINTS_PER_CELL
        ):
            shift += 1
        screen = np.empty((len(points), 3), np.float32)
        cells = np.empty(len(points), np.int32)

        def project(begin: int, end: int) -> None:
            project_points(
                begin, end, points, view.packed, np.float32(settled), best, TILE_PX, shift,
                view.tiles_x, view.tiles_y, screen, cells,
            )  # fmt: skip

        run_chunks(project, even_bounds(len(points), self.threads), self.threads)
        if inside is not None:
            cells[~inside] = -1
        if self._masks[index] is not None:
            self._apply_mask(index, screen, cells, best, winner, seen)
        if seen is not None:
            seen |= cells >= 0
        start = np.zeros((view.tiles << (2 * shift)) + 2, np.int64)
        order = np.empty(len(points), np.int32)
        if sort_by_cell(cells, start, order) == 0:
            return
        bins = self._bins(index)
        assert bins is not None, "a camera that sees a point of the region sees the region"

        def evaluate(begin: int, end: int) -> None:
            transmittance_of_cells(
                begin, end, start, order, screen, bins.rows, bins.bounds, bins.tile_start,
                bins.tile_ids, bins.longest_list, shift, index, best, winner,
            )  # fmt: skip

        points_in_cell = np.diff(start[:-1])
        length = np.repeat(np.diff(bins.tile_start), 1 << (2 * shift))
        costs = points_in_cell * (length + 16) + (points_in_cell > 0) * length
        bounds = balanced_bounds(costs, self.threads * CHUNKS_PER_THREAD)
        run_chunks(evaluate, bounds, self.threads)
