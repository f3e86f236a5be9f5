# SPDX-License-Identifier: GPL-3.0-or-later
"""Isosurface depth and transmittance of a view at sub-pixel positions, and their gradients.

The depth is that of the image, at positions instead of pixel centres (docs/method.md, section 2.9):
the multi-view terms project a surface point into a neighbouring view and query the depth there.
This position moves with the Gaussians too, so the results are differentiable with respect to the
positions as well.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...dataset.camera import Camera
from ...errors import UsageError
from ...gaussians.model import OrientedGaussians
from ...kernels.parallel import (
    CHUNKS_PER_THREAD,
    balanced_bounds,
    default_threads,
    even_bounds,
    run_chunks,
)
from ..projection.projection import RawArrays, RawGradients, ScreenGaussians, project_backward
from ..raster.blend import ScreenView
from ..tiling.area_lists import AreaLists, SortedPositions, list_areas, sort_positions
from ..types.options import RenderOptions
from .depth_query_gradient import add_intersection_gradients, query_gradient_range
from .depth_query_kernels import query_kernel
from .fine_screen import project_finely
from .query_spans import GEOMETRY

_DEEPEST = 1e18
"""Depths are clamped to this, the square of which still fits a float32."""
_POSITION_COST = 256
"""Fixed cost of a position, in Gaussians that it evaluates."""
_TRAINED = ("means", "log_scales", "quats", "opacity_logits")


@dataclass(frozen=True)
class QueryView:
    """A projected view, for any number of queries."""

    gaussians: RawArrays
    camera: Camera
    options: RenderOptions
    screen: ScreenGaussians
    lists: AreaLists
    threads: int


@dataclass(frozen=True)
class QueryResult:
    """Results at m positions, and what the backward pass needs."""

    values: np.ndarray
    """(m,) float32: depth in scene units, or transmittance; 0 where there is none."""
    positions: SortedPositions
    at: np.ndarray  # (k,) float32 depth of the isosurface, or the requested one; sorted
    found: np.ndarray  # (k,) float32 the values, sorted
    slopes: np.ndarray  # (k,) float32 -d(log T)/dt there, floored where it is a depth's
    stops: np.ndarray  # (k,) int32
    solved: bool


def query_view(gaussians: RawArrays, camera: Camera, options: RenderOptions) -> QueryView:
    """Project Gaussians for queries only, including those between pixel centres.

    Parameters
    ----------
    gaussians : RawArrays
        Scene frame.
    camera : Camera
        In the scene frame.
    options : RenderOptions
        ``near_z``, ``depth_valid_transmittance`` and ``threads`` are used.

    Raises
    ------
    ResourceError
        If the tile lists are too long to be indexed.
    """
    threads = options.threads or default_threads()
    # Colours are not needed.
    lean = dataclasses.replace(gaussians, sh=np.ascontiguousarray(gaussians.sh[:, :1]))
    screen = project_finely(lean, camera, options)
    lists = list_areas(screen, camera.width, camera.height, threads)
    return QueryView(lean, camera, options, screen, lists, threads)


def query_view_of(view: ScreenView) -> QueryView:
    """Return a view for queries that shares the projection of a rendered view.

    Gradients on its ``screen.params`` add to those of :func:`~..raster.blend.blend_backward`. It
    contains only the Gaussians whose box contains a pixel centre: those that pass between pixel
    centres affect neither the image nor queries of this view.
    """
    lists = list_areas(view.screen, view.camera.width, view.camera.height, view.threads)
    return QueryView(view.gaussians, view.camera, view.options, view.screen, lists, view.threads)


def solve_depths(view: QueryView, positions: np.ndarray) -> QueryResult:
    """Solve the depth of the 0.5-isosurface at positions of a view.

    The definition is that of :func:`~..reference.reference.render_reference`: contributors have
    ``alpha >= 1/255`` and a transmittance of at least 1e-4 before them; there is no depth where
    the final transmittance exceeds ``depth_valid_transmittance`` or where the transmittance at
    depth 0 is below one half.

    Parameters
    ----------
    view : QueryView
    positions : (m, 2) array
        Pixels; rounded to float32.

    Returns
    -------
    QueryResult
        z-depths; 0 where there is none, outside ``[0, width] x [0, height]`` and for NaN.
    """
    sorted_positions = _sorted(view, positions)
    return _query(view, sorted_positions, np.zeros(len(sorted_positions.order), np.float32), True)


def solve_transmittances(view: QueryView, positions: np.ndarray, depths: np.ndarray) -> QueryResult:
    """Evaluate the transmittance of the contributors at positions up to z-depths.

    ``T(t) = prod_i (1 - G_i(t))``, over the same contributors and with the same cap of 0.99 as the
    isosurface, so that T is 0.5 at the depth of :func:`solve_depths`. The vacancy of
    :class:`~.vacancy.VacancyField` is the largest T of several cameras, with two
    differences: it includes all Gaussians with ``alpha >= 1/255`` and sets a product below 1e-4 to
    zero, whereas this omits what lies behind 1e-4 and can be slightly above 0; and it does not
    cap G, so this is larger by up to 1 % of T per Gaussian whose G exceeds 0.99. Around the
    surface, where no G exceeds 0.5, they are equal up to rounding.

    Parameters
    ----------
    view : QueryView
    positions : (m, 2) array
        Pixels; rounded to float32.
    depths : (m,) array
        z-depths, scene units; negative ones are clamped to 0.

    Returns
    -------
    QueryResult
        In [0, 1]; 0 outside the image and where a position or depth is NaN.
    """
    requested = np.asarray(depths, np.float64)
    if requested.shape != (len(positions),):
        raise UsageError(
            f"{len(positions)} positions came with depths of shape {requested.shape}.",
            "Give one depth per position.",
        )
    known = ~np.isnan(requested)
    coordinates = np.where(known[:, None], np.asarray(positions), np.nan)
    sorted_positions = _sorted(view, coordinates)
    at = np.clip(requested[sorted_positions.order], 0.0, _DEEPEST).astype(np.float32)
    return _query(view, sorted_positions, at, False)


def add_query_gradients(
    view: QueryView, result: QueryResult, grads: np.ndarray, grad_params: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Add the gradient of ``sum grads * values`` to that on the view's ``screen.params``.

    The gradient of a depth is that of the implicit function, with the floored slope of
    docs/method.md, section 2.5. Bitwise the same for any number of threads.

    Parameters
    ----------
    view : QueryView
        The view of the query.
    result : QueryResult
    grads : (m,) array
        On ``result.values``; ignored for positions without a result.
    grad_params : (n, 24) float32
        Accumulated into; columns from 13 on are unchanged.

    Returns
    -------
    grad_positions : (m, 2) float32
    grad_depths : (m,) float32
        On the depths of a transmittance query; 0 for a depth query.
    """
    positions, lists = result.positions, view.lists
    incoming = np.asarray(grads)[positions.order].astype(np.float32)  # (k,)
    if result.solved:
        weights = np.where(result.found > 0.0, incoming / result.slopes, np.float32(0.0))
        pull = np.zeros_like(weights)
    else:
        weights = incoming * result.found
        pull = -weights * result.slopes
    intersection_grads = np.zeros((len(lists.gaussian_ids), GEOMETRY), np.float32)
    grad_coordinates = np.zeros((len(positions.order), 2), np.float32)

    def run(first: int, end: int) -> None:
        query_gradient_range(
            first, end, view.screen.params, view.screen.boxes, view.screen.skews, lists.start,
            lists.gaussian_ids, lists.intersection_slots, lists.tiles_x, positions.shift,
            positions.start, positions.coordinates, result.at, weights, result.stops,
            intersection_grads, grad_coordinates,
        )  # fmt: skip

    bounds = balanced_bounds(_tile_costs(view, positions), view.threads * CHUNKS_PER_THREAD)
    run_chunks(run, bounds, view.threads)

    def combine(first: int, end: int) -> None:
        add_intersection_gradients(
            first, end, intersection_grads, lists.intersection_offsets, grad_params
        )

    run_chunks(combine, even_bounds(len(view.screen), view.threads), view.threads)
    count = len(result.values)
    grad_positions, grad_depths = np.zeros((count, 2), np.float32), np.zeros(count, np.float32)
    grad_positions[positions.order] = grad_coordinates
    grad_depths[positions.order] = pull
    return grad_positions, grad_depths


