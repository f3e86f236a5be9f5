# SPDX-License-Identifier: GPL-3.0-or-later
"""Vacancy of points: a point becomes vacancy here."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from .. import limits
from ..compiled import kernel
from ..errors import ResourceError, UsageError
from ..gaussians.model import GaussianArrays
from ..machine import total_memory_bytes
from ..parallel import CHUNKS_PER_THREAD, balanced_bounds, default_threads, even_bounds, run_chunks
from ..progress import Progress
from ..render.projection import pack_camera, project_arrays
from ..scene.camera import Camera
from .vacancy_kernels import (
    BOUND_COLUMNS,
    ROW_COLUMNS,
    list_tiles,
    project_points,
    sort_by_cell,
    transmittance_of_cells,
)

# -- Bin the Gaussians seen by a camera into tiles, packed for vacancy queries --------------------


VIRTUAL_SIDE_PX = 65536
"""Long side of the virtual screen of queries. Nothing is rasterised, so its resolution only decides
which Gaussians are lost between pixel centres: at this size, none that matters."""
TILES_ALONG_SIDE = 64
TILE_PX = VIRTUAL_SIDE_PX // TILES_ALONG_SIDE
DEPTH_TAIL = 1e-5
"""A Gaussian is ignored in front of the depth where its value first exceeds this."""
STRIP_MARGIN_PX = 0.05
"""Several float32 roundings of a coordinate on the virtual screen."""
MAX_TILE_INTERSECTIONS = 2**31 - 1


@dataclass(frozen=True)
class VirtualScreen:
    """A camera resized so that its longer side has :data:`VIRTUAL_SIDE_PX` pixels."""

    camera: Camera
    packed: np.ndarray
    """(22,) float64, as in ``render.projection.pack_camera``."""
    tiles_x: int
    tiles_y: int

    @classmethod
    def of(cls, camera: Camera, near_z: float) -> VirtualScreen:
        """Return the virtual screen of a camera of any resolution."""
        scale = VIRTUAL_SIDE_PX / max(camera.width, camera.height)
        width, height = round(camera.width * scale), round(camera.height * scale)
        virtual = camera.resized(max(1, width), max(1, height))
        tiles_x, tiles_y = -(-virtual.width // TILE_PX), -(-virtual.height // TILE_PX)
        return cls(virtual, pack_camera(virtual, near_z), tiles_x, tiles_y)

    @property
    def tiles(self) -> int:
        """Number of tiles."""
        return self.tiles_x * self.tiles_y


@dataclass(frozen=True)
class CameraBins:
    """Binned Gaussians of one camera, for :func:`.vacancy_kernels.transmittance_of_cells`."""

    rows: np.ndarray
    """(m, 16) float32, nearest first."""
    bounds: np.ndarray
    """(m, 8) float32, pixels of the virtual screen."""
    tile_start: np.ndarray
    """(tiles + 1,) int64."""
    tile_ids: np.ndarray
    """(intersections,) int32."""
    longest_list: int
    ids: np.ndarray
    """(m,) int32: the Gaussian of each row."""

    @property
    def size_bytes(self) -> int:
        """Size in memory."""
        arrays = (self.rows, self.bounds, self.tile_start, self.tile_ids, self.ids)
        return sum(a.nbytes for a in arrays)


def region_window(
    camera: Camera, bounds: np.ndarray, near_z: float
) -> tuple[float, float, float, float, float] | None:
    """Bound the image area and depth in which a box, its (2, 3) corners given, can be visible.

    Returns x0, y0, x1, y1 in pixels and the largest z-depth; ``None`` if the camera cannot see it.
    """
    corners = np.stack(np.meshgrid(*bounds.T, indexing="ij"), -1).reshape(-1, 3)  # (8, 3)
    pixels, depth = camera.project(corners)
    # Slightly less than near_z: a point on the box's far corner may round to the other side.
    if depth.max() <= near_z * (1.0 - 1e-9):
        return None
    x0, y0, x1, y1 = 0.0, 0.0, float(camera.width), float(camera.height)
    if depth.min() > 1e-6 * depth.max():
        # Only then does the projected box lie in the hull of its projected corners.
        x0, y0 = max(x0, pixels[:, 0].min() - 1.0), max(y0, pixels[:, 1].min() - 1.0)
        x1, y1 = min(x1, pixels[:, 0].max() + 1.0), min(y1, pixels[:, 1].max() + 1.0)
        if x0 > x1 or y0 > y1:
            return None
    return x0, y0, x1, y1, float(depth.max())


def footprint_bounds(boxes: np.ndarray, skews: np.ndarray) -> np.ndarray:
    """Bound elliptic footprints by their box and by the narrowest strip that contains them.

    ``boxes (n, 4)`` are x0 y0 x1 y1 in pixels; ``skews (n,)`` the x offset from the centre to the
    ellipse's point of largest y, inf where unbounded. Returns the (n, 8) float32 columns of
    ``vacancy_kernels.BOUND_COLUMNS``. A strip of infinite width is no constraint.
    """
    wide = boxes.astype(np.float64)
    middle = 0.5 * (wide[:, :2] + wide[:, 2:])  # (n, 2)
    half = 0.5 * (wide[:, 2:] - wide[:, :2])  # (n, 2)
    bounded = np.isfinite(skews)
    # The ellipse's matrix C: its width along a unit normal is sqrt(normal^T C normal).
    xx, yy = half[:, 0] ** 2, half[:, 1] ** 2
    xy = np.where(bounded, skews, 0.0) * half[:, 1]
    turn = 0.5 * np.arctan2(2.0 * xy, xx - yy) + 0.5 * math.pi  # angle of the minor axis
    normal = np.stack([np.cos(turn), np.sin(turn)], 1)  # (n, 2)
    width_sq = normal[:, 0] ** 2 * xx + 2.0 * normal.prod(1) * xy + normal[:, 1] ** 2 * yy
    # xy is derived from float32 values, which limits the accuracy of a thin ellipse's width.
    width = np.sqrt(np.maximum(width_sq, 0.0) + 1e-6 * (xx + yy)) + STRIP_MARGIN_PX
    out = np.empty((len(boxes), BOUND_COLUMNS), np.float32)
    out[:, :4] = boxes
    out[:, 4:6] = normal
    out[:, 6] = (normal * middle).sum(1)
    out[:, 7] = np.where(bounded, width, np.inf)
    return out


def bin_camera(
    arrays: GaussianArrays,
    virtual: VirtualScreen,
    near_z: float,
    bounds: np.ndarray | None,
    threads: int,
) -> CameraBins | None:
    """Project, pack and bin the Gaussians for a camera; ``None`` if it cannot see the region.

    Raises ResourceError if the tile lists are too long.
    """
    camera = virtual.camera
    window = None if bounds is None else region_window(camera, bounds, near_z)
    if bounds is not None and window is None:
        return None
    screen = project_arrays(arrays, camera, near_z, threads=threads)
    kept = screen.visible.copy()
    log_opacity = arrays.log_opacities
    reach = np.maximum(2.0 * (log_opacity - math.log(limits.ALPHA_MIN)), 0.0)  # (n,)
    depth_reach = np.sqrt(2.0 * np.maximum(log_opacity - math.log(DEPTH_TAIL), 0.0))
    begin_z = screen.params[:, 10] - depth_reach * screen.params[:, 22]  # (n,)
    boxes = screen.boxes
    if window is not None:
        x0, y0, x1, y1, deepest = window
        kept &= (boxes[:, 0] <= x1) & (boxes[:, 2] >= x0)
        kept &= (boxes[:, 1] <= y1) & (boxes[:, 3] >= y0) & (begin_z <= deepest)
    ids = np.flatnonzero(kept)
    ids = ids[np.argsort(screen.depths[ids], kind="stable")]
    rows = np.zeros((len(ids), ROW_COLUMNS), np.float32)
    rows[:, :11] = screen.params[ids, :11]
    rows[:, 11] = screen.params[ids, 12]
    rows[:, 12] = screen.params[ids, 11]
    rows[:, 13] = reach[ids]
    rows[:, 14] = begin_z[ids]
    footprints = footprint_bounds(boxes[ids], screen.skews[ids])
    if window is not None:
        # Lists of tiles outside the window are never read.
        footprints[:, :2] = np.maximum(footprints[:, :2], np.array([x0, y0], np.float32))
        footprints[:, 2:4] = np.minimum(footprints[:, 2:4], np.array([x1, y1], np.float32))
    tiles_x, tiles_y = virtual.tiles_x, virtual.tiles_y
    start = np.zeros(virtual.tiles + 1, np.int64)
    tile_ids = np.empty(0, np.int32)
    tile_px = np.float32(TILE_PX)
    list_tiles(footprints, tile_px, tiles_x, tiles_y, start[1:], tile_ids, False)
    longest = int(start.max())
    np.cumsum(start, out=start)
    if start[-1] > MAX_TILE_INTERSECTIONS:
        raise ResourceError(
            f"Camera {camera.name} would have {start[-1]} tile intersections of Gaussians.",
            "Train with fewer Gaussians.",
        )
    tile_ids = np.empty(start[-1], np.int32)
    list_tiles(footprints, tile_px, tiles_x, tiles_y, start[:-1].copy(), tile_ids, True)
    return CameraBins(rows, footprints, start, tile_ids, longest, ids.astype(np.int32))


# -- Photo masks in the vacancy field: masked points are unseen, or known to be empty -------------


MaskMode = Literal["ignore", "background"]
"""As in training: masked pixels are ignored, or show that the space before them is empty."""


@dataclass(frozen=True)
class PackedMask:
    """A mask of which each pixel takes a bit: the masks of all photos are held at once."""

    bits: np.ndarray
    """(h, ceil(w / 8)) uint8, the first pixel in the highest bit; 1 where the photo counts."""
    width: int

    @classmethod
    def of(cls, mask: np.ndarray | None) -> PackedMask | None:
        """Pack an (h, w) mask."""
        if mask is None:
            return None
        return cls(np.packbits(np.asarray(mask, np.bool_), axis=-1), mask.shape[-1])

    @property
    def shape(self) -> tuple[int, ...]:
        """Of the mask before it was packed."""
        return (*self.bits.shape[:-1], self.width)

    def unpacked(self) -> np.ndarray:
        """Return (h, w) bool."""
        return np.unpackbits(self.bits, axis=-1, count=self.width).view(np.bool_)


@kernel(fast=False)
def masked_points(begin, end, screen, cells, bits, width, scale_x, scale_y, out):  # type: ignore[no-untyped-def]
    """Tell which points with a cell lie in a masked pixel.

    ``bits`` and ``width`` are those of a :class:`PackedMask`; ``scale_x`` and ``scale_y`` convert
    pixels of ``screen`` to those of the mask.
    """
    height = bits.shape[0]
    for p in range(begin, end):
        out[p] = False
        if cells[p] < 0:
            continue
        column = min(int(screen[p, 0] * scale_x), width - 1)
        row = min(int(screen[p, 1] * scale_y), height - 1)
        out[p] = not (bits[row, column >> 3] & (128 >> (column & 7)))


def checked_masks(
    masks: Sequence[np.ndarray | PackedMask | None] | None, cameras: Sequence[Camera], mode: str
) -> tuple[PackedMask | None, ...]:
    """Validate and pack masks: one or ``None`` per camera, ``None`` also where nothing is masked.

    Raises UsageError if the numbers of masks and cameras differ, a mask is not an image, or the
    mode is unknown.
    """
    if mode not in ("ignore", "background"):
        raise UsageError(f"The mask mode is {mode!r}.", 'Use "ignore" or "background".')
    if masks is None:
        return (None,) * len(cameras)
    if len(masks) != len(cameras):
        raise UsageError(
            f"There are {len(cameras)} cameras and {len(masks)} masks.", "Give one mask a camera."
        )
    out: list[PackedMask | None] = []
    for camera, mask in zip(cameras, masks, strict=True):
        if mask is None:
            out.append(None)
            continue
        if len(mask.shape) != 2 or 0 in mask.shape:
            raise UsageError(
                f"The mask of {camera.name} has the shape {mask.shape}.",
                "Use an image of one channel.",
            )
        packed = mask if isinstance(mask, PackedMask) else PackedMask.of(mask)
        assert packed is not None
        out.append(None if packed.unpacked().all() else packed)
    return tuple(out)


# -- Vacancy field: the largest transmittance to a point from any camera that sees it -------------


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
    """(n,) float32 in [0, 1]; 1 is empty, the surface is at 0.5. Before it is raised (``level``),
    values above 0.999 are lower bounds, values below 1e-4 are 0. NaN where no camera sees the
    point, if unseen is invalid."""
    camera: np.ndarray
    """(n,) int32: the camera that sees the point best, or -1 where none sees it."""

    @property
    def filled(self) -> np.ndarray:
        """(n,) float32: vacancy with invalid points as empty, as in meshing."""
        return np.where(np.isnan(self.vacancy), np.float32(1.0), self.vacancy)


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
    cameras : sequence of Camera
        In the scene frame, of any resolution: vacancy does not depend on it.
    unseen : {"empty", "occupied", "invalid"}
        Vacancy 1, 0 or NaN of points that no camera sees (docs/method.md, section 5.3). Invalid
        points count as empty in :meth:`is_empty`, and ``unseen_evaluations`` counts them.
    level : float
        Vacancy, by the definition above, at which the surface is. What :meth:`vacancy` returns and
        :meth:`is_empty` compares is raised to the power that makes it 0.5 (docs/method.md, section
        5.3).
    masks : sequence of (h, w) bool, PackedMask or None, optional
        One per camera, true where its photo counts, of any resolution.
    mask_mode : {"ignore", "background"}
        Points in masked pixels are unseen by the camera; or known to be empty, whatever other
        cameras see, provided that training used the same mode.
    region_bounds : (2, 3) float64, optional
        Box that contains all query points, scene frame. Cameras that do not see it and Gaussians
        that cannot affect it are skipped, which saves time and memory and changes no value. Points
        outside it count as unseen.
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
        level: float = limits.ISO_LEVEL,
        region_bounds: np.ndarray | None = None,
        near_z: float = limits.NEAR_Z,
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
        self.power = math.log(limits.ISO_LEVEL) / math.log(level)
        """Vacancy is raised to it, so that the surface is at 0.5 whatever the level."""
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
        if cache_bytes is None:
            cache_bytes = int(CACHE_SHARE * total_memory_bytes()) or CACHE_BYTES_UNKNOWN
        self._cache_left = cache_bytes

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
            vacancy[begin:end] = np.where(seen, self._raised(best), self._unseen_value)
            camera[begin:end] = winner
        return VacancyResult(vacancy, camera)

    def is_empty(
        self,
        points: np.ndarray,
        progress: Progress | None = None,
        *,
        level: float = limits.ISO_LEVEL,
    ) -> np.ndarray:
        """Tell whether vacancy exceeds ``level`` at (n, 3) points, without finding its value.

        Equal to ``vacancy(points).vacancy > level`` for levels that are, before vacancy is raised,
        from 1e-4 to 0.999, but a point is finished at the first camera that finds it empty, and the
        evaluation from a camera stops as soon as the point cannot be empty for it.
        """
        points = np.ascontiguousarray(points, np.float64).reshape(-1, 3)
        unseen_is_empty = not self._unseen_value <= level
        level32 = np.float32(level ** (1.0 / self.power))
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
            out[begin:end] = np.where(seen, best > level32, unseen_is_empty)
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

    def _raised(self, best: np.ndarray) -> np.ndarray:
        return np.maximum(best, np.float32(0)) ** np.float32(self.power)  # -1 where unseen

    @property
    def _unseen_value(self) -> float:
        return _UNSEEN_VALUES[self.unseen]

    def _passes(self, count: int, progress: Progress) -> list[tuple[int, int, Progress]]:
        self.evaluations += count
        begins = range(0, count, POINTS_PER_PASS)
        bounds = [(begin, min(begin + POINTS_PER_PASS, count)) for begin in begins]
        return [(begin, end, progress.span(begin / count, end / count)) for begin, end in bounds]

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
