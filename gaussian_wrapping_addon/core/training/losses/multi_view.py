# SPDX-License-Identifier: GPL-3.0-or-later
"""Multi-view losses between two views, with gradients on both (docs/method.md, section 3.4).

Sampled pixels of the rendered view are lifted to its isosurface and projected into another view.
*Geometric*: the depth of the other view there, reprojected, should meet the pixel again.
*Photometric*: the plane through the point should show the same patch in both photos. The other view
is not rendered: its depth is solved at the projected positions only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...dataset.camera import Camera
from ...errors import UsageError
from ...kernels.array_store import ArrayStore
from ...kernels.parallel import default_threads, even_bounds, run_chunks
from ...render.projection.projection import RawArrays, project_backward_visible
from ...render.query.depth_query import (
    QueryResult,
    QueryView,
    add_query_gradients,
    query_view,
    solve_depths,
)
from ...render.types.gradients import ImageGradients, VisibleGradients
from ...render.types.options import RenderOptions
from ...render.view_renderer import ViewPass
from ...settings import CORRELATIONS, TrainingSettings
from ..optimizer.gradient_sums import add_image_gradients, merge_gradients
from .multi_view_kernels import (
    BROKEN,
    KEPT,
    SAMPLES,
    compare_range,
    lift_range,
    return_range,
)
from .pixel_choice import NO_MASK, choose_pixels, grey_image

__all__ = [
    "MultiViewLoss",
    "MultiViewMetrics",
    "MultiViewOptions",
    "add_image_gradients",
    "merge_gradients",
    "multi_view_losses",
]

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

    def __post_init__(self) -> None:
        if self.correlation not in CORRELATIONS:
            raise UsageError(
                f"There is no correlation {self.correlation!r}.",
                f"Choose one of {', '.join(CORRELATIONS)}.",
            )

    @classmethod
    def of_settings(cls, settings: TrainingSettings) -> MultiViewOptions:
        """Return the options of a training's settings."""
        return cls(
            settings.lambda_photometric,
            settings.lambda_geometric,
            settings.correlation,
            settings.multi_view_pixels,
            patch_sizes=settings.patch_sizes,
            max_rise=settings.patch_rise,
            min_contrast=settings.patch_contrast,
            weight=float(settings.multi_view_every),
        )


@dataclass(frozen=True)
class MultiViewMetrics:
    """Values of the terms and pixel counts."""

    photometric: float
    """Mean of ``w (1 - correlation)`` over the patches kept; 0 without any."""
    geometric: float
    """Mean of ``w noise`` over the valid pixels, pixels; 0 without any."""
    chosen: int
    """Number of sampled pixels."""
    valid: int
    """Pixels that reproject to within a pixel."""
    kept: int
    """Pixels whose patches are compared."""
    dropped: int
    """Pixels and Gaussians skipped because of non-finite values."""


@dataclass(frozen=True)
class MultiViewLoss:
    """The weighted sum of both terms and its gradients."""

    value: float
    gradients: ImageGradients
    """On ``depth`` and ``geometric_normal`` of the rendered view; none on the others."""
    other: VisibleGradients | None
    """On the Gaussians, through the other view's depth; ``None`` without such a contribution."""
    figures: MultiViewMetrics


