# SPDX-License-Identifier: GPL-3.0-or-later
"""Multi-view losses: neighbours, photometric and geometric terms on sampled pixels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .. import limits
from ..compiled import kernel
from ..parallel import ArrayStore, run_rows
from ..render.depth_query import (
    QueryResult,
    QueryView,
    add_query_gradients,
    query_view,
    solve_depths,
)
from ..render.projection import RawArrays, project_backward_visible
from ..render.types import ImageGradients, RenderOptions, VisibleGradients
from ..render.view_renderer import ViewPass
from ..resampling import LUMA
from ..scene.camera import Camera
from ..settings import TrainingSettings
from .losses import kernel_mask
from .multi_view_kernels import BROKEN, KEPT, SAMPLES, compare_range, lift_range, return_range

# -- Select neighbouring cameras for the multi-view terms (docs/method.md, section 3.4) -----------

_MOST_POINTS = 2000
"""Most points for estimating the overlap of two images, subsampled from those given."""
_FEW_POINTS = 10
"""The overlap criterion is skipped for cameras that see fewer of them."""


_MAX_ANGLE_DEG = 30.0
"""Between the optical axes.

40 photos around an object are 16 to 28 degrees and 0.25 to 0.4 scene radii apart: with the method's
0.3 radii 23 of 40 have no neighbour, with these limits all have; on a capture of 50 to 80 photos
every camera has eight, the nearest of which are the method's. In a room, where axes differ by 28 to
101 degrees, 32 of 40 have none, with these all have. Angles beyond 30 degrees would add pairs with
too different views of a patch, and no camera needs them.
"""
_MIN_DISTANCE = 0.002 * limits.SCENE_RADIUS
"""Between the centres, scene units: without a baseline, depth is not constrained."""
_MOST_NEIGHBOURS = 8
"""Of each camera; the nearest are kept."""


def find_neighbours(
    cameras: Sequence[Camera],
    settings: TrainingSettings | None = None,
    *,
    points: np.ndarray | None = None,
) -> list[np.ndarray]:
    """Return the neighbours of each camera (docs/method.md, section 3.4).

    Candidates have a similar direction and position, and share part of the visible sparse points.
    Sorted by distance, then by angle, then by index. The neighbours of one camera do not depend on
    those of others.

    Parameters
    ----------
    cameras : sequence of Camera
        Scene frame.
    settings : TrainingSettings, optional
        ``neighbour_distance`` in scene radii, and ``neighbour_overlap``: the share of the sparse
        points in a camera's image that must also lie in the other's.
    points : (n, 3) array, optional
        Sparse points, scene frame; without them the overlap criterion is skipped.

    Returns
    -------
    list of (k,) int64
        Indices into ``cameras``, for each camera; empty without candidates.
    """
    settings = settings or TrainingSettings()
    max_distance = settings.neighbour_distance * limits.SCENE_RADIUS
    if len(cameras) == 0:
        return []
    centers = np.stack([camera.center for camera in cameras])  # (c, 3)
    axes = np.stack([camera.forward for camera in cameras])  # (c, 3)
    seen = _seen_points(cameras, points)
    found = []
    for index in range(len(cameras)):
        distance = np.linalg.norm(centers - centers[index], axis=1)  # (c,)
        # The arc sine of half the chord keeps small angles exact, the arc cosine does not.
        chord = np.linalg.norm(axes - axes[index], axis=1)
        angle_deg = np.degrees(2.0 * np.arcsin(np.minimum(0.5 * chord, 1.0)))
        good = (angle_deg < _MAX_ANGLE_DEG) & (distance > _MIN_DISTANCE)
        good &= distance < max_distance
        good[index] = False
        here = seen[index]
        if here.sum() >= _FEW_POINTS:
            good &= (seen & here).sum(1) >= settings.neighbour_overlap * here.sum()
        candidates = np.flatnonzero(good)
        order = np.lexsort((candidates, angle_deg[candidates], distance[candidates]))
        found.append(candidates[order[:_MOST_NEIGHBOURS]])
    return found


def _seen_points(cameras: Sequence[Camera], points: np.ndarray | None) -> np.ndarray:
    """Return (c, n) bool: a point projects into the image of a camera, ignoring occlusion."""
    if points is None or len(points) == 0:
        return np.zeros((len(cameras), 0), np.bool_)
    step = -(-len(points) // _MOST_POINTS)
    some = np.asarray(points, np.float64)[::step]
    seen = np.zeros((len(cameras), len(some)), np.bool_)
    for index, camera in enumerate(cameras):
        pixels, depth = camera.project(some)
        inside = (pixels >= 0.0).all(1) & (pixels <= [camera.width, camera.height]).all(1)
        seen[index] = inside & (depth > limits.NEAR_Z)
    return seen


# -- Sample the pixels for the multi-view terms: stratified, with more of them on texture ---------

BORDER_PX = 2
"""Pixels closer to the border than this have patches that leave the image."""
BLOCK_PX = 8
"""Pixels are traversed in blocks of this side, so that a stratum is a patch and not a line."""
RED, GREEN, BLUE = LUMA


def grey_image(
    photo: np.ndarray, name: str, *, threads: int, store: ArrayStore | None = None
) -> np.ndarray:
    """Return (h, w) float32 grey in [0, 1] of an (h, w, 3) photo: uint8, or floats in [0, 1].

    ``name`` is its key in ``store``.
    """
    grey = (store or ArrayStore()).take(name, photo.shape[:2], np.float32)
    scale = 1.0 / 255.0 if photo.dtype == np.uint8 else 1.0
    run_rows(_grey_rows, len(photo), threads, photo, scale, grey, chunks=2)
    return grey


def choose_pixels(
    grey: np.ndarray, depth: np.ndarray, mask: np.ndarray | None, count: int,
    random: np.random.Generator, *, threads: int, store: ArrayStore | None = None,
) -> np.ndarray:  # fmt: skip
    """Sample up to ``count`` distinct pixels with depth, inside the mask; all, if it has no more.

    Stratified along blocks of pixels. The probability of a pixel is proportional to its brightness
    gradient plus the mean one: half of the pixels follow texture, half are uniform.

    Parameters
    ----------
    grey, depth : (h, w) float32
        Depth is > 0 where defined.
    mask : (h, w) bool, optional
        False pixels are never chosen.
    random : numpy Generator
        ``count`` numbers are drawn, whatever the images contain; none if ``count`` is not less
        than the number of pixels.

    Returns
    -------
    (m,) int32
        ``row * width + column``, m <= count.
    """
    height = len(grey)
    takes_all = count >= grey.size
    jitter = random.random(0 if takes_all else count)
    steepness = (store or ArrayStore()).take("steepness", grey.shape, np.float32)
    sums = np.empty((height, 2))
    given = (grey, depth, kernel_mask(mask), steepness, sums)
    run_rows(_steepness_rows, height, threads, *given, chunks=2)
    steep, usable = sums.sum(0).tolist()
    if usable == 0:
        return np.zeros(0, np.int32)
    if takes_all:
        return np.flatnonzero(steepness.reshape(-1) >= 0.0).astype(np.int32)
    even = steep / usable if steep > 0.0 else 1.0
    chosen = np.empty(count, np.int32)
    found = _pick(steepness, even, steep + even * usable, jitter, chosen)
    return chosen[:found]


@kernel(fast=False, fused=True)
def _grey_rows(begin: int, end: int, photo: np.ndarray, scale: float, grey: np.ndarray) -> None:
    red, green = np.float32(RED * scale), np.float32(GREEN * scale)
    blue = np.float32(BLUE * scale)
    for i in range(begin, end):
        for j in range(photo.shape[1]):
            grey[i, j] = (
                red * np.float32(photo[i, j, 0])
                + green * np.float32(photo[i, j, 1])
                + blue * np.float32(photo[i, j, 2])
            )


@kernel(fast=False)
def _steepness_rows(
    begin: int, end: int, grey: np.ndarray, depth: np.ndarray, mask: np.ndarray,
    steepness: np.ndarray, sums: np.ndarray,
) -> None:  # fmt: skip
    """Write the length of the brightness gradient, -1 for pixels that cannot be chosen, and for
    each row their sum and number."""
    height, width = grey.shape
    for i in range(begin, end):
        total, usable = 0.0, 0
        for j in range(width):
            steepness[i, j] = np.float32(-1.0)
            if not (BORDER_PX <= i < height - BORDER_PX and BORDER_PX <= j < width - BORDER_PX):
                continue
            if not depth[i, j] > 0.0 or (len(mask) > 0 and not mask[i, j]):
                continue
            across = grey[i, j + 1] - grey[i, j - 1]
            down = grey[i + 1, j] - grey[i - 1, j]
            length = np.sqrt(across * across + down * down)
            if not length < math.inf:
                continue
            steepness[i, j] = length
            total += steepness[i, j]
            usable += 1
        sums[i, 0] = total
        sums[i, 1] = usable


@kernel(fast=False)
def _pick(
    steepness: np.ndarray, even: float, total: float, jitter: np.ndarray, chosen: np.ndarray
) -> Any:
    """Write the pixel selected by each stratum's draw, without duplicates; return their number."""
    height, width = steepness.shape
    stratum = total / len(jitter)
    found, drawn, running = 0, 0, 0.0
    for top in range(0, height, BLOCK_PX):
        for left in range(0, width, BLOCK_PX):
            for i in range(top, min(top + BLOCK_PX, height)):
                for j in range(left, min(left + BLOCK_PX, width)):
                    if steepness[i, j] < 0.0:
                        continue
                    running += steepness[i, j] + even
                    hit = False
                    while drawn < len(jitter) and (drawn + jitter[drawn]) * stratum < running:
                        drawn += 1
                        hit = True
                    if hit:
                        chosen[found] = i * width + j
                        found += 1
    return found


