# SPDX-License-Identifier: GPL-3.0-or-later
"""Images and isosurface depth of a scene in float64, from Sigma, mu and the ray of each pixel.

What the errors of the renderers are measured against. It shares no formula with the kernels: a
Gaussian on a ray is evaluated in its own whitened frame, and the depth is bisected (docs/method.md,
sections 2.2 to 2.4). Only the features (colour and normals) come from the torch reference in
float64.
"""

from __future__ import annotations

import dataclasses
import math

import numba
import numpy as np
import torch

from gaussian_wrapping_addon.core import tolerances
from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.kernels.parallel import default_threads, even_bounds, run_chunks
from gaussian_wrapping_addon.core.render.reference.reference_projection import reference_projection
from gaussian_wrapping_addon.core.render.types.options import RenderOptions

TILE = 16
_MARGIN_PX = 0.01
_BISECTIONS = 70
_ALPHA_MIN, _ALPHA_MAX = tolerances.ALPHA_MIN, tolerances.ALPHA_MAX
_T_MIN, _LEVEL = tolerances.TRANSMITTANCE_MIN, tolerances.ISO_LEVEL


@dataclasses.dataclass(frozen=True)
class Tiles:
    """Gaussians that may reach each tile of 16 x 16 pixels, in blending order."""

    start: np.ndarray  # (tiles + 1,) int64
    ids: np.ndarray  # (pairs,) int64
    tiles_x: int

    def of(self, tile: int) -> np.ndarray:
        """Return the Gaussians of one tile."""
        return self.ids[self.start[tile] : self.start[tile + 1]]


@dataclasses.dataclass(frozen=True)
class ExactImages:
    """The definition's images of one view, float64."""

    color: np.ndarray  # (h, w, 3)
    normal: np.ndarray  # (h, w, 3)
    geometric_normal: np.ndarray  # (h, w, 3)
    alpha: np.ndarray  # (h, w)
    depth: np.ndarray  # (h, w) 0 where there is none
    slope: np.ndarray  # (h, w) -d(log T)/dt at the depth


def as_float64(gaussians: OrientedGaussians) -> OrientedGaussians:
    """Return the same values, detached, in float64."""
    return gaussians.replaced(**{k: v.detach().double() for k, v in gaussians.tensors()})


