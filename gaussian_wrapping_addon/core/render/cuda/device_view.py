# SPDX-License-Identifier: GPL-3.0-or-later
"""A view on the device: tile lists, forward and backward."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from ... import limits
from ...errors import ResourceError, UsageError
from ...gaussians.model import TRAINED, OrientedGaussians
from ...scene.camera import Camera
from ..projection import pack_camera, used_degree
from ..simd import ROW_VALUES
from ..types import RenderOptions
from .kernels import THREADS_PER_BLOCK, CameraValues, Kernels

# -- Projection and tile binning on the GPU, as tensors: what precedes rasterisation --------------


WARPS = THREADS_PER_BLOCK // 32
KEPT_BYTES = 4 + 4 + 4 * WARPS
"""Memory per intersection kept for the backward pass: Gaussian, slot, contribution masks."""
PASSING_BYTES = 4 * ROW_VALUES
"""Temporary memory per intersection of one band: its gradient row; binning needs less."""
MAX_INTERSECTIONS = 2**31 - 1


@dataclass(frozen=True)
class DeviceScreen:
    """Screen Gaussians like ``projection.ScreenGaussians``, on the device."""

    params: Tensor  # (n, 24) float32
    boxes: Tensor  # (n, 4) float32
    visible: Tensor  # (n,) bool
    depths: Tensor  # (n,) float32
    skews: Tensor  # (n,) float32

    @classmethod
    def empty(cls, count: int, device: torch.device) -> DeviceScreen:
        """Return a screen for a kernel to fill."""
        return cls(
            torch.empty((count, ROW_VALUES), device=device), torch.empty((count, 4), device=device),
            torch.empty(count, dtype=torch.bool, device=device), torch.empty(count, device=device),
            torch.empty(count, device=device),
        )  # fmt: skip


@dataclass(frozen=True)
class Band:
    """Tile lists of a band of tile rows like ``tiles.TileLists``, on the device."""

    first_row: int
    """First tile row; the tiles are numbered from its first one."""
    tiles: int
    start: Tensor  # (tiles + 1,) int64
    gaussian_ids: Tensor  # (intersections,) int32
    intersection_slots: Tensor  # (intersections,) int32
    intersection_offsets: Tensor  # (n + 1,) int64
    masks: Tensor  # (intersections, 8) int32: pixels of each warp that the Gaussian contributed to


@dataclass(frozen=True)
class RawTensors:
    """Raw parameters as the projection kernels read them, contiguous float32."""

    gaussians: OrientedGaussians
    degree: int
    camera: CameraValues

    @classmethod
    def of(cls, gaussians: OrientedGaussians, camera: Camera, options: RenderOptions) -> RawTensors:
        """Detach the tensors and pack the camera."""
        tensors = {name: tensor.detach().contiguous() for name, tensor in gaussians.tensors()}
        degree = used_degree(gaussians.sh.shape[1], options)
        packed = CameraValues.of(pack_camera(camera, options.near_z))
        return cls(OrientedGaussians(**tensors), degree, packed)

    def arguments(self) -> tuple[Tensor | int | CameraValues, ...]:
        """Return the arguments that projection forward and backward share."""
        g = self.gaussians
        return (
            g.means, g.log_scales, g.quats, g.opacity_logits, g.sh, int(g.sh.shape[1]), self.degree,
            g.orientation, g.filter_3d, self.camera,
        )  # fmt: skip


def project(kernels: Kernels, raw: RawTensors) -> DeviceScreen:
    """Activate and project in float64, like ``projection.project_gaussians``."""
    count, device = len(raw.gaussians), raw.gaussians.means.device
    screen = DeviceScreen.empty(count, device)
    kernels.launch_each(
        "project_gaussians", count, *raw.arguments(), screen.params, screen.boxes, screen.visible,
        screen.depths, screen.skews,
    )  # fmt: skip
    return screen


def bin_bands(
    kernels: Kernels, screen: DeviceScreen, camera: Camera, budget_bytes: int
) -> Iterator[Band]:
    """Yield the tile lists of a view in bands of tile rows, as few as the budget allows.

    Half of it is for what all bands keep for the backward pass, half for the gradient rows of one
    band at a time. Raises ResourceError if one tile row, or all lists together, exceed it.
    """
    tile = limits.TILE_PX
    tiles_x, tiles_y = -(-camera.width // tile), -(-camera.height // tile)
    # Invisible rows have infinite depth and come last; ties are ordered by index.
    order = torch.sort(screen.depths, stable=True).indices  # (n,) int64
    half = budget_bytes // 2
    max_band_intersections = min(half // PASSING_BYTES, MAX_INTERSECTIONS)
    kept = 0
    waiting = [(0, tiles_y)]
    while waiting:
        first_row, end_row = waiting.pop()
        counts = _count(kernels, screen, camera, first_row, end_row)
        intersections = int(counts.sum())
        if intersections > max_band_intersections:
            if end_row - first_row == 1:
                raise ResourceError(
                    f"One row of tiles of view {camera.name!r} holds {intersections} tile "
                    f"intersections; {max_band_intersections} fit.",
                    "Use smaller images or fewer Gaussians, or render on the CPU.",
                )
            middle = (first_row + end_row) // 2
            waiting += [(middle, end_row), (first_row, middle)]
            continue
        kept += intersections * KEPT_BYTES
        if kept > half:
            raise ResourceError(
                f"The tile lists of view {camera.name!r} need over {half} bytes of GPU memory.",
                "Use smaller images or fewer Gaussians, or render on the CPU.",
            )
        yield _list(
            kernels, screen, camera, order, counts, intersections, (tiles_x, first_row, end_row)
        )


def _count(
    kernels: Kernels, screen: DeviceScreen, camera: Camera, first_row: int, end_row: int
) -> Tensor:
    """(n,) int64 number of tiles that each Gaussian reaches in some tile rows."""
    count = len(screen.params)
    counts = torch.empty(count, dtype=torch.int64, device=screen.params.device)
    kernels.launch_each(
        "count_pairs", count, screen.boxes, screen.skews, screen.visible, camera.width,
        camera.height, first_row, end_row, counts,
    )  # fmt: skip
    return counts


def _list(
    kernels: Kernels,
    screen: DeviceScreen,
    camera: Camera,
    order: Tensor,
    counts: Tensor,
    intersections: int,
    tile_rows: tuple[int, int, int],
) -> Band:
    tiles_x, first_row, end_row = tile_rows
    device = order.device
    intersection_offsets = offsets(counts)
    rank_offsets = offsets(counts[order])
    unsorted = torch.empty((3, intersections), dtype=torch.int32, device=device)
    kernels.launch_each(
        "list_pairs", len(order), order, rank_offsets, intersection_offsets, screen.boxes,
        screen.skews, camera.width, camera.height, tiles_x, first_row, end_row, *unsorted.unbind(),
    )  # fmt: skip
    tiles = tiles_x * (end_row - first_row)
    masks = torch.zeros((intersections, WARPS), dtype=torch.int32, device=device)
    return Band(first_row, tiles, *sorted_by_tile(unsorted, tiles), intersection_offsets, masks)


def sorted_by_tile(unsorted: Tensor, tiles: int) -> tuple[Tensor, Tensor, Tensor]:
    """Sort (3, p) tiles, Gaussians and slots; return the tiles' starts, Gaussians and slots."""
    # Short keys need half as many passes of the radix sort.
    keys = unsorted[0].to(torch.int16 if tiles < 2**15 else torch.int32)
    by_tile = torch.sort(keys, stable=True)
    edges = torch.arange(tiles + 1, dtype=keys.dtype, device=keys.device)
    start = torch.searchsorted(by_tile.values, edges)
    return start, unsorted[1][by_tile.indices], unsorted[2][by_tile.indices]