# -- Multi-view losses between two views, with gradients on both (docs/method.md, section 3.4) ----
#
# Sampled pixels of the rendered view are lifted to its isosurface and projected into another
# view. *Geometric*: the depth of the other view there, reprojected, should meet the pixel again.
# *Photometric*: the plane through the point should show the same patch in both photos. The other
# view is not rendered: its depth is solved at the projected positions only.

_GEOMETRY_COLUMNS = 13
"""Columns of the screen parameters that a depth depends on."""


@dataclass(frozen=True)
class MultiViewOptions:
    """Weights and sizes of the multi-view terms."""

    lambda_photometric: float = TrainingSettings.lambda_photometric
    lambda_geometric: float = 0.02
    correlation: str = "signed"
    pixels: int = 4000
    """Largest number of sampled pixels; as many as the image has, or more, take all."""
    patch_sizes: int = TrainingSettings.patch_sizes
    """Number of patch sizes, the larger ones for regions where smaller patches are flat."""
    max_rise: float = TrainingSettings.patch_rise
    """Largest deviation of the surface from a patch's plane, in half sides of the patch."""
    min_contrast: float = TrainingSettings.patch_contrast
    """Least standard deviation of grey, in [0, 1], of a patch that is compared."""
    weight: float = 1.0
    """Factor on both terms: n if they are evaluated in every n-th iteration."""

    @classmethod
    def of_settings(cls, settings: TrainingSettings) -> MultiViewOptions:
        """Return the options of a training's settings."""
        return cls(
            settings.lambda_photometric, settings.lambda_geometric, settings.correlation,
            settings.multi_view_pixels, settings.patch_sizes, settings.patch_rise,
            settings.patch_contrast, float(settings.multi_view_every),
        )  # fmt: skip


