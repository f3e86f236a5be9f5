# SPDX-License-Identifier: GPL-3.0-or-later
"""The definition of the renderer in plain torch."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from .. import limits
from ..errors import UsageError
from ..gaussians.model import OrientedGaussians
from ..scene.camera import Camera
from .projection import used_degree
from .types import Render, RenderOptions

# -- Reference projection in plain torch: differentiable, any float type, ground truth for kernels


@dataclass(frozen=True)
class ReferenceScreen:
    """Columns of ``docs/architecture.md`` as one differentiable tensor."""

    params: Tensor  # (n, 24); column 23 is 0
    depths: Tensor  # (n,) distance from the camera to the mean
    usable: Tensor  # (n,) bool: beyond the near plane, opacity above 1/255, fits float32


def reference_projection(
    gaussians: OrientedGaussians, camera: Camera, options: RenderOptions
) -> ReferenceScreen:
    """Activate and project Gaussians with torch (docs/method.md, sections 1.5 and 2.3).

    Rows that are not usable hold zeros and carry no gradient.
    """
    means = gaussians.means
    # First without gradients: an overflow in an unusable row must not affect them.
    with torch.no_grad():
        axis, shift = camera.cam_from_world[2, :3], camera.cam_from_world[2, 3]
        index = torch.nonzero(means @ means.new_tensor(axis) + shift > options.near_z)[:, 0]  # (m,)
        rows, distance = _project(gaussians.select(index), camera, options)
        faint = rows[:, 11] <= limits.ALPHA_MIN
        index, distance = (
            part[_held_by_float32(rows, distance, camera) & ~faint] for part in (index, distance)
        )
    rows, _ = _project(gaussians.select(index), camera, options)
    usable = torch.zeros(len(gaussians), dtype=torch.bool, device=rows.device)
    usable[index] = True
    params = means.new_zeros((len(gaussians), 24)).index_put((index,), rows)
    distances = means.new_full((len(gaussians),), torch.inf)
    return ReferenceScreen(params, distances.index_put((index,), distance), usable)


def _project(
    chosen: OrientedGaussians, camera: Camera, options: RenderOptions
) -> tuple[Tensor, Tensor]:
    """(m, 24) rows of params and (m,) distances of Gaussians before the camera."""
    means = chosen.means
    rotation = means.new_tensor(camera.rotation)  # (3, 3)
    translation = means.new_tensor(camera.cam_from_world[:, 3])  # (3,)
    focal = means.new_tensor([camera.fx, camera.fy])  # (2,)
    offset = means.new_tensor([camera.cx, camera.cy])  # (2,)
    local = means @ rotation.T + translation  # (m, 3)
    z = local[:, 2]
    ray = local / z[:, None]  # (m, 3) = (u, v, 1)
    axes = rotation @ chosen.rotations()  # (m, 3, 3) columns, camera frame
    scales = chosen.scales()  # (m, 3)
    opacity = torch.exp(chosen.log_opacities())

    # Inverse side: L = S^-1 axes^T whitens; its first two columns per pixel of image shift.
    whiten = axes.transpose(1, 2) / scales[:, :, None]  # (m, 3, 3)
    along = (whiten @ ray[:, :, None])[:, :, 0]  # (m, 3) L w0
    per_px = whiten[:, :, :2] / focal  # (m, 3, 2)
    a0 = (along * along).sum(1)
    linear = (along[:, :, None] * per_px).sum(1) / a0[:, None]  # (m, 2)
    quad = per_px.transpose(1, 2) @ per_px / a0[:, None, None]  # (m, 2, 2)

    # Covariance side: J = d(pixel)/d(point) applied to the scaled axes.
    scaled = axes * scales[:, None, :]  # (m, 3, 3)
    slope = scaled[:, :2] - ray[:, :2, None] * scaled[:, 2:]  # (m, 2, 3)
    spread = slope * (focal / z[:, None])[:, :, None]  # (m, 2, 3)
    spread_x, spread_y = spread[:, 0], spread[:, 1]
    # |a x b|^2 is the determinant of the 2D covariance without cancellation.
    det = torch.linalg.cross(spread_x, spread_y).square().sum(1)
    conic_xx = (spread_y * spread_y).sum(1) / det
    conic_xy = -2.0 * (spread_x * spread_y).sum(1) / det
    conic_yy = (spread_x * spread_x).sum(1) / det

    slant = (whiten.transpose(1, 2) @ along[:, :, None])[:, :, 0]  # (m, 3) Sigma^-1 w0
    geometric = -(slant / slant.norm(dim=1, keepdim=True)) @ rotation  # (m, 3) scene frame
    columns = [
        ray[:, :2] * focal + offset,
        torch.stack([conic_xx, conic_xy, conic_yy], 1),
        linear,
        torch.stack([quad[:, 0, 0], 2.0 * quad[:, 0, 1], quad[:, 1, 1]], 1),
        torch.stack([z, opacity, a0], 1),
        _colors(chosen, camera, options),
        chosen.normals(),
        geometric,
        torch.stack([scaled[:, 2].norm(dim=1), torch.zeros_like(z)], 1),
    ]
    return torch.cat(columns, 1), local.norm(dim=1)


def _held_by_float32(rows: Tensor, distance: Tensor, camera: Camera) -> Tensor:
    """(m,) rows for which no product of rendering overflows float32 (``docs/architecture.md``)."""
    u, v, qa, qb, qc, px, py, r, s, t, z, _, a0 = rows[:, :13].unbind(1)
    sigma_z = rows[:, 22]
    reach_x = torch.maximum(u.abs(), (camera.width - u).abs()) + limits.TILE_PX
    reach_y = torch.maximum(v.abs(), (camera.height - v).abs()) + limits.TILE_PX

    def quadratic(xx: Tensor, xy: Tensor, yy: Tensor) -> Tensor:
        return xx * reach_x**2 + xy.abs() * reach_x * reach_y + yy * reach_y**2

    linear = px.abs() * reach_x + py.abs() * reach_y
    most_den = 1.0 + 2.0 * linear + quadratic(r, s, t)
    largest = torch.finfo(torch.float32).max
    return (
        (torch.maximum(reach_x, reach_y) <= limits.FINITE_OFFSET_PX)
        & (quadratic(qa, qb, qc) <= limits.FINITE_NUM)
        & (most_den <= limits.FINITE_DEN)
        & (a0 * sigma_z**2 <= limits.FINITE_SPREAD)
        & (a0 * most_den * z <= limits.FINITE_PULL)
        & (z >= limits.FINITE_Z_MIN)
        & (z <= limits.FINITE_Z_MAX)
        & (sigma_z <= limits.FINITE_SIGMA_Z)
        & (rows[:, 13:16] <= limits.FINITE_COLOR).all(1)
        & (rows.abs() < largest).all(1)
        & (distance < largest)
    )


def _colors(gaussians: OrientedGaussians, camera: Camera, options: RenderOptions) -> Tensor:
    """(n, 3) harmonics at the direction camera -> mean, + 0.5, clamped at 0.

    See docs/method.md, section 2.1.
    """
    degree = used_degree(gaussians.sh.shape[1], options)
    center = gaussians.means.new_tensor(camera.center)
    offset = gaussians.means - center
    direction = offset / offset.norm(dim=1, keepdim=True)
    basis = harmonics_basis(direction, degree)  # (n, k)
    coefficients = gaussians.sh[:, : basis.shape[1]]
    return ((basis[:, :, None] * coefficients).sum(1) + 0.5).clamp_min(0.0)


def harmonics_basis(directions: Tensor, degree: int) -> Tensor:
    """Evaluate real spherical harmonics by recurrence on associated Legendre functions.

    Written unlike the closed forms of the kernels on purpose, so that one checks the other. For (n,
    3) unit vectors and a degree of 0 to 3 it returns (n, (degree + 1)^2) values, of order
    ``m = -l .. l`` within each band, with the Condon-Shortley phase.
    """
    x, y, z = directions.unbind(1)
    cosines, sines = [torch.ones_like(x)], [torch.zeros_like(x)]  # Re, Im of (x + i y)^m
    for _ in range(degree):
        c, s = cosines[-1], sines[-1]
        cosines.append(x * c - y * s)
        sines.append(x * s + y * c)
    legendre: dict[tuple[int, int], Tensor] = {}  # P_l^m / (1 - z^2)^(m / 2), phase included
    double_factorial = 1.0
    for m in range(degree + 1):
        legendre[m, m] = torch.full_like(z, (-1.0) ** m * double_factorial)
        double_factorial *= 2 * m + 1
        for level in range(m + 1, degree + 1):
            above = legendre.get((level - 2, m), torch.zeros_like(z))
            legendre[level, m] = (
                (2 * level - 1) * z * legendre[level - 1, m] - (level + m - 1) * above
            ) / (level - m)
    columns = []
    for level in range(degree + 1):
        for m in range(-level, level + 1):
            k = abs(m)
            ratio = 1.0
            for factor in range(level - k + 1, level + k + 1):
                ratio /= factor
            norm = ((2 * level + 1) / (4.0 * torch.pi) * ratio) ** 0.5 * (2.0**0.5 if k else 1.0)
            angular = sines[k] if m < 0 else cosines[k]
            columns.append(norm * legendre[level, k] * angular)
    return torch.stack(columns, 1)


# -- Reference renderer in plain torch: every pixel against every Gaussian ------------------------
#
# Any float type, gradients by autograd. Only for small scenes: the cost is pixels x Gaussians.


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

    The images have the float type of the Gaussians. Raises UsageError if statistics are requested:
    only the fast renderer collects them.
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
        color=image[..., 0:3], normal=image[..., 3:6], geometric_normal=image[..., 6:9],
        alpha=image[..., 9], depth=image[..., 10],
    )  # fmt: skip


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
    alpha = torch.exp(log_alpha).clamp_max(limits.ALPHA_MAX)
    alpha = torch.where(alpha >= limits.ALPHA_MIN, alpha, 0.0)
    before = _transmittance_before(alpha)
    contributes = (alpha > 0.0) & (before >= limits.TRANSMITTANCE_MIN)
    alpha = torch.where(contributes, alpha, 0.0)
    before = _transmittance_before(alpha)
    return _RayEvaluation(
        log_alpha, alpha * before, contributes, torch.prod(1.0 - alpha, dim=1),
        z * (1.0 + shift) / denominator, a0 * denominator,
    )  # fmt: skip


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
    deep = torch.nonzero((rays.final <= limit) & (rays.final < limits.ISO_LEVEL))[:, 0]
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
            math.log(limits.ALPHA_MAX)
        )
        return torch.where(part, capped, -torch.inf)

    def log_transmittance(at: Tensor) -> Tensor:
        return torch.log1p(-torch.exp(log_g(at))).sum(1)

    level = math.log(limits.ISO_LEVEL)
    with torch.no_grad():
        # The Gaussian at which the blending, in its order, crosses the level.
        alpha = torch.where(part, torch.exp(log_alpha).clamp_max(limits.ALPHA_MAX), 0.0)
        behind = torch.cumprod(1.0 - alpha, dim=1)  # (q, c)
        first = (behind <= limits.ISO_LEVEL).to(torch.uint8).argmax(1, keepdim=True)
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
        slope = torch.maximum(slope, limits.SLOPE_FLOOR * at_crossing.sqrt())
    # One Newton step whose value is polish and whose gradient is the implicit one.
    crossing = start + (log_transmittance(start) - level) / slope
    return depth.index_put((deep[valid],), crossing[valid])
