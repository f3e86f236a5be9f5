# SPDX-License-Identifier: GPL-3.0-or-later
"""Isosurface depth of a view at sub-pixel positions on the GPU, and its gradient.

The same definition and results as :mod:`.depth_query`. Nothing is copied to the host but
the number of tile intersections of each query.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ... import limits
from ...errors import ResourceError, UsageError
from ...gaussians.model import OrientedGaussians
from ...scene.camera import Camera
from ..query_kernels import fine_scale
from ..simd import ROW_VALUES
from ..types import RenderOptions
from .device_view import MAX_INTERSECTIONS, WARPS, DeviceScreen, RawTensors, offsets, sorted_by_tile
from .kernels import Kernels

_TRAINED = ("means", "log_scales", "quats", "opacity_logits")


@dataclass(frozen=True)
class DeviceQueryView:
    """A projected view, for any number of queries."""

    kernels: Kernels
    raw: RawTensors
    """Gaussians with one coefficient of colour, and the camera."""
    camera: Camera
    options: RenderOptions
    screen: DeviceScreen
    """Also Gaussians between pixel centres; colours and learned normals are 0."""


@dataclass(frozen=True)
class PointLists:
    """For each tile, the Gaussians whose ellipse reaches the rectangle around its points."""

    start: Tensor  # (tiles + 1,) int64
    gaussian_ids: Tensor  # (intersections,) int32, nearest first
    intersection_slots: Tensor  # (intersections,) int32
    intersection_offsets: Tensor  # (n + 1,) int64: the slots of Gaussian i


@dataclass(frozen=True)
class SortedPoints:
    """Positions by tile; those outside the image last, in a tile that does not exist."""

    coordinates: Tensor  # (m, 2) float32, pixels
    order: Tensor  # (m,) int64: index of each in the input
    tiles: Tensor  # (m,) int32
    start: Tensor  # (tiles + 1,) int64


@dataclass(frozen=True)
class DeviceQueryResult:
    """Results at m positions, and what the backward pass needs."""

    values: Tensor
    """(m,) float32: depth in scene units; 0 where there is none."""
    points: SortedPoints
    lists: PointLists
    found: Tensor  # (m,) float32 the values, sorted
    slopes: Tensor  # (m,) float32 -d(log T)/dt there, floored; sorted
    stops: Tensor  # (m,) int32, sorted


def query_view(
    kernels: Kernels, gaussians: OrientedGaussians, camera: Camera, options: RenderOptions
) -> DeviceQueryView:
    """Project float32 Gaussians for queries only, including those between pixel centres.

    Of the options ``near_z`` and ``depth_valid_transmittance`` are used.
    """
    raw = RawTensors.of(gaussians.replaced(sh=gaussians.sh[:, :1]), camera, options)
    count, device = len(gaussians), gaussians.means.device
    screen = DeviceScreen.empty(count, device)
    kernels.launch_each(
        "project_finely", count, *raw.arguments(), fine_scale(camera), screen.params, screen.boxes,
        screen.visible, screen.depths, screen.skews,
    )  # fmt: skip
    return DeviceQueryView(kernels, raw, camera, options, screen)


def solve_depths(view: DeviceQueryView, positions: Tensor) -> DeviceQueryResult:
    """Solve the depth of the 0.5-isosurface at positions of a view.

    ``positions (m, 2)`` are pixels, on the view's device; UsageError if their shape differs,
    ResourceError if the tile lists are too long to be indexed. The result is 0 where there is no
    depth, outside ``[0, width] x [0, height]`` and for NaN.
    """
    if positions.dim() != 2 or positions.shape[1] != 2:
        raise UsageError(
            f"Positions have the shape {tuple(positions.shape)}.", "Give (m, 2) pixel coordinates."
        )
    tiles = _tile_counts(view.camera)
    points = _sort_points(positions.detach().float(), view.camera)
    lists = _list_points(view, points)
    count = len(points.order)
    found, slopes = torch.empty((2, count), device=positions.device).unbind()
    stops = torch.empty(count, dtype=torch.int32, device=positions.device)
    view.kernels.launch(
        "solve_points", -(-count // WARPS), count, view.screen.params, lists.start,
        lists.gaussian_ids, tiles[0] * tiles[1], points.tiles, points.coordinates,
        float(view.options.depth_valid_transmittance), found, slopes, stops,
    )  # fmt: skip
    values = torch.empty_like(found)
    values[points.order] = found
    return DeviceQueryResult(values, points, lists, found, slopes, stops)


def add_query_gradients(
    view: DeviceQueryView, result: DeviceQueryResult, grads: Tensor, grad_params: Tensor
) -> Tensor:
    """Add the gradient of ``sum grads * values`` to that on the view's ``screen.params``.

    Bitwise reproducible on the same GPU. ``grads (m,)`` are ignored for positions without a result;
    columns of ``grad_params (n, 24) float32`` from 13 on are unchanged. Returns the (m, 2) float32
    gradient on the positions.
    """
    points, lists, params = result.points, result.lists, view.screen.params
    incoming = grads[points.order].float() / result.slopes
    weights = torch.where(result.found > 0.0, incoming, 0.0)  # (m,)
    tiles_x, tiles_y = _tile_counts(view.camera)
    rows = params.new_empty((len(lists.gaussian_ids), ROW_VALUES))
    view.kernels.launch(
        "query_gradients", tiles_x * tiles_y, params, lists.start, lists.gaussian_ids,
        lists.intersection_slots, points.start, points.coordinates, result.found, weights,
        result.stops, rows,
    )  # fmt: skip
    view.kernels.launch(
        "sum_pairs", -(-len(params) // WARPS), len(params), rows, lists.intersection_offsets,
        grad_params,
    )  # fmt: skip
    count = len(weights)
    by_coordinates = params.new_empty((count, 2))
    view.kernels.launch(
        "position_gradients", -(-count // WARPS), count, params, lists.start, lists.gaussian_ids,
        tiles_x * tiles_y, points.tiles, points.coordinates, result.found, weights, result.stops,
        by_coordinates,
    )  # fmt: skip
    grad_positions = torch.empty_like(by_coordinates)
    grad_positions[points.order] = by_coordinates
    return grad_positions


def project_query_gradients(
    view: DeviceQueryView, result: DeviceQueryResult, grad_params: Tensor
) -> dict[str, Tensor]:
    """Return the gradients on the raw parameters from those on the view's ``screen.params``.

    ``grad_params (n, 24) float32`` holds the gradients of this one query; rows that are not finite
    are set to 0. Returns tensors (n, ...) of means, log_scales, quats and opacity_logits, 0 where
    not reached.
    """
    count = len(grad_params)
    nothing = grad_params.new_empty(0)
    view.kernels.launch_each("finish_params", count, 0, grad_params, nothing, nothing)
    reached = view.screen.visible & (result.lists.intersection_offsets.diff() > 0)
    gaussians = view.raw.gaussians
    found = {name: torch.zeros_like(getattr(gaussians, name)) for name in _TRAINED}
    view.kernels.launch_each(
        "project_backward", count, *view.raw.arguments(), reached, grad_params, *found.values(),
        torch.zeros_like(gaussians.sh), torch.zeros_like(gaussians.orientation),
    )  # fmt: skip
    return found


def _tile_counts(camera: Camera) -> tuple[int, int]:
    tile = limits.TILE_PX
    return -(-camera.width // tile), -(-camera.height // tile)


def _sort_points(positions: Tensor, camera: Camera) -> SortedPoints:
    tiles_x, tiles_y = _tile_counts(camera)
    x, y = positions.unbind(1)
    # False for NaN.
    inside = (x >= 0.0) & (y >= 0.0) & (x <= camera.width) & (y <= camera.height)  # (m,)
    cells = torch.where(inside[:, None], positions, 0.0).div_(limits.TILE_PX).int()
    column, row = cells.unbind(1)
    tile = row.clamp(max=tiles_y - 1) * tiles_x + column.clamp(max=tiles_x - 1)
    keys = torch.where(inside, tile, tiles_x * tiles_y).int()
    by_tile = torch.sort(keys, stable=True)
    edges = torch.arange(tiles_x * tiles_y + 1, dtype=torch.int32, device=positions.device)
    return SortedPoints(
        positions[by_tile.indices], by_tile.indices, by_tile.values,
        torch.searchsorted(by_tile.values, edges),
    )  # fmt: skip


def _list_points(view: DeviceQueryView, points: SortedPoints) -> PointLists:
    screen, kernels = view.screen, view.kernels
    tiles_x, tiles_y = _tile_counts(view.camera)
    tiles, count, device = tiles_x * tiles_y, len(screen.params), screen.params.device
    areas = torch.empty((tiles, 4), device=device)
    kernels.launch_each("bound_points", tiles, points.start, points.coordinates, areas)
    counts = torch.empty(count, dtype=torch.int64, device=device)
    ellipses = (screen.boxes, screen.skews)
    kernels.launch_each(
        "count_areas", count, *ellipses, screen.visible, areas, tiles_x, tiles_y, counts
    )
    order = torch.sort(screen.depths, stable=True).indices  # (n,) int64
    intersection_offsets, rank_offsets = offsets(counts), offsets(counts[order])
    intersections = int(intersection_offsets[-1])
    if intersections > MAX_INTERSECTIONS:
        raise ResourceError(
            f"{intersections} tile intersections do not fit.", "Query a smaller image."
        )
    unsorted = torch.empty((3, intersections), dtype=torch.int32, device=device)
    kernels.launch_each(
        "list_areas", count, order, rank_offsets, intersection_offsets, *ellipses, areas, tiles_x,
        tiles_y, *unsorted.unbind(),
    )  # fmt: skip
    return PointLists(*sorted_by_tile(unsorted, tiles), intersection_offsets)