def offsets(counts: Tensor) -> Tensor:
    """(n + 1,) int64 exclusive running sum."""
    offsets = torch.zeros(len(counts) + 1, dtype=torch.int64, device=counts.device)
    torch.cumsum(counts, 0, out=offsets[1:])
    return offsets


# -- One view rendered on a device: images, statistics and gradients as tensors that stay there


IMAGES = ("color", "normal", "geometric_normal", "alpha", "depth")


@dataclass(frozen=True)
class DeviceImages:
    """Images that the kernels write, float32."""

    color: Tensor  # (h, w, 3)
    normal: Tensor  # (h, w, 3)
    geometric_normal: Tensor  # (h, w, 3)
    alpha: Tensor  # (h, w)
    depth: Tensor  # (h, w)
    slope: Tensor  # (h, w); (0,) without depth
    strongest: Tensor  # (h, w) int32; (0,) without statistics

    @classmethod
    def allocate(cls, camera: Camera, options: RenderOptions, device: torch.device) -> DeviceImages:
        """Return images for the kernels to fill; depth is 0 unless it is solved."""
        shape = (camera.height, camera.width)
        return cls(
            torch.empty((*shape, 3), device=device), torch.empty((*shape, 3), device=device),
            torch.empty((*shape, 3), device=device), torch.empty(shape, device=device),
            torch.zeros(shape, device=device),
            torch.empty(shape if options.depth else (0,), device=device),
            torch.empty(shape if options.statistics else (0,), dtype=torch.int32, device=device),
        )  # fmt: skip


