# SPDX-License-Identifier: GPL-3.0-or-later
"""Reference renderer in plain torch: every pixel against every Gaussian.

Any float type, gradients by autograd. Only for small scenes: the cost is pixels x Gaussians.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ... import tolerances
from ...dataset.camera import Camera
from ...errors import UsageError
from ...gaussians.model import OrientedGaussians
from ..types.images import Render
from ..types.options import RenderOptions
from .reference_projection import reference_projection

_ELEMENTS_PER_CHUNK = 1_000_000


@dataclass(frozen=True)
class _RayEvaluation:
    """n Gaussians, in blending order, evaluated on the rays of p pixels; rows are pixels."""

    log_alpha: Tensor  # (p, n) log of the opacity on the ray, before the cap
    weight: Tensor  # (p, n) alpha T, 0 where the Gaussian does not contribute
    contributes: Tensor  # (p, n) bool
    final: Tensor  # (p,) transmittance behind everything
    peak: Tensor  # (p, n) z-depth of the maximum along the ray
    sharpness: Tensor  # (p, n) squared inverse standard deviation along the ray, per z-depth


def render_reference(
    gaussians: OrientedGaussians, camera: Camera, options: RenderOptions
) -> Render:
    """Render by the definition (docs/method.md, sections 2.1 to 2.5).

    On each pixel's ray the visible Gaussians are taken by increasing distance of their means
    (rounded to float32, ties by index). One contributes iff ``alpha >= 1/255`` and the
    transmittance before it is at least 1e-4, with ``alpha = min(0.99, opacity exp(-q_min / 2))``.
    The depth is the z-depth t > 0 where the product over the pixel's contributors of ``1 - G_i(t)``
    crosses 0.5, ``G_i(t) = min(0.99, opacity exp(-(q_min + rs^2 max(t* - t, 0)^2) / 2))``. It is 0
    where the final transmittance exceeds ``options.depth_valid_transmittance`` or where less than
    half of the light reaches t = 0. Its gradient is that of the implicit function.

    Parameters
    ----------
    gaussians : OrientedGaussians
        Scene frame; the images have their float type.
    camera : Camera
        In the scene frame.
    options : RenderOptions
        ``threads`` is ignored.

    Raises
    ------
    UsageError
        If statistics are requested; only the fast renderer collects them.
    """
    if options.statistics:
        raise UsageError("The reference renderer collects no statistics.", "Use render() for them.")
    screen = reference_projection(gaussians, camera, options)
    chosen = torch.nonzero(screen.usable)[:, 0]
    order = chosen[torch.argsort(screen.depths[chosen].float(), stable=True)]
    params = screen.params[order]  # (n, 24)
    background = params.new_tensor(options.background)
    rows_per_chunk = max(1, _ELEMENTS_PER_CHUNK // (camera.width * max(1, len(order))))
    chunks = [
        _render_rows(params, background, camera, options, row, row + rows_per_chunk)
        for row in range(0, camera.height, rows_per_chunk)
    ]
    image = torch.cat(chunks).reshape(camera.height, camera.width, 11)
    return Render(
        color=image[..., 0:3],
        normal=image[..., 3:6],
        geometric_normal=image[..., 6:9],
        alpha=image[..., 9],
        depth=image[..., 10],
    )


def reference_depth_at(
    gaussians: OrientedGaussians, camera: Camera, positions: Tensor, options: RenderOptions
) -> Tensor:
    """Return the depth of :func:`render_reference` at any positions of the image.

    The definition of :func:`~..query.depth_query.solve_depths`; only tests compare with it.

    Parameters
    ----------
    gaussians, camera, options
        As for :func:`render_reference`.
    positions : (m, 2) tensor
        Pixels, the Gaussians' float type; differentiable.

    Returns
    -------
    (m,) tensor
        z-depth in scene units; 0 where there is none and off ``[0, width] x [0, height]``.
    """
    rays, seen = _evaluate_rays_at(gaussians, camera, positions, options)
    return positions.new_zeros(len(positions)).index_put((seen,), _depth(rays, options))


def _evaluate_rays_at(
    gaussians: OrientedGaussians, camera: Camera, positions: Tensor, options: RenderOptions
) -> tuple[_RayEvaluation, Tensor]:
    """Evaluate the rays of the positions on the image; return also these positions' indices."""
    screen = reference_projection(gaussians, camera, options)
    chosen = torch.nonzero(screen.usable)[:, 0]
    order = chosen[torch.argsort(screen.depths[chosen].float(), stable=True)]
    size = positions.new_tensor([camera.width, camera.height])
    seen = torch.nonzero(((positions >= 0.0) & (positions <= size)).all(1))[:, 0]
    x, y = positions[seen].unbind(1)
    return _evaluate_rays(screen.params[order], x, y), seen