@dataclass(frozen=True)
class MultiViewMetrics:
    """Values of the terms and pixel counts: numbers, or () tensors of a device."""

    photometric: Any
    """Mean of ``w (1 - correlation)`` over the patches kept; 0 without any."""
    geometric: Any
    """Mean of ``w noise`` over the valid pixels, pixels; 0 without any."""
    chosen: Any
    """Number of sampled pixels."""
    valid: Any
    """Pixels that reproject to within a pixel."""
    kept: Any
    """Pixels whose patches are compared."""
    dropped: Any = 0
    """Pixels and Gaussians skipped because of non-finite values; not counted on a device."""


@dataclass(frozen=True)
class MultiViewLoss:
    """The weighted sum of both terms and its gradients, arrays or tensors of a device."""

    value: Any
    """float, or () float64 tensor."""
    gradients: ImageGradients
    """On ``depth`` and ``geometric_normal`` of the rendered view; none on the others."""
    other: Any
    """On the Gaussians, through the other view's depth: :class:`VisibleGradients`, or of a device a
    dict of tensors by name; ``None`` without such a contribution."""
    figures: MultiViewMetrics


@dataclass(frozen=True)
class PhotoView:
    """A photo with its camera, as arrays or as tensors of a device."""

    camera: Camera
    """Scene frame."""
    photo: Any  # (h, w, 3) uint8; arrays may be floats in [0, 1]
    mask: Any = None  # (h, w) bool or None; false pixels are ignored


