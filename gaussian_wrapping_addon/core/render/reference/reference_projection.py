# SPDX-License-Identifier: GPL-3.0-or-later
"""Reference projection in plain torch: differentiable, any float type, ground truth for kernels."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ... import tolerances
from ...dataset.camera import Camera
from ...gaussians.model import OrientedGaussians
from ..projection.projection import used_degree
from ..types.options import RenderOptions


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
        faint = rows[:, 11] <= tolerances.ALPHA_MIN
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
    reach_x = torch.maximum(u.abs(), (camera.width - u).abs()) + tolerances.TILE_PX
    reach_y = torch.maximum(v.abs(), (camera.height - v).abs()) + tolerances.TILE_PX

    def quadratic(xx: Tensor, xy: Tensor, yy: Tensor) -> Tensor:
        return xx * reach_x**2 + xy.abs() * reach_x * reach_y + yy * reach_y**2

    linear = px.abs() * reach_x + py.abs() * reach_y
    most_den = 1.0 + 2.0 * linear + quadratic(r, s, t)
    largest = torch.finfo(torch.float32).max
    return (
        (torch.maximum(reach_x, reach_y) <= tolerances.FINITE_OFFSET_PX)
        & (quadratic(qa, qb, qc) <= tolerances.FINITE_NUM)
        & (most_den <= tolerances.FINITE_DEN)
        & (a0 * sigma_z**2 <= tolerances.FINITE_SPREAD)
        & (a0 * most_den * z <= tolerances.FINITE_PULL)
        & (z >= tolerances.FINITE_Z_MIN)
        & (z <= tolerances.FINITE_Z_MAX)
        & (sigma_z <= tolerances.FINITE_SIGMA_Z)
        & (rows[:, 13:16] <= tolerances.FINITE_COLOR).all(1)
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

    Written unlike the closed forms of the kernels on purpose, so that one checks the other.

    Parameters
    ----------
    directions : (n, 3) unit vectors
    degree : int, 0 to 3

    Returns
    -------
    (n, (degree + 1)^2)
        Order ``m = -l .. l`` within each band, Condon-Shortley phase.
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
