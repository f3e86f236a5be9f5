# SPDX-License-Identifier: GPL-3.0-or-later
"""Rendering without autograd: images in reused memory, gradients of visible Gaussians only.

Data that grows with the number of tile intersections exists for one band of tiles at a time: the
tile lists and, in the backward pass, the gradients of the intersections, which are added to the
Gaussians' rows before the next band. The bands depend on the scene and the memory budget alone, so
gradients do not depend on the number of threads.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..errors import UsageError
from ..parallel import (
    CHUNKS_PER_THREAD,
    ArrayStore,
    balanced_bounds,
    default_threads,
    even_bounds,
    run_chunks,
)
from ..scene.camera import Camera
from .projection import RawArrays, ScreenGaussians, project_backward_visible, project_gaussians
from .raster import (
    Images,
    RenderBuffers,
    ScreenView,
    add_intersection_gradients,
    add_intersection_weights,
    blend,
    mark_visible,
    write_intersection_gradients,
    write_screen_gradients,
)
from .simd import ROW_VALUES, vector_lanes
from .tile_kernels import mask_kernel
from .tiles import TileBinning, TileLists
from .types import ImageGradients, RenderOptions, RenderStatistics, VisibleGradients

INTERSECTION_BYTES = 4 * ROW_VALUES + 32
"""Memory of one intersection: gradient, list entry, block mask, blending weights."""

# Fixed cost of a tile, in intersections: clearing and writing its pixels.
_TILE_COST = 16
_MAX_ZERO_IMAGES = 4


def allocate_screen(count: int, store: ArrayStore) -> ScreenGaussians:
    """Return uninitialised arrays for the projection of ``count`` Gaussians."""
    return ScreenGaussians(
        store.take("params", (count, ROW_VALUES), np.float32),
        store.take("boxes", (count, 4), np.float32), store.take("in image", count, np.bool_),
        store.take("depths", count, np.float32), store.take("skews", count, np.float32),
    )  # fmt: skip


def band_view(
    gaussians: RawArrays,
    camera: Camera,
    options: RenderOptions,
    screen: ScreenGaussians,
    lists: TileLists,
    band: tuple[int, int],
    store: ArrayStore,
) -> ScreenView:
    """Return the view of a band of tiles, without the tiles of other bands."""
    threads = options.threads or default_threads()
    first, end = band
    costs = np.diff(lists.start[first : end + 1]) + _TILE_COST
    bounds = first + balanced_bounds(costs, threads * CHUNKS_PER_THREAD if threads > 1 else 1)
    lanes = vector_lanes()
    masks = store.take("masks", len(lists.gaussian_ids), np.uint32)
    mask_range = mask_kernel(lanes)
    run_chunks(
        lambda begin, end: mask_range(
            begin, end, lists.start, lists.gaussian_ids, screen.boxes, screen.skews, lists.tiles_x,
            masks,
        ),
        bounds,
        threads,
    )  # fmt: skip
    return ScreenView(gaussians, camera, options, screen, lists, lanes, masks, bounds, threads)


class ViewPass:
    """One rendered view. Its arrays are valid until its renderer is used again.

    Attributes
    ----------
    color, normal, geometric_normal : (h, w, 3) float32
    alpha, depth : (h, w) float32
        The images of :class:`~.types.Render`. They must not be modified before
        :meth:`backward`.
    gaussians, screen : RawArrays, ScreenGaussians
        What was rendered, and its projection.
    ids : (v,) int32
        The Gaussians that reach a tile of the image, increasing.
    bands : int
        Number of bands in which the image was rendered.
    statistics : RenderStatistics or None
        With ``options.statistics`` or ``options.screen_gradients``; ``grad_px`` and
        ``grad_abs_px`` are filled by :meth:`backward`.
    """

    def __init__(
        self,
        renderer: ViewRenderer,
        gaussians: RawArrays,
        camera: Camera,
        options: RenderOptions,
        screen: ScreenGaussians,
        binning: TileBinning,
        images: Images,
    ) -> None:
        self._renderer, self._store = renderer, renderer.store
        self._number = renderer.rendered
        self.gaussians, self.screen = gaussians, screen
        self._camera, self._options = camera, options
        self._binning, self._images = binning, images
        self.color, self.normal = images.color, images.normal
        self.geometric_normal = images.geometric
        self.alpha, self.depth = images.alpha, images.depth
        self.ids = binning.ids
        self.statistics: RenderStatistics | None = None
        self._threads = options.threads or default_threads()
        self._max_intersections = max(1, options.budget_bytes // INTERSECTION_BYTES)
        self._bands = binning.bands(self._max_intersections)
        self._listed: tuple[tuple[int, int], ScreenView] | None = None

    @property
    def bands(self) -> int:
        """Number of bands in which the image is rendered."""
        return len(self._bands)

    def _view(self, band: tuple[int, int]) -> ScreenView:
        """Return the view of a band; only one band's lists exist at a time."""
        if self._listed is None or self._listed[0] != band:
            lists = self._binning.lists(*band, max_intersections=self._max_intersections)
            view = band_view(
                self.gaussians, self._camera, self._options, self.screen, lists, band, self._store
            )
            self._listed = band, view
        return self._listed[1]

    def _for_visible(self, kernel: Any, *arguments: Any) -> None:
        """Run a kernel over ``ids``, in chunks."""
        bounds = even_bounds(len(self.ids), self._threads, 4 if self._threads > 1 else 1)
        run_chunks(
            lambda begin, end: kernel(begin, end, self.ids, *arguments), bounds, self._threads
        )

    def forward(self) -> None:
        """Blend all bands; called once, by the renderer."""
        if self._options.gathers_statistics:
            self.statistics = self._first_statistics()
        for band in self._bands:
            view = self._view(band)
            intersections = len(view.lists.gaussian_ids) if self._options.statistics else 0
            weights = self._store.take(
                "intersection weights", (intersections, 2), np.float32, self._max_intersections
            )
            blend(view, self._images, self._renderer.buffers, weights)
            if self._options.statistics and self.statistics is not None:
                self._for_visible(
                    add_intersection_weights, weights, view.lists.intersection_offsets,
                    self.statistics.weight_sum, self.statistics.weight_max,
                )  # fmt: skip

    def _first_statistics(self) -> RenderStatistics:
        """Return statistics with what binning determines; all others are 0."""
        count, weighed = len(self.gaussians), self._options.statistics
        zeros = self._store.zeros
        statistics = RenderStatistics(
            visible=zeros("visible", count, np.bool_),
            radii_px=zeros("radii", count, np.float32),
            weight_sum=zeros("weight sum", count if weighed else 0, np.float32),
            weight_max=zeros("weight max", count if weighed else 0, np.float32),
            grad_px=zeros("grad px", count, np.float32),
            grad_abs_px=zeros("grad abs px", count, np.float32),
            strongest=self._images.strongest if weighed else None,
        )

        self._for_visible(mark_visible, self.screen.boxes, statistics.visible, statistics.radii_px)
        return statistics

    def backward(self, grads: ImageGradients) -> VisibleGradients:
        """Return the gradient with respect to the raw parameters of the visible Gaussians.

        ``grads`` are arrays of the images' shapes. One row for every Gaussian that reaches a tile
        of the image; valid until the renderer is used again.

        Raises
        ------
        UsageError
            If the shape of a gradient differs from that of its image, or if the renderer has
            rendered another view since.
        """
        grad_params = self.params_gradient(grads)
        return project_backward_visible(
            self.gaussians, self._camera, self._options, self.screen, grad_params, self.ids,
            self._store.take,
        )  # fmt: skip

    def params_gradient(self, grads: ImageGradients) -> np.ndarray:
        """Return the (n, 24) float32 gradient on the screen params; only rows ``ids`` are valid."""
        if self._renderer.rendered != self._number:
            raise UsageError(
                "The memory of this view was reused by a later rendering.",
                "Run backward before the next rendering, or use another renderer.",
            )
        incoming = self._incoming(grads)
        depth = grads.depth is not None and bool(incoming[4].any())
        absolute = self.statistics is not None
        store = self._store
        grad_params = store.take("grad params", (len(self.gaussians), ROW_VALUES), np.float32)
        # The lists of the last band still exist.
        for band in reversed(self._bands):
            view = self._view(band)
            intersections = store.take(
                "intersections", (len(view.lists.gaussian_ids), ROW_VALUES), np.float32,
                self._max_intersections,
            )  # fmt: skip
            write_intersection_gradients(
                view, self._images, incoming, self._renderer.buffers, intersections, depth=depth,
                absolute=absolute,
            )  # fmt: skip
            self._for_visible(
                add_intersection_gradients, intersections, view.lists.intersection_offsets,
                band == self._bands[-1], grad_params,
            )  # fmt: skip
        if self.statistics is not None:
            self._for_visible(
                write_screen_gradients, grad_params, self.statistics.grad_px,
                self.statistics.grad_abs_px,
            )  # fmt: skip
        return grad_params

    def _incoming(self, grads: ImageGradients) -> list[np.ndarray]:
        """Return the five image gradients, zeros for those that are ``None``."""
        incoming = []
        for name in ("color", "normal", "geometric_normal", "alpha", "depth"):
            image, grad = getattr(self, name), getattr(grads, name)
            if grad is None:
                grad = self._renderer.zero_image(image.shape)
            elif grad.shape != image.shape:
                raise UsageError(
                    f"The gradient of {name} is {grad.shape}, the image {image.shape}.",
                    "Give one value per value of the image.",
                )
            incoming.append(np.ascontiguousarray(grad, np.float32))
        return incoming


