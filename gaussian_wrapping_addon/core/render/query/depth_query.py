# SPDX-License-Identifier: GPL-3.0-or-later
"""Isosurface depth of a view at sub-pixel positions, and its gradient.

The depth is that of the image, at positions instead of pixel centres (docs/method.md, section 2.9):
the multi-view terms project a surface point into a neighbouring view and query the depth there.
This position moves with the Gaussians too, so the results are differentiable with respect to the
positions as well.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from ...dataset.camera import Camera
from ...errors import UsageError
from ...kernels.parallel import (
    CHUNKS_PER_THREAD,
    balanced_bounds,
    default_threads,
    even_bounds,
    run_chunks,
)
from ..projection.projection import RawArrays, ScreenGaussians
from ..tiling.area_lists import AreaLists, SortedPositions, list_areas, sort_positions
from ..types.options import RenderOptions
from .depth_query_gradient import add_intersection_gradients, query_gradient_range
from .depth_query_kernels import query_range
from .fine_screen import project_finely
from .query_spans import GEOMETRY

_POSITION_COST = 256
"""Fixed cost of a position, in Gaussians that it evaluates."""


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
    """(m,) float32: depth in scene units; 0 where there is none."""
    positions: SortedPositions
    found: np.ndarray  # (k,) float32 the values, sorted
    slopes: np.ndarray  # (k,) float32 -d(log T)/dt there, floored
    stops: np.ndarray  # (k,) int32


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

    Raises
    ------
    UsageError
        If the positions are not (m, 2).
    """
    coordinates = np.asarray(positions)
    if coordinates.ndim != 2 or coordinates.shape[1] != 2:
        raise UsageError(
            f"Positions have the shape {coordinates.shape}.", "Give (m, 2) pixel coordinates."
        )
    at = sort_positions(coordinates, view.camera.width, view.camera.height)
    count = len(at.order)
    found, slopes = np.zeros(count, np.float32), np.ones(count, np.float32)
    stops = np.zeros(count, np.int32)
    limit = np.float32(view.options.depth_valid_transmittance)

    def run(first: int, end: int) -> None:
        query_range(
            first, end, view.screen.params, view.screen.boxes, view.screen.skews, view.lists.start,
            view.lists.gaussian_ids, view.lists.tiles_x, at.shift, at.start, at.coordinates, limit,
            found, slopes, stops,
        )  # fmt: skip

    run_chunks(run, _tile_bounds(view, at), view.threads)
    values = np.zeros(at.input_count, np.float32)
    values[at.order] = found
    return QueryResult(values, at, found, slopes, stops)


def add_query_gradients(
    view: QueryView, result: QueryResult, grads: np.ndarray, grad_params: np.ndarray
) -> np.ndarray:
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
    (m, 2) float32
        The gradient on the positions.
    """
    positions, lists = result.positions, view.lists
    incoming = np.asarray(grads)[positions.order].astype(np.float32)  # (k,)
    weights = np.where(result.found > 0.0, incoming / result.slopes, np.float32(0.0))
    intersection_grads = np.zeros((len(lists.gaussian_ids), GEOMETRY), np.float32)
    grad_coordinates = np.zeros((len(positions.order), 2), np.float32)

    def run(first: int, end: int) -> None:
        query_gradient_range(
            first, end, view.screen.params, view.screen.boxes, view.screen.skews, lists.start,
            lists.gaussian_ids, lists.intersection_slots, lists.tiles_x, positions.shift,
            positions.start, positions.coordinates, result.found, weights, result.stops,
            intersection_grads, grad_coordinates,
        )  # fmt: skip

    run_chunks(run, _tile_bounds(view, positions), view.threads)

    def combine(first: int, end: int) -> None:
        add_intersection_gradients(
            first, end, intersection_grads, lists.intersection_offsets, grad_params
        )

    run_chunks(combine, even_bounds(len(view.screen), view.threads), view.threads)
    grad_positions = np.zeros((len(result.values), 2), np.float32)
    grad_positions[positions.order] = grad_coordinates
    return grad_positions


def _tile_bounds(view: QueryView, positions: SortedPositions) -> np.ndarray:
    """Return bounds of chunks of tiles whose positions cost about the same."""
    lengths = np.diff(view.lists.start)
    counts = np.diff(positions.start[:: 1 << (2 * positions.shift)])
    walked = lengths >> (2 * positions.shift)
    costs = counts * (walked + _POSITION_COST) + (counts > 0) * (lengths << positions.shift)
    return balanced_bounds(costs, view.threads * CHUNKS_PER_THREAD)