@dataclass
class DeviceStatistics:
    """:class:`~.types.RenderStatistics` as tensors; the weights are (0,) if not asked for.

    ``grad_px`` and ``grad_abs_px`` are filled by the backward pass.
    """

    reached: Tensor  # (n,) bool: has a tile in the image
    weight_sum: Tensor  # (n,) or (0,)
    weight_max: Tensor  # (n,) or (0,)
    grad_px: Tensor  # (n,) or (0,)
    grad_abs_px: Tensor  # (n,) or (0,)

    @classmethod
    def zeros(cls, count: int, options: RenderOptions, device: torch.device) -> DeviceStatistics:
        """Return statistics of ``count`` Gaussians before the first band."""
        weighed = count if options.statistics else 0
        gathered = count if options.gathers_statistics else 0
        return cls(
            torch.zeros(count, dtype=torch.bool, device=device),
            torch.zeros(weighed, device=device), torch.zeros(weighed, device=device),
            torch.zeros(gathered, device=device), torch.zeros(gathered, device=device),
        )  # fmt: skip


class DeviceView:
    """A rendered view, and what its backward pass needs.

    The Gaussians are float32 on one device and must not change before :meth:`backward`.
    ``budget_bytes`` is device memory for tile intersections; the options' own, and ``threads``, are
    for the CPU.

    Raises
    ------
    UsageError
        If a tensor is not float32 or on another device.
    ResourceError
        If the device memory does not suffice.
    """

    def __init__(
        self,
        kernels: Kernels,
        gaussians: OrientedGaussians,
        camera: Camera,
        options: RenderOptions,
        budget_bytes: int,
    ) -> None:
        device = gaussians.means.device
        for name, tensor in gaussians.tensors():
            if tensor.dtype != torch.float32 or tensor.device != device:
                raise UsageError(
                    f"{name} of the Gaussians is {tensor.dtype} on {tensor.device}.",
                    f"Give float32 on {device}.",
                )
        self._kernels, self.camera, self.options = kernels, camera, options
        with translated_out_of_memory(camera):
            self._raw = RawTensors.of(gaussians, camera, options)
            self.screen: DeviceScreen = project(kernels, self._raw)
            self.images = DeviceImages.allocate(camera, options, device)
            self.statistics = DeviceStatistics.zeros(len(gaussians), options, device)
            self.band_lists: list[Band] = []
            """What the bands of tile rows in which the image was rendered hold."""
            for band in bin_bands(kernels, self.screen, camera, budget_bytes):
                self._blend(band)
                self.band_lists.append(band)

    color = property(lambda self: self.images.color)
    normal = property(lambda self: self.images.normal)
    geometric_normal = property(lambda self: self.images.geometric_normal)
    alpha = property(lambda self: self.images.alpha)
    depth = property(lambda self: self.images.depth)

    def __len__(self) -> int:
        return len(self.screen.params)

    def radii_px(self) -> Tensor:
        """Return (n,) half of the longer side of each screen box, 0 for Gaussians not seen."""
        sides = (self.screen.boxes[:, 2:] - self.screen.boxes[:, :2]).amax(1)  # (n,)
        return torch.where(self.statistics.reached, 0.5 * sides, 0.0)

    def _blend(self, band: Band) -> None:
        kernels, screen, images, sums = self._kernels, self.screen, self.images, self.statistics
        weighed = self.options.statistics
        weights = screen.params.new_zeros((len(band.gaussian_ids) if weighed else 0, 2))
        kernels.launch(
            "forward_tiles_weights" if weighed else "forward_tiles", band.tiles, screen.params,
            screen.boxes, screen.skews, band.start, band.gaussian_ids, band.intersection_slots,
            *self._geometry(band), *(float(value) for value in self.options.background),
            images.color, images.normal, images.geometric_normal, images.alpha, band.masks, weights,
            images.strongest,
        )  # fmt: skip
        sums.reached.logical_or_(band.intersection_offsets.diff() > 0)
        if weighed:
            kernels.launch_each(
                "sum_weights", len(screen.params), weights, band.intersection_offsets,
                sums.weight_sum, sums.weight_max,
            )  # fmt: skip
        if self.options.depth:
            kernels.launch(
                "isosurface_tiles", band.tiles, screen.params, band.start, band.gaussian_ids,
                band.masks, *self._geometry(band), float(self.options.depth_valid_transmittance),
                images.alpha, images.depth, images.slope,
            )  # fmt: skip

    def params_gradient(self, incoming: list[Tensor | None]) -> Tensor:
        """Return the (n, 24) gradient on the screen params.

        ``incoming`` are contiguous gradients on the images of :data:`IMAGES`; ``None`` for zeros.
        """
        outputs = [getattr(self.images, name) for name in IMAGES]
        with_depth = self.options.depth and incoming[4] is not None
        gathers = self.options.gathers_statistics
        name = "backward_tiles" + ("_depth" if with_depth else "")
        name += "_absolute" if gathers else ""
        given = [
            torch.zeros_like(output) if grad is None else grad
            for output, grad in zip(outputs, incoming, strict=True)
        ]
        params, kernels = self.screen.params, self._kernels
        grad_params = torch.zeros_like(params)  # (n, 24)
        for band in self.band_lists:
            rows = params.new_empty((len(band.gaussian_ids), ROW_VALUES))
            kernels.launch(
                name, band.tiles, params, band.start, band.gaussian_ids, band.intersection_slots,
                band.masks, *self._geometry(band), *outputs, self.images.slope, *given, rows,
            )  # fmt: skip
            blocks = -(-len(params) // WARPS)
            kernels.launch(
                "sum_pairs", blocks, len(params), rows, band.intersection_offsets, grad_params
            )
        kernels.launch_each(
            "finish_params", len(params), int(gathers), grad_params, self.statistics.grad_px,
            self.statistics.grad_abs_px,
        )  # fmt: skip
        return grad_params

    def backward(self, incoming: list[Tensor | None]) -> dict[str, Tensor]:
        """Return the gradients of the trained tensors, rows of 0 for Gaussians not seen.

        ``incoming`` as for :meth:`params_gradient`.
        """
        with translated_out_of_memory(self.camera):
            return self._gaussian_gradients(self.params_gradient(incoming))

    def _gaussian_gradients(self, grad_params: Tensor) -> dict[str, Tensor]:
        raw = self._raw
        found = {name: torch.zeros_like(getattr(raw.gaussians, name)) for name in TRAINED}
        self._kernels.launch_each(
            "project_backward", len(grad_params), *raw.arguments(), self.screen.visible,
            grad_params, *found.values(),
        )  # fmt: skip
        return found

    def _geometry(self, band: Band) -> tuple[int, int, int, int]:
        """Return tiles per row, the band's first tile row, and the image size in pixels."""
        camera = self.camera
        tiles_x = -(-camera.width // limits.TILE_PX)
        return tiles_x, band.first_row, camera.width, camera.height


@contextlib.contextmanager
def translated_out_of_memory(camera: Camera) -> Iterator[None]:
    """Translate torch's out-of-memory error into a ``ResourceError``."""
    try:
        yield
    except torch.OutOfMemoryError as error:
        raise ResourceError(
            f"GPU memory does not suffice for view {camera.name!r}: {error}.",
            "Use smaller images or fewer Gaussians, or render on the CPU.",
        ) from None