class ViewRenderer:
    """Renders one view after the other in the same memory; not thread-safe.

    After a view of the largest image and number of Gaussians, no memory that grows with Gaussians,
    pixels or intersections is allocated any more. ``buffers`` is scratch memory of the threads; by
    default its own.
    """

    def __init__(self, buffers: RenderBuffers | None = None) -> None:
        self.store = ArrayStore()
        self.buffers = RenderBuffers() if buffers is None else buffers
        self.rendered = 0
        """Number of views rendered; the memory holds the last one."""
        self._zero_images: dict[tuple[int, ...], np.ndarray] = {}

    def render(
        self,
        gaussians: RawArrays,
        camera: Camera,
        options: RenderOptions | None = None,
        images: Images | None = None,
    ) -> ViewPass:
        """Render like :func:`~.render`, without autograd; Gaussians and camera in the scene frame.

        The parameters must not change before :meth:`ViewPass.backward` has run. The result of the
        previous call is overwritten. ``images`` receives the images; by default memory of the
        renderer. Raises ResourceError if the tile lists or the contributor lists grow beyond what
        can be addressed.
        """
        options = options or RenderOptions()
        threads = options.threads or default_threads()
        store = self.store
        self.rendered += 1
        screen = project_gaussians(
            gaussians, camera, options, allocate_screen(len(gaussians), store)
        )
        binning = TileBinning(screen, camera.width, camera.height, threads, store)
        if images is None:
            images = Images.allocate(camera, options, store.take)
        view = ViewPass(self, gaussians, camera, options, screen, binning, images)
        view.forward()
        return view

    def zero_image(self, shape: tuple[int, ...]) -> np.ndarray:
        """Return a shared image of zeros; read-only by convention."""
        if shape not in self._zero_images:
            if len(self._zero_images) >= _MAX_ZERO_IMAGES:
                self._zero_images.clear()
            self._zero_images[shape] = np.zeros(shape, np.float32)
        return self._zero_images[shape]
