# SPDX-License-Identifier: GPL-3.0-or-later
"""Projection and tile binning on the GPU, as tensors: what precedes rasterisation."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from ... import tolerances
from ...dataset.camera import Camera
from ...errors import ResourceError
from ...gaussians.model import OrientedGaussians
from ..projection.projection import pack_camera, used_degree
from ..types.options import RenderOptions
from .kernels import CameraValues, Kernels
from .source import THREADS_PER_BLOCK

WARPS = THREADS_PER_BLOCK // 32
ROW_VALUES = 24
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
            torch.empty((count, ROW_VALUES), device=device),
            torch.empty((count, 4), device=device),
            torch.empty(count, dtype=torch.bool, device=device),
            torch.empty(count, device=device),
            torch.empty(count, device=device),
        )


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
            g.means,
            g.log_scales,
            g.quats,
            g.opacity_logits,
            g.sh,
            int(g.sh.shape[1]),
            self.degree,
            g.orientation,
            g.filter_3d,
            self.camera,
        )


def project(kernels: Kernels, raw: RawTensors) -> DeviceScreen:
    """Activate and project in float64, like ``projection.project_gaussians``."""
    count, device = len(raw.gaussians), raw.gaussians.means.device
    screen = DeviceScreen.empty(count, device)
    kernels.launch_each(
        "project_gaussians",
        count,
        *raw.arguments(),
        screen.params,
        screen.boxes,
        screen.visible,
        screen.depths,
        screen.skews,
    )
    return screen


def bin_bands(
    kernels: Kernels, screen: DeviceScreen, camera: Camera, budget_bytes: int
) -> Iterator[Band]:
    """Yield the tile lists of a view in bands of tile rows, as few as the budget allows.

    Parameters
    ----------
    budget_bytes : int
        Half of it is for what all bands keep for the backward pass, half for the gradient rows of
        one band at a time.

    Raises
    ------
    ResourceError
        If one tile row, or all lists together, exceed it.
    """
    tile = tolerances.TILE_PX
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
        "count_pairs",
        count,
        screen.boxes,
        screen.skews,
        screen.visible,
        camera.width,
        camera.height,
        first_row,
        end_row,
        counts,
    )
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
        "list_pairs",
        len(order),
        order,
        rank_offsets,
        intersection_offsets,
        screen.boxes,
        screen.skews,
        camera.width,
        camera.height,
        tiles_x,
        first_row,
        end_row,
        *unsorted.unbind(),
    )
    tiles = tiles_x * (end_row - first_row)
    # Short keys need half as many passes of the radix sort.
    keys = unsorted[0].to(torch.int16 if tiles < 2**15 else torch.int32)
    by_tile = torch.sort(keys, stable=True)
    edges = torch.arange(tiles + 1, dtype=keys.dtype, device=device)
    return Band(
        first_row,
        tiles,
        torch.searchsorted(by_tile.values, edges),
        unsorted[1][by_tile.indices],
        unsorted[2][by_tile.indices],
        intersection_offsets,
        torch.zeros((intersections, WARPS), dtype=torch.int32, device=device),
    )


def offsets(counts: Tensor) -> Tensor:
    """(n + 1,) int64 exclusive running sum."""
    offsets = torch.zeros(len(counts) + 1, dtype=torch.int64, device=counts.device)
    torch.cumsum(counts, 0, out=offsets[1:])
    return offsets