def exact_tiles(gaussians: OrientedGaussians, camera: Camera, options: RenderOptions) -> Tiles:
    """List the Gaussians of each tile by the box of their ellipse ``alpha >= 1/255``, in float64.

    Where ``num <= limit den`` is not an ellipse, the Gaussian is listed in every tile.
    """
    with torch.no_grad():
        screen = reference_projection(as_float64(gaussians), camera, options)
    params, usable = screen.params.numpy(), screen.usable.numpy()
    order = np.flatnonzero(usable)
    distances = screen.depths.numpy()[order].astype(np.float32)
    order = order[np.argsort(distances, kind="stable")]  # (m,)
    u, v, qa, qb, qc, px, py, r, s, t, _, opacity = params[order, :12].T
    limit = 2.0 * np.log(255.0 * opacity)
    # d^T M d - 2 limit p.d <= limit, about its own centre.
    m00, m01, m11 = qa - limit * r, 0.5 * (qb - limit * s), qc - limit * t
    with np.errstate(all="ignore"):
        det = m00 * m11 - m01 * m01
        center_x = limit * (m11 * px - m01 * py) / det
        center_y = limit * (m00 * py - m01 * px) / det
        level = limit * (1.0 + px * center_x + py * center_y)
        half_x, half_y = np.sqrt(level * m11 / det), np.sqrt(level * m00 / det)
    bounded = (m00 > 0) & (det > 1e-9 * m00 * m11) & np.isfinite(half_x) & np.isfinite(half_y)
    tiles_x, tiles_y = -(-camera.width // TILE), -(-camera.height // TILE)

    def tile_range(center: np.ndarray, half: np.ndarray, tiles: int) -> tuple[np.ndarray, ...]:
        reach = half * (1.0 + 1e-6) + _MARGIN_PX - 0.5
        low = np.where(bounded, np.ceil(center - 1.0 - reach), 0.0)
        high = np.where(bounded, np.floor(center + reach), tiles * TILE)
        clipped = np.clip([low, high], -TILE, tiles * TILE).astype(np.int64) // TILE
        return np.maximum(clipped[0], 0), np.minimum(clipped[1], tiles - 1)

    left, right = tile_range(u + center_x, half_x, tiles_x)
    top, bottom = tile_range(v + center_y, half_y, tiles_y)
    wide, tall = np.maximum(right - left + 1, 0), np.maximum(bottom - top + 1, 0)
    counts = wide * tall
    rank = np.repeat(np.arange(len(order)), counts)  # (pairs,)
    within = np.arange(len(rank)) - np.repeat(np.cumsum(counts) - counts, counts)
    tile = (top[rank] + within // wide[rank]) * tiles_x + left[rank] + within % wide[rank]
    by_tile = np.argsort(tile, kind="stable")
    start = np.zeros(tiles_x * tiles_y + 1, np.int64)
    np.cumsum(np.bincount(tile, minlength=tiles_x * tiles_y), out=start[1:])
    return Tiles(start, order[rank[by_tile]], tiles_x)


@numba.njit(nogil=True, error_model="numpy", cache=True)
def _transmittance(t: float, found: np.ndarray, count: int) -> float:
    product = 1.0
    for k in range(count):
        ahead = max(found[k, 1] - t, 0.0)
        density = math.exp(found[k, 0] - 0.5 * found[k, 2] * ahead * ahead)
        product *= 1.0 - min(density, _ALPHA_MAX)
    return product


@numba.njit(nogil=True, error_model="numpy", cache=True)
def _render_tiles(
    first_tile: int,
    end_tile: int,
    whitened: np.ndarray,  # (n, 3, 4): L, then L mu
    log_opacity: np.ndarray,
    features: np.ndarray,
    start: np.ndarray,
    ids: np.ndarray,
    tiles_x: int,
    lens: np.ndarray,
    width: int,
    height: int,
    limit: float,
    images: np.ndarray,
) -> None:
    m, d = np.zeros(3), np.zeros(3)
    for tile in range(first_tile, end_tile):
        count = start[tile + 1] - start[tile]
        found = np.zeros((count, 3))  # log alpha, peak, sharpness of the contributors
        top, left = tile // tiles_x * TILE, tile % tiles_x * TILE
        for row in range(top, min(top + TILE, height)):
            for column in range(left, min(left + TILE, width)):
                x = (column + 0.5 - lens[2]) / lens[0]
                y = (row + 0.5 - lens[3]) / lens[1]
                through, number, high = 1.0, 0, 0.0
                for k in range(start[tile], start[tile + 1]):
                    if through < _T_MIN:
                        break
                    i = ids[k]
                    for axis in range(3):
                        w = whitened[i, axis]
                        m[axis] = w[3]
                        d[axis] = w[0] * x + w[1] * y + w[2]
                    sharpness = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
                    peak = (m[0] * d[0] + m[1] * d[1] + m[2] * d[2]) / sharpness
                    a = m[1] * d[2] - m[2] * d[1]
                    b = m[2] * d[0] - m[0] * d[2]
                    c = m[0] * d[1] - m[1] * d[0]
                    log_alpha = log_opacity[i] - 0.5 * (a * a + b * b + c * c) / sharpness
                    alpha = min(math.exp(log_alpha), _ALPHA_MAX)
                    if alpha >= _ALPHA_MIN:
                        for f in range(9):
                            images[row, column, f] += alpha * through * features[i, f]
                        through *= 1.0 - alpha
                        found[number, 0] = log_alpha
                        found[number, 1] = peak
                        found[number, 2] = sharpness
                        number += 1
                        high = max(high, peak)
                images[row, column, 9] = 1.0 - through
                if through > limit or through >= _LEVEL:
                    continue
                if _transmittance(0.0, found, number) <= _LEVEL:
                    continue
                low = 0.0
                for _ in range(_BISECTIONS):
                    middle = 0.5 * (low + high)
                    if _transmittance(middle, found, number) > _LEVEL:
                        low = middle
                    else:
                        high = middle
                depth = 0.5 * (low + high)
                slope = 0.0
                for k in range(number):
                    ahead = max(found[k, 1] - depth, 0.0)
                    density = math.exp(found[k, 0] - 0.5 * found[k, 2] * ahead * ahead)
                    density = min(density, _ALPHA_MAX)
                    slope += density / (1.0 - density) * found[k, 2] * ahead
                images[row, column, 10] = depth
                images[row, column, 11] = slope


def exact_images(
    gaussians: OrientedGaussians,
    camera: Camera,
    options: RenderOptions,
    tiles: Tiles | None = None,
) -> ExactImages:
    """Render by the definition in float64, depth by bisection to the last bits.

    Parameters
    ----------
    gaussians : OrientedGaussians
        Of any float type; the values are taken as they are.
    camera : Camera
    options : RenderOptions
        ``threads`` and what describes the image are read.
    tiles : Tiles, optional
        From :func:`exact_tiles`, if it was called already.
    """
    wide = as_float64(gaussians)
    tiles = tiles or exact_tiles(wide, camera, options)
    with torch.no_grad():
        features = reference_projection(wide, camera, options).params[:, 13:22].contiguous().numpy()
        log_opacity = wide.log_opacities().numpy()
        axes = camera.rotation @ wide.rotations().numpy()  # (n, 3, 3) columns, camera frame
        scales = wide.scales().numpy()
    linear = axes.transpose(0, 2, 1) / scales[:, :, None]  # (n, 3, 3)
    offset = (linear @ camera.to_camera(wide.means.numpy())[:, :, None])[:, :, 0]  # (n, 3)
    whitened = np.ascontiguousarray(np.concatenate([linear, offset[:, :, None]], 2))
    images = np.zeros((camera.height, camera.width, 12))
    lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    limit = options.depth_valid_transmittance
    threads = options.threads or default_threads()

    def run(first: int, end: int) -> None:
        _render_tiles(
            first,
            end,
            whitened,
            log_opacity,
            features,
            tiles.start,
            tiles.ids,
            tiles.tiles_x,
            lens,
            camera.width,
            camera.height,
            limit,
            images,
        )

    run_chunks(run, even_bounds(len(tiles.start) - 1, threads, 16), threads)
    images[..., :3] += (1.0 - images[..., 9:10]) * np.asarray(options.background)
    parts = (images[..., :3], images[..., 3:6], images[..., 6:9], *np.moveaxis(images, 2, 0)[9:])
    return ExactImages(*map(np.ascontiguousarray, parts))
