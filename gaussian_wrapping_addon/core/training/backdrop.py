# SPDX-License-Identifier: GPL-3.0-or-later
"""Colours far behind everything, where no photo shows what is there.

A view from a new place looks past the border of what the photos show, and sees black there. A
coarse sphere in the colours that the photos have in these directions looks right more often. It
comes after the training, which needs the black: only before black must a surface become opaque to
look right. See docs/method.md, section 11.11.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial import cKDTree

from ..dataset.loading.splat_cameras import fibonacci_directions
from ..dataset.photo_source import PhotoSource
from ..gaussians.initialisation import gaussians_at
from ..gaussians.model import OrientedGaussians
from ..render.projection.projection import RawArrays
from ..render.types.options import RenderOptions
from ..render.types.renderer import Renderer
from ..render.view_renderer import ViewRenderer
from .initialisation.far_shell import LEAST_REACH, onto_sphere
from .live_view import divisor_for

_logger = logging.getLogger(__name__)

DIRECTIONS = 2000
"""Cells of the sphere, 4.5 degrees apart."""

LONGEST_PX = 144
"""Long side of the training views that are rendered."""

CLEAR_TRANSMITTANCE = 0.03
"""A cell is left open where any photo sees through more than this, on average: training has found
its colour with black behind, and would be too bright with another."""

REACH_FACTOR = 2.0
"""Radius of the sphere over the distance of the farthest Gaussian."""

NEAREST = 6
"""Filled cells met by rays of photos, that lend their colours to a cell."""

SIZE_SHARE = 0.7
FLATNESS = 0.15
OPACITY = 0.95
"""Standard deviations along the sphere, over the distance of cells, and across it; opacity."""


def with_backdrop(
    gaussians: OrientedGaussians,
    photos: PhotoSource,
    views: Sequence[int],
    renderer: Renderer | None = None,
    *,
    threads: int = 0,
    check: Callable[[], None] | None = None,
) -> OrientedGaussians:
    """Return trained Gaussians with a sphere behind them, open where the photos see through.

    Parameters
    ----------
    gaussians : OrientedGaussians
        Trained, scene frame.
    photos : PhotoSource
    views : sequence of int
        Training views.
    renderer : Renderer, optional
        Overwrites its last view; by default one on the processor.
    threads : int
    check : callable, optional
        Called before each view; an exception ends the work.
    """
    farthest = float(gaussians.means.norm(dim=1).max()) if len(gaussians) else 0.0
    radius = max(LEAST_REACH, REACH_FACTOR * farthest)
    directions = fibonacci_directions(DIRECTIONS)
    tree = cKDTree(directions)
    through, seen = np.zeros(DIRECTIONS), np.zeros(DIRECTIONS)
    colors = np.zeros((DIRECTIONS, 3))
    raw, renderer = RawArrays.from_gaussians(gaussians.detached()), renderer or ViewRenderer()
    options = RenderOptions(depth=False, threads=threads)
    for view in views:
        if check is not None:
            check()
        camera = photos.camera(view, divisor_for(photos, view, LONGEST_PX))
        image = renderer.render(raw, camera, options)
        rays = (camera.rays() @ camera.rotation).reshape(-1, 3)  # (p, 3) scene frame
        cell = tree.query(onto_sphere(camera.center, rays, radius))[1]
        pixels = np.bincount(cell, minlength=DIRECTIONS)
        passed = np.bincount(cell, 1.0 - image.alpha.reshape(-1), minlength=DIRECTIONS)
        np.maximum(through, passed / np.maximum(pixels, 1), out=through)
        seen += pixels
        for channel in range(3):
            values = image.color[..., channel].reshape(-1)
            colors[:, channel] += np.bincount(cell, values, minlength=DIRECTIONS)
    filled = through <= CLEAR_TRANSMITTANCE
    met = np.flatnonzero(filled & (seen > 0))  # open cells would lend black
    if len(met) == 0:
        return gaussians
    count, step = int(filled.sum()), np.sqrt(4.0 * np.pi / DIRECTIONS)
    known = colors[met] / seen[met, None]
    away, nearest = cKDTree(directions[met]).query(directions[filled], k=min(NEAREST, len(met)))
    away, nearest = away.reshape(count, -1), nearest.reshape(count, -1)
    weight = 1.0 / (away**2 + (0.5 * step) ** 2)  # (count, k)
    color = (known[nearest] * weight[..., None]).sum(1) / weight.sum(1, keepdims=True)
    _logger.info("backdrop: %d Gaussians where no photo sees through", count)
    sphere = gaussians_at(
        radius * directions[filled], np.clip(color, 0.0, 1.0),
        np.full(count, SIZE_SHARE * radius * step), gaussians.sh_degree,
        normals=-directions[filled], flatness=FLATNESS, opacities=OPACITY,
    )  # fmt: skip
    return gaussians.joined(sphere)