def query_depth(
    gaussians: OrientedGaussians,
    camera: Camera,
    positions_px: Tensor,
    options: RenderOptions | None = None,
) -> Tensor:
    """Return the isosurface depth at sub-pixel positions; see :func:`solve_depths`.

    Differentiable with respect to means, log_scales, quats, opacity_logits and positions;
    independent of harmonics and orientation.

    Parameters
    ----------
    gaussians : OrientedGaussians
        CPU tensors, scene frame.
    camera : Camera
        In the scene frame.
    positions_px : (m, 2) tensor
        Pixels, first pixel's centre at (0.5, 0.5); rounded to float32.
    options : RenderOptions, optional

    Returns
    -------
    (m,) float32 tensor
        z-depth in scene units; 0 where there is none, outside the image and for NaN.

    Raises
    ------
    UsageError
        If the positions are not (m, 2).
    """
    tensors = [getattr(gaussians, name) for name in _TRAINED]
    options = options or RenderOptions()
    return _Query.apply(*tensors, positions_px, None, gaussians, camera, options)


def query_transmittance(
    gaussians: OrientedGaussians,
    camera: Camera,
    positions_px: Tensor,
    depths: Tensor,
    options: RenderOptions | None = None,
) -> Tensor:
    """Return the transmittance up to z-depths; see :func:`solve_transmittances`.

    Parameters
    ----------
    gaussians, camera, positions_px, options
        As for :func:`query_depth`.
    depths : (m,) tensor
        Scene units; differentiable like the positions and the Gaussians.

    Returns
    -------
    (m,) float32 tensor
        In [0, 1]; 0 outside the image and for NaN.

    Raises
    ------
    UsageError
        If the positions are not (m, 2) or the depths not (m,).
    """
    tensors = [getattr(gaussians, name) for name in _TRAINED]
    options = options or RenderOptions()
    return _Query.apply(*tensors, positions_px, depths, gaussians, camera, options)