def multi_view_losses(
    image: ViewPass, gaussians: RawArrays, shown: PhotoView, other: PhotoView,
    settings: MultiViewOptions, random: np.random.Generator, *, threads: int = 0,
    store: ArrayStore | None = None,
) -> MultiViewLoss:  # fmt: skip
    """Compare a rendered view with the photo and the depth of another view.

    ``weight (lambda_photometric mean(w (1 - ncc)) + lambda_geometric mean(w noise))`` with
    ``w = exp(-noise)`` treated as constant (docs/method.md, section 3.4). A pixel is valid where
    both depths exist, both masks include it and the noise is below one pixel; its patch is kept
    where the plane is not seen edge-on, all samples are inside both images and masks, neither
    patch is flat, and ``1 - ncc < 0.9``.

    ``image`` is rendered with depth, of ``gaussians`` in the scene frame. ``settings.pixels``
    numbers are drawn, none where all pixels are taken. The result does not depend on ``threads``;
    with a ``store``, gradients on images are valid until the next call.
    """
    store = store or ArrayStore()
    options = RenderOptions(sh_degree=0, threads=threads)
    grey = grey_image(shown.photo, "multi-view grey", threads=threads, store=store)
    pixels = choose_pixels(
        grey, image.depth, shown.mask, settings.pixels, random, threads=threads, store=store
    )
    pair = _ViewPair(image, shown.camera, other.camera, pixels, options.near_z, threads)
    other_mask = kernel_mask(other.mask)
    positions, position_slopes = pair.lift(other_mask)
    by_depth = store.zeros("multi-view by depth", image.depth.shape, np.float32)
    by_normal = store.zeros("multi-view by normal", image.geometric_normal.shape, np.float32)
    on_images = ImageGradients(depth=by_depth, geometric_normal=by_normal)
    given = np.isfinite(image.depth.reshape(-1)[pixels])  # (m,)
    given &= np.isfinite(image.geometric_normal.reshape(-1, 3)[pixels]).all(1)
    if not np.isfinite(positions[:, 0]).any():
        nothing = MultiViewMetrics(0.0, 0.0, len(pixels), 0, 0, int((~given).sum()))
        return MultiViewLoss(0.0, on_images, None, nothing)
    view = query_view(gaussians, other.camera, options)
    depths = solve_depths(view, positions)
    noise, by_found, by_positions = pair.reproject(positions, depths.values)
    valid = noise < np.inf  # (m,)
    weights = np.where(valid, np.exp(-noise), 0.0)
    lambda_photometric = settings.weight * settings.lambda_photometric
    lambda_geometric = settings.weight * settings.lambda_geometric
    other_grey = grey_image(other.photo, "multi-view other grey", threads=threads, store=store)
    states, errors, depth_slopes, normal_slopes = pair.compare(
        noise, (grey, other_grey), (kernel_mask(shown.mask), other_mask), settings
    )
    kept = states == KEPT
    photometric = _mean(weights * errors, kept)
    geometric = _mean(weights * np.where(valid, noise, 0.0), valid)
    share = lambda_photometric * weights / max(1, int(kept.sum()))
    pixel_depth = share * depth_slopes  # (m,)
    pixel_normal = share[:, None] * normal_slopes  # (m, 3)
    share = lambda_geometric * weights / max(1, int(valid.sum()))
    on_other, broken = None, 0
    if lambda_geometric != 0.0 and valid.any():
        on_other, on_positions, broken = _other_gradients(gaussians, view, depths, share * by_found)
        on_positions = share[:, None] * by_positions + on_positions
        pixel_depth = pixel_depth + (on_positions * position_slopes).sum(1)
    sound = given & np.isfinite(pixel_depth) & np.isfinite(pixel_normal).all(1)
    rows = pixels[sound]
    by_depth.reshape(-1)[rows] = pixel_depth[sound]
    by_normal.reshape(-1, 3)[rows] = pixel_normal[sound]
    dropped = int((~sound | (states == BROKEN)).sum()) + broken
    figures = MultiViewMetrics(
        photometric, geometric, len(pixels), int(valid.sum()), int(kept.sum()), dropped
    )
    value = lambda_photometric * photometric + lambda_geometric * geometric
    return MultiViewLoss(value, on_images, on_other, figures)