def multi_view_losses(
    image: ViewPass,
    gaussians: RawArrays,
    camera: Camera,
    photo: np.ndarray,
    mask: np.ndarray | None,
    other_camera: Camera,
    other_photo: np.ndarray,
    other_mask: np.ndarray | None,
    settings: MultiViewOptions,
    random: np.random.Generator,
    *,
    threads: int = 0,
    store: ArrayStore | None = None,
) -> MultiViewLoss:
    """Compare a rendered view with the photo and the depth of another view.

    ``weight (lambda_photometric mean(w (1 - ncc)) + lambda_geometric mean(w noise))`` with
    ``w = exp(-noise)`` treated as constant (docs/method.md, section 3.4). A pixel is valid where
    both depths exist, both masks include it and the noise is below one pixel; its patch is kept
    where the plane is not seen edge-on, all samples are inside both images and masks, neither patch
    is flat, and ``1 - ncc < 0.9``.

    Parameters
    ----------
    image : ViewPass
        Rendered with depth; any object with the same images will do.
    gaussians : RawArrays
        Rendered Gaussians, scene frame.
    camera, other_camera : Camera
        Scene frame; sizes may differ.
    photo, other_photo : (h, w, 3) uint8, or floats in [0, 1]
    mask, other_mask : (h, w) bool or ``None``
        False pixels are ignored.
    settings : MultiViewOptions
    random : numpy Generator
        ``settings.pixels`` numbers are drawn, none where all pixels are taken.
    threads : int
        The result does not depend on it.
    store : ArrayStore, optional
        Memory for the gradients on images, which are then valid until the next call.

    Returns
    -------
    MultiViewLoss

    Raises
    ------
    UsageError
        If the size of a photo or mask differs from its camera's.
    """
    threads = threads or default_threads()
    store = ArrayStore() if store is None else store
    _check_sizes(camera, image=image.depth, photo=photo, mask=mask)
    _check_sizes(other_camera, photo=other_photo, mask=other_mask)
    options = RenderOptions(sh_degree=0, threads=threads)
    grey = grey_image(photo, "multi-view grey", threads=threads, store=store)
    pixels = choose_pixels(
        grey, image.depth, mask, settings.pixels, random, threads=threads, store=store
    )
    pair = _ViewPair(image, camera, other_camera, pixels, options.near_z, threads)
    kept_there = NO_MASK if other_mask is None else np.ascontiguousarray(other_mask, np.bool_)
    positions, position_slopes = pair.lift(kept_there)
    by_depth = store.zeros("multi-view by depth", image.depth.shape, np.float32)
    by_normal = store.zeros("multi-view by normal", image.geometric_normal.shape, np.float32)
    on_images = ImageGradients(depth=by_depth, geometric_normal=by_normal)
    given = np.isfinite(image.depth.reshape(-1)[pixels])  # (m,)
    given &= np.isfinite(image.geometric_normal.reshape(-1, 3)[pixels]).all(1)
    if not np.isfinite(positions[:, 0]).any():
        nothing = MultiViewMetrics(0.0, 0.0, len(pixels), 0, 0, int((~given).sum()))
        return MultiViewLoss(0.0, on_images, None, nothing)
    view = query_view(gaussians, other_camera, options)
    depths = solve_depths(view, positions)
    noise, by_found, by_positions = pair.reproject(positions, depths.values)
    valid = noise < np.inf  # (m,)
    weights = np.where(valid, np.exp(-noise), 0.0)
    lambda_photometric = settings.weight * settings.lambda_photometric
    lambda_geometric = settings.weight * settings.lambda_geometric

    states, errors, depth_slopes, normal_slopes = pair.compare(
        noise,
        grey,
        grey_image(other_photo, "multi-view other grey", threads=threads, store=store),
        NO_MASK if mask is None else np.ascontiguousarray(mask, np.bool_),
        kept_there,
        settings.correlation == "squared",
        settings.patch_sizes,
        settings.max_rise,
        SAMPLES * settings.min_contrast**2,
    )
    kept = states == KEPT
    photometric, geometric = _mean(weights * errors, kept), _mean(weights * _finite(noise), valid)
    share = lambda_photometric * weights / max(1, int(kept.sum()))
    pixel_depth = share * depth_slopes  # (m,)
    pixel_normal = share[:, None] * normal_slopes  # (m, 3)
    share = lambda_geometric * weights / max(1, int(valid.sum()))
    other, broken = None, 0
    if lambda_geometric != 0.0 and valid.any():
        other, on_positions, broken = _other_gradients(gaussians, view, depths, share * by_found)
        on_positions = share[:, None] * by_positions + on_positions
        pixel_depth = pixel_depth + (on_positions * position_slopes).sum(1)
    sound = given & np.isfinite(pixel_depth) & np.isfinite(pixel_normal).all(1)
    rows = pixels[sound]
    by_depth.reshape(-1)[rows] = pixel_depth[sound]
    by_normal.reshape(-1, 3)[rows] = pixel_normal[sound]
    figures = MultiViewMetrics(
        photometric,
        geometric,
        len(pixels),
        int(valid.sum()),
        int(kept.sum()),
        int((~sound | (states == BROKEN)).sum()) + broken,
    )
    value = lambda_photometric * photometric + lambda_geometric * geometric
    return MultiViewLoss(value, on_images, other, figures)


