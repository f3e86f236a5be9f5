# SPDX-License-Identifier: GPL-3.0-or-later
"""Projection that keeps the Gaussians between pixel centres, using a finer screen.

Projection drops Gaussians that reach no pixel centre. Queries between the centres need them, so
Gaussians are projected onto a much finer screen and their rows scaled back to pixels.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from ... import tolerances
from ...dataset.camera import Camera
from ...kernels.compiled import kernel
from ...kernels.parallel import default_threads, even_bounds, run_chunks
from ..projection.projection import RawArrays, ScreenGaussians, project_gaussians
from ..tiling.area_lists import TILE
from ..types.options import RenderOptions

_FINE_SIDE_PX = 65536
"""Longer side of the screen that Gaussians are projected onto for queries. Projection drops those
between pixel centres; at this size none of them is relevant."""
BOX_END = 0.999e9
"""Projection clips boxes at 1e9 pixels."""


def fine_scale(camera: Camera) -> int:
    """Return how many times as fine the screen is that Gaussians are projected onto."""
    scale = 1
    while scale * max(camera.width, camera.height) < _FINE_SIDE_PX:
        scale *= 2
    return scale


def project_finely(gaussians: RawArrays, camera: Camera, options: RenderOptions) -> ScreenGaussians:
    """Project onto a screen finer by a power of two, and scale the rows back to pixels.

    Parameters
    ----------
    gaussians : RawArrays
        Scene frame.
    camera : Camera
        In the scene frame.
    options : RenderOptions
        As for :func:`~..projection.projection.project_gaussians`.

    Returns
    -------
    ScreenGaussians
        In pixels of ``camera``; Gaussians that rendering hides at that size are hidden.
    """
    threads = options.threads or default_threads()
    scale = fine_scale(camera)
    fine = camera.resized(camera.width * scale, camera.height * scale)
    screen = project_gaussians(gaussians, fine, options)

    def shrink(begin: int, end: int) -> None:
        _shrink_range(
            begin, end, float(scale), camera.width, camera.height,
            screen.params, screen.boxes, screen.skews, screen.visible,
        )  # fmt: skip

    run_chunks(shrink, even_bounds(len(screen), threads), threads)
    _add_distant(gaussians, camera, options, scale, screen)
    return screen


def _add_distant(
    gaussians: RawArrays,
    camera: Camera,
    options: RenderOptions,
    scale: int,
    screen: ScreenGaussians,
) -> None:
    """Add Gaussians that are hidden only because they exceed the pixel range of the finer screen.

    They project more than a hundred image sizes off the image.
    """
    hidden = np.flatnonzero(~screen.visible)
    pose = camera.cam_from_world
    with np.errstate(all="ignore"):
        local = gaussians.means[hidden].astype(np.float64) @ pose[:, :3].T + pose[:, 3]
        aside = np.abs(
            local[:, :2] / local[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        )
    limit = (
        tolerances.FINITE_OFFSET_PX / scale - max(camera.width, camera.height) - tolerances.TILE_PX
    )
    far = hidden[(local[:, 2] > 0.0) & (aside.max(1) > limit)]
    if len(far) == 0:
        return
    names = [field.name for field in dataclasses.fields(RawArrays)]
    some = RawArrays(**{name: getattr(gaussians, name)[far] for name in names})
    coarse = project_gaussians(some, camera, options)
    seen = far[coarse.visible]
    for field in dataclasses.fields(ScreenGaussians):
        getattr(screen, field.name)[seen] = getattr(coarse, field.name)[coarse.visible]


@kernel(fast=False)
def _shrink_range(
    begin: int,
    end: int,
    scale: float,
    width: int,
    height: int,
    params: np.ndarray,
    boxes: np.ndarray,
    skews: np.ndarray,
    visible: np.ndarray,
) -> None:
    """Scale the rows ``begin .. end`` of a screen ``scale`` times as fine to pixels.

    Rows that the image of ``width`` x ``height`` hides because rendering them would overflow
    float32 (docs/architecture.md) are hidden.
    """
    for i in range(begin, end):
        if not visible[i]:
            continue
        # Only these columns depend on the pixel size.
        u, v = params[i, 0] / scale, params[i, 1] / scale
        reach_x = max(abs(u), abs(width - u)) + TILE
        reach_y = max(abs(v), abs(height - v)) + TILE
        xx, xy, yy = reach_x * reach_x, reach_x * reach_y, reach_y * reach_y
        square = scale * scale
        qa, qb, qc = params[i, 2] * square, params[i, 3] * square, params[i, 4] * square
        px, py = params[i, 5] * scale, params[i, 6] * scale
        r, s, t = params[i, 7] * square, params[i, 8] * square, params[i, 9] * square
        den = 1.0 + 2.0 * (abs(px) * reach_x + abs(py) * reach_y) + r * xx + abs(s) * xy + t * yy
        holds = reach_x <= tolerances.FINITE_OFFSET_PX and reach_y <= tolerances.FINITE_OFFSET_PX
        holds &= qa * xx + abs(qb) * xy + qc * yy <= tolerances.FINITE_NUM
        holds &= den <= tolerances.FINITE_DEN
        holds &= params[i, 12] * den * params[i, 10] <= tolerances.FINITE_PULL
        visible[i] = holds
        if not holds:
            continue
        for column, value in enumerate((u, v, qa, qb, qc, px, py, r, s, t)):
            params[i, column] = value
        skews[i] /= scale
        for column in range(4):
            if abs(boxes[i, column]) > BOX_END:
                # Clipped, far outside the image: no longer the box of the ellipse.
                skews[i] = math.inf
            boxes[i, column] /= scale
