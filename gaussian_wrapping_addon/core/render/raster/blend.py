# SPDX-License-Identifier: GPL-3.0-or-later
"""Blend the tiles of a view, forward and backward: multithreaded raster kernels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...dataset.camera import Camera
from ...kernels.huge_pages import empty_array
from ...kernels.parallel import even_bounds, run_chunks
from ..isosurface.isosurface_steps import LIST_VALUES
from ..projection.projection import RawArrays, ScreenGaussians
from ..simd.raster_math import ROW_VALUES, TILE, aligned_zeros
from ..tiling.tiles import TileLists
from ..types.options import RenderOptions
from .contributors import CONTRIBUTORS_PADDING
from .raster_backward import BACKWARD_SCRATCH, backward_kernel, sum_intersections
from .raster_forward import FORWARD_SCRATCH, forward_kernel

_MOST_BLOCKS = 32
"""Blocks of a tile if a block has eight pixels."""


def _take(pool: list[np.ndarray], count: int, make: Callable[[int], np.ndarray]) -> np.ndarray:
    """Return an array of at least ``count`` values from a pool, or a new, larger one."""
    try:
        kept = pool.pop()
    except IndexError:
        return make(count * 5 // 4)
    return kept if len(kept) >= count else make(count * 5 // 4)


@dataclass
class RenderBuffers:
    """Pools of large scratch arrays, kept between calls.

    Taken and returned with the atomic ``list.pop`` and ``list.append``, so that concurrent
    renderings never share one.
    """

    scratch: list[np.ndarray] = field(default_factory=list)
    lists: list[np.ndarray] = field(default_factory=list)
    contributors: list[np.ndarray] = field(default_factory=list)
    intersections: list[np.ndarray] = field(default_factory=list)
    renderers: list[Any] = field(default_factory=list)
    """Idle :class:`~..view_renderer.ViewRenderer` with their memory."""

    def reserve(self, threads: int, longest: int, *, depth: bool) -> None:
        """Allocate memory for every thread, so that allocation does not depend on timing.

        ``longest`` is the largest number of intersections of a tile; only depth needs lists.
        """
        spare = [
            (self.scratch, self.take_scratch()),
            (self.lists, self.take_lists(longest if depth else 0)),
            (self.contributors, self.take_contributors(longest)),
        ]
        for pool, array in spare:
            pool.append(array)
            while len(pool) < threads:
                pool.append(
                    array.copy() if pool is self.contributors else aligned_zeros(len(array))
                )

    def take_scratch(self) -> np.ndarray:
        """Return the uninitialised state of one thread's tile."""
        return _take(self.scratch, max(FORWARD_SCRATCH, BACKWARD_SCRATCH), aligned_zeros)

    def take_lists(self, longest: int) -> np.ndarray:
        """Return an uninitialised depth list for a block of a tile of ``longest`` intersections."""
        return _take(self.lists, longest * LIST_VALUES * TILE, aligned_zeros)

    def take_contributors(self, longest: int) -> np.ndarray:
        """Return uninitialised contributor lists for all blocks of such a tile."""
        count = _MOST_BLOCKS * (longest + CONTRIBUTORS_PADDING)
        return _take(self.contributors, count, lambda size: np.zeros(size, np.int32))

    def take_intersections(self, count: int) -> np.ndarray:
        """Return at least ``count`` uninitialised rows of intersection gradients."""
        try:
            kept = self.intersections.pop()
        except IndexError:
            kept = np.zeros((0, ROW_VALUES), np.float32)
        if len(kept) >= count:
            return kept
        return empty_array(count * 5 // 4 * ROW_VALUES, np.float32).reshape(-1, ROW_VALUES)


@dataclass(frozen=True)
class ScreenView:
    """One view, or a band of its tiles: state between projection and backward pass."""

    gaussians: RawArrays
    camera: Camera
    options: RenderOptions
    screen: ScreenGaussians
    lists: TileLists
    lanes: int
    masks: np.ndarray  # (intersections,) uint32: blocks of the tile that the ellipse reaches
    bounds: np.ndarray  # tiles of about equal cost
    threads: int

    def arguments(self) -> tuple[np.ndarray | int, ...]:
        """Return the view's arguments of the raster kernels, in order."""
        lists, camera = self.lists, self.camera
        return (
            self.screen.params, lists.start, lists.gaussian_ids, lists.intersection_slots,
            self.masks, lists.tiles_x, camera.width, camera.height,
        )  # fmt: skip


@dataclass(frozen=True)
class Images:
    """Images that the forward kernel writes, float32."""

    color: np.ndarray  # (h, w, 3)
    normal: np.ndarray  # (h, w, 3)
    geometric: np.ndarray  # (h, w, 3)
    alpha: np.ndarray  # (h, w)
    depth: np.ndarray  # (h, w)
    slope: np.ndarray  # (h, w) floored -d(log T)/dt at the depth; (0, 0) without depth
    strongest: np.ndarray  # (h, w) int32; (0, 0) without statistics

    @classmethod
    def allocate(
        cls,
        camera: Camera,
        options: RenderOptions,
        take: Callable[[str, tuple[int, ...], Any], np.ndarray] | None = None,
    ) -> Images:
        """Return zero images of the camera's size.

        With ``take(name, shape, dtype)`` they use the memory it returns; images of which
        :func:`blend` writes every pixel are not cleared then.
        """
        if take is None:

            def take(name: str, shape: tuple[int, ...], dtype: Any) -> np.ndarray:
                return np.zeros(shape, dtype)

        one = (camera.height, camera.width)
        three = (*one, 3)
        no_image = (0, 0)
        images = cls(
            color=take("color", three, np.float32),
            normal=take("normal", three, np.float32),
            geometric=take("geometric", three, np.float32),
            alpha=take("alpha", one, np.float32),
            depth=take("depth", one, np.float32),
            slope=take("slope", one if options.depth else no_image, np.float32),
            strongest=take("strongest", one if options.statistics else no_image, np.int32),
        )
        if not options.depth:
            images.depth.fill(0.0)
        return images

    def arguments(self) -> tuple[np.ndarray, ...]:
        """Return the images that both passes use, in the order of the raster kernels."""
        return self.color, self.normal, self.geometric, self.alpha, self.depth, self.slope


def blend(
    view: ScreenView,
    images: Images,
    buffers: RenderBuffers,
    intersection_weights: np.ndarray | None = None,
) -> np.ndarray:
    """Blend the tiles of a view into ``images`` and solve the isosurface depth.

    Parameters
    ----------
    intersection_weights : (intersections, 2) float32, optional
        Receives the weights; by default a new array.

    Returns
    -------
    (intersections, 2) float32
        Sum and maximum of the blending weight of each intersection, by slot; (0, 2) without
        statistics.
    """
    options, lists = view.options, view.lists
    depth, weights = options.depth, options.statistics
    if intersection_weights is None:
        intersection_weights = np.zeros((len(lists.gaussian_ids) if weights else 0, 2), np.float32)
    forward = forward_kernel(view.lanes, depth, weights)
    background = np.asarray(options.background, np.float32)
    limit = np.float32(options.depth_valid_transmittance)
    longest = int(np.diff(lists.start).max(initial=0))
    buffers.reserve(view.threads, longest, depth=depth)

    def run(first: int, end: int) -> None:
        scratch = buffers.take_scratch()
        entries = buffers.take_lists(longest if depth else 0)
        contributors = buffers.take_contributors(longest)
        forward(
            first,
            end,
            *view.arguments(),
            background,
            limit,
            scratch,
            entries,
            contributors,
            *images.arguments(),
            intersection_weights,
            images.strongest,
        )
        buffers.scratch.append(scratch)
        buffers.lists.append(entries)
        buffers.contributors.append(contributors)

    run_chunks(run, view.bounds, view.threads)
    return intersection_weights


def write_intersection_gradients(
    view: ScreenView,
    images: Images,
    grads: list[np.ndarray],
    buffers: RenderBuffers,
    intersections: np.ndarray,
    *,
    depth: bool,
    absolute: bool,
) -> None:
    """Write the gradients of a view's tile intersections to their slots.

    ``intersections (p, 24)`` receives them. Set ``depth`` if the gradient of the depth is not all
    0, ``absolute`` to include the sums of absolute values.
    """
    backward = backward_kernel(view.lanes, view.options.depth and depth, absolute)

    def run(first: int, end: int) -> None:
        scratch = buffers.take_scratch()
        backward(
            first,
            end,
            *view.arguments(),
            *images.arguments(),
            *grads,
            scratch,
            intersections,
        )
        buffers.scratch.append(scratch)

    run_chunks(run, view.bounds, view.threads)


def blend_backward(
    view: ScreenView,
    images: Images,
    grads: list[np.ndarray],
    buffers: RenderBuffers,
    *,
    absolute: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the gradient on params (n, 24), and its signed and absolute norms on (u, v), (n,)."""
    lists, count = view.lists, len(view.screen)
    intersections = buffers.take_intersections(len(lists.gaussian_ids))
    depth = bool(grads[4].any())
    write_intersection_gradients(
        view, images, grads, buffers, intersections, depth=depth, absolute=absolute
    )
    grad_params = np.zeros((count, ROW_VALUES), np.float32)
    grad_px = np.zeros(count, np.float32)
    grad_abs_px = np.zeros(count, np.float32)

    def combine(first: int, end: int) -> None:
        sum_intersections(
            first, end, intersections, lists.intersection_offsets, grad_params, grad_px, grad_abs_px
        )

    run_chunks(combine, even_bounds(count, view.threads), view.threads)
    buffers.intersections.append(intersections)
    return grad_params, grad_px, grad_abs_px