class _ViewPair:
    """Two views and the sampled pixels of the first, packed for the kernels."""

    def __init__(
        self,
        image: ViewPass,
        camera: Camera,
        other: Camera,
        pixels: np.ndarray,
        near_z: float,
        threads: int,
    ) -> None:
        self.image, self.pixels, self.near_z, self.threads = image, pixels, near_z, threads
        self.rotation = np.ascontiguousarray(camera.rotation)
        self.camera, self.other = _pack(camera), _pack(other)
        turn = other.rotation @ camera.rotation.T  # (3, 3) other camera from this one
        shift = other.cam_from_world[:, 3] - turn @ camera.cam_from_world[:, 3]
        self.pose = np.concatenate([turn, shift[:, None]], 1)  # (3, 4)
        self.bounds = even_bounds(len(pixels), threads)

    def lift(self, other_mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return positions in the other view (m, 2) float32, and their derivatives by depth."""
        count = len(self.pixels)
        positions, position_slopes = np.empty((count, 2), np.float32), np.empty((count, 2))

        def run(begin: int, end: int) -> None:
            lift_range(
                begin, end, self.pixels, self.image.depth, self.camera, self.other, self.pose,
                self.near_z, other_mask, positions, position_slopes,
            )  # fmt: skip

        run_chunks(run, self.bounds, self.threads)
        return positions, position_slopes

    def reproject(
        self, positions: np.ndarray, found: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return noise (m,), its derivatives by the other view's depth (m,) and position (m, 2)."""
        count = len(self.pixels)
        noise, by_found, by_positions = np.empty(count), np.empty(count), np.empty((count, 2))
        width = self.image.depth.shape[1]

        def run(begin: int, end: int) -> None:
            return_range(
                begin, end, self.pixels, width, positions, found, self.camera, self.other,
                self.pose, self.near_z, noise, by_found, by_positions,
            )  # fmt: skip

        run_chunks(run, self.bounds, self.threads)
        return noise, by_found, by_positions

    def compare(
        self,
        noise: np.ndarray,
        grey: np.ndarray,
        other_grey: np.ndarray,
        mask: np.ndarray,
        other_mask: np.ndarray,
        squared: bool,
        sizes: int,
        max_rise: float,
        min_spread: float,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return states (m,), errors (m,), their derivatives by depth (m,) and normal (m, 3)."""
        count, image = len(self.pixels), self.image
        states, errors = np.empty(count, np.uint8), np.empty(count)
        by_depth, by_normals = np.empty(count), np.empty((count, 3))

        def run(begin: int, end: int) -> None:
            compare_range(
                begin, end, self.pixels, noise, image.depth, image.geometric_normal, image.alpha,
                self.rotation, self.camera, self.other, self.pose, self.near_z, grey, other_grey,
                mask, other_mask, squared, sizes, max_rise, min_spread, states, errors, by_depth,
                by_normals,
            )  # fmt: skip

        run_chunks(run, self.bounds, self.threads)
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


def _finite(noise: np.ndarray) -> np.ndarray:
    return np.where(noise < np.inf, noise, 0.0)


def _pack(camera: Camera) -> np.ndarray:
    values = (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
    return np.array(values, np.float64)


def _check_sizes(camera: Camera, **arrays: np.ndarray | None) -> None:
    wanted = (camera.height, camera.width)
    for name, array in arrays.items():
        if array is not None and array.shape[:2] != wanted:
            height, width = array.shape[:2]
            raise UsageError(
                f"The {name} is {width} x {height} px, the camera {camera.width} x "
                f"{camera.height}.",
                "Use the camera of the same level.",
            )