class _Query(torch.autograd.Function):
    """Projection, lists and query as one differentiable step."""

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        log_scales: Tensor,
        quats: Tensor,
        opacity_logits: Tensor,
        positions: Tensor,
        depths: Tensor | None,
        gaussians: OrientedGaussians,
        camera: Camera,
        options: RenderOptions,
    ) -> Tensor:
        view = query_view(RawArrays.from_gaussians(gaussians), camera, options)
        coordinates = positions.detach().cpu().numpy()
        if depths is None:
            result = solve_depths(view, coordinates)
        else:
            result = solve_transmittances(view, coordinates, depths.detach().cpu().numpy())
        ctx.view, ctx.result = view, result
        ctx.types = positions.dtype, depths.dtype if depths is not None else None
        # The backward pass reads their memory; saved so that autograd refuses to run after one of
        # them was modified in place.
        ctx.save_for_backward(means, log_scales, quats, opacity_logits)
        return torch.from_numpy(result.values)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        _ = ctx.saved_tensors
        view = ctx.view
        grad_params = np.zeros_like(view.screen.params)
        on_positions, on_depths = add_query_gradients(
            view, ctx.result, grad.detach().numpy(), grad_params
        )
        on_gaussians: list[Tensor | None] = [None] * len(_TRAINED)
        if any(ctx.needs_input_grad[: len(_TRAINED)]):
            raw = RawGradients.zeros(view.gaussians)
            project_backward(
                view.gaussians, view.camera, view.options, view.screen, grad_params, raw
            )
            on_gaussians = [torch.from_numpy(getattr(raw, name)) for name in _TRAINED]
        of_positions, of_depths = ctx.types
        return (
            *on_gaussians,
            torch.from_numpy(on_positions).to(of_positions),
            None if of_depths is None else torch.from_numpy(on_depths).to(of_depths),
            None,
            None,
            None,
        )


def _sorted(view: QueryView, positions: np.ndarray) -> SortedPositions:
    coordinates = np.asarray(positions)
    if coordinates.ndim != 2 or coordinates.shape[1] != 2:
        raise UsageError(
            f"Positions have the shape {coordinates.shape}.", "Give (m, 2) pixel coordinates."
        )
    return sort_positions(coordinates, view.camera.width, view.camera.height)


def _tile_costs(view: QueryView, positions: SortedPositions) -> np.ndarray:
    """(tiles,) approximate cost of the positions of each tile."""
    lengths = np.diff(view.lists.start)
    counts = np.diff(positions.start[:: 1 << (2 * positions.shift)])
    walked = lengths >> (2 * positions.shift)
    return counts * (walked + _POSITION_COST) + (counts > 0) * (lengths << positions.shift)


def _query(view: QueryView, positions: SortedPositions, at: np.ndarray, solve: bool) -> QueryResult:
    count = len(positions.order)
    found, slopes = np.zeros(count, np.float32), np.ones(count, np.float32)
    stops = np.zeros(count, np.int32)
    query_range = query_kernel(solve)
    limit = np.float32(view.options.depth_valid_transmittance)

    def run(first: int, end: int) -> None:
        query_range(
            first, end, view.screen.params, view.screen.boxes, view.screen.skews, view.lists.start,
            view.lists.gaussian_ids, view.lists.tiles_x, positions.shift, positions.start,
            positions.coordinates, limit, at, found, slopes, stops,
        )  # fmt: skip

    bounds = balanced_bounds(_tile_costs(view, positions), view.threads * CHUNKS_PER_THREAD)
    run_chunks(run, bounds, view.threads)
    values = np.zeros(positions.input_count, np.float32)
    values[positions.order] = found
    return QueryResult(values, positions, found if solve else at, found, slopes, stops, solve)