class _ViewPair:
    """Two views and the sampled pixels of the first, packed for the kernels."""

    def __init__(
        self, image: ViewPass, camera: Camera, other: Camera, pixels: np.ndarray, near_z: float,
        threads: int,
    ) -> None:  # fmt: skip
        self.image, self.pixels, self.near_z, self.threads = image, pixels, near_z, threads
        self.rotation = np.ascontiguousarray(camera.rotation)
        self.camera, self.other = _pack(camera), _pack(other)
        turn = other.rotation @ camera.rotation.T  # (3, 3) other camera from this one
        shift = other.cam_from_world[:, 3] - turn @ camera.cam_from_world[:, 3]
        self.pose = np.concatenate([turn, shift[:, None]], 1)  # (3, 4)

    def lift(self, other_mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return positions in the other view (m, 2) float32, and their derivatives by depth."""
        count = len(self.pixels)
        positions, position_slopes = np.empty((count, 2), np.float32), np.empty((count, 2))
        run_rows(
            lift_range, count, self.threads, self.pixels, self.image.depth, self.camera, self.other,
            self.pose, self.near_z, other_mask, positions, position_slopes,
        )  # fmt: skip
        return positions, position_slopes

    def reproject(
        self, positions: np.ndarray, found: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return noise (m,), its derivatives by the other view's depth (m,) and position (m, 2)."""
        count = len(self.pixels)
        noise, by_found, by_positions = np.empty(count), np.empty(count), np.empty((count, 2))
        run_rows(
            return_range, count, self.threads, self.pixels, self.image.depth.shape[1], positions,
            found, self.camera, self.other, self.pose, self.near_z, noise, by_found, by_positions,
        )  # fmt: skip
        return noise, by_found, by_positions

    def compare(
        self, noise: np.ndarray, greys: tuple[np.ndarray, np.ndarray],
        masks: tuple[np.ndarray, np.ndarray], settings: MultiViewOptions,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
        """Return states (m,), errors (m,), their derivatives by depth (m,) and normal (m, 3)."""
        count, image = len(self.pixels), self.image
        states, errors = np.empty(count, np.uint8), np.empty(count)
        by_depth, by_normals = np.empty(count), np.empty((count, 3))
        squared, min_spread = settings.correlation == "squared", SAMPLES * settings.min_contrast**2
        run_rows(
            compare_range, count, self.threads, self.pixels, noise, image.depth,
            image.geometric_normal, image.alpha, self.rotation, self.camera, self.other, self.pose,
            self.near_z, *greys, *masks, squared, settings.patch_sizes, settings.max_rise,
            min_spread, states, errors, by_depth, by_normals,
        )  # fmt: skip
        return states, errors, by_depth, by_normals


def _other_gradients(
    gaussians: RawArrays, view: QueryView, depths: QueryResult, by_found: np.ndarray
) -> tuple[VisibleGradients, np.ndarray, int]:
    """Return gradients on the Gaussians (m', ...) and positions (m, 2), and Gaussians dropped."""
    grad_params = np.zeros_like(view.screen.params)
    by_positions = add_query_gradients(view, depths, by_found, grad_params)
    # All values are finite if the sum of their absolute values is.
    with np.errstate(all="ignore"):
        sizes = np.abs(grad_params[:, :_GEOMETRY_COLUMNS]).sum(1)  # (n,)
    wild = ~np.isfinite(sizes)
    grad_params[wild] = 0.0
    ids = np.flatnonzero((sizes != 0.0) & ~wild).astype(np.int32)
    found = project_backward_visible(
        gaussians, view.camera, view.options, view.screen, grad_params, ids
    )
    return found, by_positions.astype(np.float64), int(wild.sum())


def _mean(values: np.ndarray, where: np.ndarray) -> float:
    return float(values[where].sum() / max(1, int(where.sum())))


def _pack(camera: Camera) -> np.ndarray:
    values = (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
    return np.array(values, np.float64)