def _render_rows(
    params: Tensor,
    background: Tensor,
    camera: Camera,
    options: RenderOptions,
    first_row: int,
    end_row: int,
) -> Tensor:
    """Return (p, 11): colour, learned normal, geometric normal, alpha, depth."""
    rows = torch.arange(first_row, min(end_row, camera.height)).to(params) + 0.5
    columns = torch.arange(camera.width).to(params) + 0.5
    y, x = (grid.reshape(-1) for grid in torch.meshgrid(rows, columns, indexing="ij"))  # (p,)
    rays = _evaluate_rays(params, x, y)
    features = params[:, 13:22]  # (n, 9)
    blended = rays.weight @ features  # (p, 9)
    color = blended[:, :3] + rays.final[:, None] * background
    depth = _depth(rays, options) if options.depth else torch.zeros_like(rays.final)
    return torch.cat([color, blended[:, 3:], 1.0 - rays.final[:, None], depth[:, None]], dim=1)


def _evaluate_rays(params: Tensor, x: Tensor, y: Tensor) -> _RayEvaluation:
    """Evaluate all Gaussians on the rays of the pixel positions (x, y), in blending order."""
    u, v, qa, qb, qc, px, py, r, s, t, z, opacity, a0 = params[:, :13].unbind(1)
    dx, dy = x[:, None] - u, y[:, None] - v  # (p, n)
    shift = px * dx + py * dy
    denominator = 1.0 + 2.0 * shift + r * dx * dx + s * dx * dy + t * dy * dy
    distance_sq = (qa * dx * dx + qb * dx * dy + qc * dy * dy) / denominator
    log_alpha = torch.log(opacity) - 0.5 * distance_sq
    alpha = torch.exp(log_alpha).clamp_max(tolerances.ALPHA_MAX)
    alpha = torch.where(alpha >= tolerances.ALPHA_MIN, alpha, 0.0)
    before = _transmittance_before(alpha)
    contributes = (alpha > 0.0) & (before >= tolerances.TRANSMITTANCE_MIN)
    alpha = torch.where(contributes, alpha, 0.0)
    before = _transmittance_before(alpha)
    return _RayEvaluation(
        log_alpha,
        alpha * before,
        contributes,
        torch.prod(1.0 - alpha, dim=1),
        z * (1.0 + shift) / denominator,
        a0 * denominator,
    )


def _transmittance_before(alpha: Tensor) -> Tensor:
    """(p, n) product of ``1 - alpha`` over the Gaussians in front of each."""
    transmittance = torch.cumprod(1.0 - alpha, dim=1)
    return torch.cat([torch.ones_like(alpha[:, :1]), transmittance[:, :-1]], dim=1)


def _depth(rays: _RayEvaluation, options: RenderOptions) -> Tensor:
    """(p,) z-depth of the 0.5-isosurface; 0 where there is none.

    See docs/method.md, sections 2.4 and 2.5.
    """
    depth = torch.zeros_like(rays.final)
    limit = options.depth_valid_transmittance
    deep = torch.nonzero((rays.final <= limit) & (rays.final < tolerances.ISO_LEVEL))[:, 0]
    if len(deep) == 0:
        return depth
    # Only each pixel's contributors matter: move them to the front and drop the rest.
    contributes = rays.contributes[deep]  # (q, n)
    count = int(contributes.sum(1).max())
    pick = torch.argsort((~contributes).to(torch.uint8), dim=1, stable=True)[:, :count]
    part = contributes.gather(1, pick)  # (q, c)
    log_alpha = rays.log_alpha[deep].gather(1, pick)
    peak = rays.peak[deep].gather(1, pick)
    sharpness = rays.sharpness[deep].gather(1, pick)

    def log_g(at: Tensor) -> Tensor:
        before = (peak - at[:, None]).clamp_min(0.0)  # (q, c)
        capped = (log_alpha - 0.5 * sharpness * before * before).clamp_max(
            math.log(tolerances.ALPHA_MAX)
        )
        return torch.where(part, capped, -torch.inf)

    def log_transmittance(at: Tensor) -> Tensor:
        return torch.log1p(-torch.exp(log_g(at))).sum(1)

    level = math.log(tolerances.ISO_LEVEL)
    with torch.no_grad():
        # The Gaussian at which the blending, in its order, crosses the level.
        alpha = torch.where(part, torch.exp(log_alpha).clamp_max(tolerances.ALPHA_MAX), 0.0)
        behind = torch.cumprod(1.0 - alpha, dim=1)  # (q, c)
        first = (behind <= tolerances.ISO_LEVEL).to(torch.uint8).argmax(1, keepdim=True)
        at_crossing = sharpness.gather(1, first)[:, 0]  # (q,)

        low = torch.zeros_like(peak[:, 0])
        high = torch.where(part, peak, 0.0).amax(1)
        valid = log_transmittance(low) > level
        for _ in range(8 - round(math.log2(torch.finfo(high.dtype).eps))):
            middle = 0.5 * (low + high)
            clear = log_transmittance(middle) > level
            low, high = torch.where(clear, middle, low), torch.where(clear, high, middle)
        start = 0.5 * (low + high)
        g = torch.exp(log_g(start))
        before = (peak - start[:, None]).clamp_min(0.0)
        slope = (g / (1.0 - g) * sharpness * before).sum(1)
        slope = torch.maximum(slope, tolerances.SLOPE_FLOOR * at_crossing.sqrt())
    # One Newton step whose value is polish and whose gradient is the implicit one.
    crossing = start + (log_transmittance(start) - level) / slope
    return depth.index_put((deep[valid],), crossing[valid])
