# SPDX-License-Identifier: GPL-3.0-or-later
"""The field under the transmittance of GGGS, as a reference to compare the vacancy with.

docs/method.md, section 2.6: every Gaussian attenuates on the way to its peak and behind it, each
time by a square root. With ``G(t)`` the Gaussian on the ray and ``a`` its value at the peak,

    f(t) = sqrt(1 - G(t))               before the peak
    f(t) = (1 - a) / sqrt(1 - G(t))     behind it

where section 2.4 has ``1 - G(t)`` and ``1 - a``. Both end at ``1 - a``. The transmittance is the
product, and its depth map is where that is 0.5. A point counts as empty where one camera at least
sees it before its depth map, that is where the largest transmittance of all cameras exceeds 0.5:
the same rule as the vacancy's, so the two fields differ by the attenuation alone. As every factor
is at least the method's, so is the field: its solid lies inside the other's.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gaussian_wrapping_addon.core import tolerances
from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.field.vacancy import vacancy as vacancy_module
from gaussian_wrapping_addon.core.field.vacancy.stable_logs import log_gaussian, log_one_minus
from gaussian_wrapping_addon.core.field.vacancy.vacancy import VacancyField
from gaussian_wrapping_addon.core.field.vacancy.vacancy_kernels import project_points, sort_by_cell
from gaussian_wrapping_addon.core.gaussians.model import GaussianArrays
from gaussian_wrapping_addon.core.kernels.compiled import kernel
from gaussian_wrapping_addon.core.kernels.parallel import even_bounds, run_chunks

_LEAST = 1e-7
"""Least ``1 - G``, as in the vacancy's kernel."""
PAIRS_PER_BLOCK = 1_000_000


def log_transmittance(arrays: GaussianArrays, center: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the log transmittance (n,) from a camera centre to points, in float64.

    Every Gaussian at every point, without a cut-off: the definition.

    Parameters
    ----------
    center : (3,) float64
        Scene frame.
    points : (n, 3) float64
        Scene frame.
    """
    points = np.ascontiguousarray(points, np.float64)
    whiten = arrays.rotations.transpose(0, 2, 1) / arrays.scales[:, :, None]  # (m, 3, 3)
    offset = np.einsum("mij,mj->mi", whiten, arrays.means - center)  # (m, 3)
    out = np.empty(len(points))
    block = max(1, PAIRS_PER_BLOCK // max(1, len(arrays)))
    for begin in range(0, len(points), block):
        ray = points[begin : begin + block] - center  # (b, 3), the point is at parameter 1
        step = np.einsum("mij,bj->bmi", whiten, ray)
        length_sq = np.maximum(np.einsum("bmi,bmi->bm", step, step), 1e-300)
        peak = np.maximum(np.einsum("bmi,mi->bm", step, offset) / length_sq, 0.0)
        at_peak = offset - peak[:, :, None] * step
        here = offset - step
        q_peak = np.einsum("bmi,bmi->bm", at_peak, at_peak)
        q_here = np.einsum("bmi,bmi->bm", here, here)
        log_here = log_one_minus(log_gaussian(arrays.log_opacities, q_here))  # log(1 - G)
        log_peak = log_one_minus(log_gaussian(arrays.log_opacities, q_peak))
        factor = np.where(peak > 1.0, 0.5 * log_here, log_peak - 0.5 * log_here)
        out[begin : begin + block] = factor.sum(1)
    return out


def brute_force_field(
    arrays: GaussianArrays, cameras: Sequence[Camera], points: np.ndarray
) -> np.ndarray:
    """Return the field (n,) at points, NaN where no camera sees them; the definition."""
    points = np.ascontiguousarray(points, np.float64).reshape(-1, 3)
    best = np.full(len(points), np.nan)
    for camera in cameras:
        pixels, depth = camera.project(points)
        seen = (depth > tolerances.NEAR_Z) & (pixels >= 0.0).all(1)
        seen &= (pixels[:, 0] <= camera.width) & (pixels[:, 1] <= camera.height)
        rows = np.flatnonzero(seen)
        if len(rows):
            value = np.exp(log_transmittance(arrays, camera.center, points[rows]))
            best[rows] = np.fmax(best[rows], value)
    return best


class EarlierField(VacancyField):
    """The field of the whole model, quick enough to be meshed.

    Queries are those of :class:`VacancyField`, with its cut-offs, so that each mesher can take the
    one field or the other.
    """

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
        screen = np.empty((len(points), 3), np.float32)
        cells = np.empty(len(points), np.int32)
        project_points(
            0, len(points), points, view.packed, np.float32(settled), best,
            vacancy_module.TILE_PX, 0, view.tiles_x, view.tiles_y, screen, cells,
        )  # fmt: skip
        if inside is not None:
            cells[~inside] = -1
        if seen is not None:
            seen |= cells >= 0
        start = np.zeros(view.tiles + 2, np.int64)
        order = np.empty(len(points), np.int32)
        count = sort_by_cell(cells, start, order)
        if count == 0:
            return
        bins = self._bins(index)
        assert bins is not None, "a camera that sees a point of the region sees the region"

        def evaluate(begin: int, end: int) -> None:
            _transmittance(
                begin, end, order, cells, screen, bins.rows, bins.bounds, bins.tile_start,
                bins.tile_ids, index, best, winner,
            )  # fmt: skip

        run_chunks(evaluate, even_bounds(count, self.threads), self.threads)


@kernel(fast=False)
def _transmittance(
    begin, end, order, cells, screen, rows, bounds, tile_start, tile_ids, camera_index, best, winner
):
    """Update ``best`` and ``winner`` of points ``order[begin:end]`` by one camera.

    Rows are those of the vacancy's kernel, so are the cut-offs: nothing beyond the footprint,
    nothing before the depth at which the Gaussian begins. Transmittance that can no longer win is
    not followed further.
    """
    half = np.float32(0.5)
    one = np.float32(1.0)
    least = np.float32(_LEAST)
    for k in range(begin, end):
        p = order[k]
        x, y, z = screen[p, 0], screen[p, 1], screen[p, 2]
        tile = cells[p]
        value = one
        lost = max(best[p], np.float32(1e-4))
        for j in range(tile_start[tile], tile_start[tile + 1]):
            i = tile_ids[j]
            if x < bounds[i, 0] or x > bounds[i, 2] or y < bounds[i, 1] or y > bounds[i, 3]:
                continue
            if z < rows[i, 14]:
                continue
            dx, dy = x - rows[i, 0], y - rows[i, 1]
            num = (dx * rows[i, 2] + dy * rows[i, 3]) * dx + dy * dy * rows[i, 4]
            lin = dx * rows[i, 5] + dy * rows[i, 6]
            den = (dx * rows[i, 7] + dy * rows[i, 8]) * dx + dy * dy * rows[i, 9]
            den += one + np.float32(2.0) * lin
            foot = num / den
            if foot > rows[i, 13]:
                continue
            away = (one + lin) / den * rows[i, 10] - z
            across = rows[i, 12] * np.exp(-half * foot)
            here = across * np.exp(-half * away * away * den * rows[i, 11])
            root = np.sqrt(max(one - here, least))
            if away > np.float32(0.0):
                value *= root
            else:
                value *= max(one - across, least) / root
            if value < lost:
                break
        if value < np.float32(1e-4):
            value = np.float32(0.0)
        if value > best[p] or (value == best[p] and camera_index < winner[p]):
            best[p] = value
            winner[p] = camera_index
