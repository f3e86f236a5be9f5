# SPDX-License-Identifier: GPL-3.0-or-later
"""Masks made from a training: silhouettes of a region, start points of the background."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence

import numpy as np
import torch

from ..gaussians.model import OrientedGaussians
from ..limits import NEAR_Z
from ..render.projection import RawArrays
from ..render.types import Renderer, RenderOptions
from ..scene.camera import Camera
from ..scene.scene import PhotoSource, Scene
from ..training.start import LEAST_REACH, onto_sphere

# -- Start points far away wherever a photo has no sparse points: plain walls, sky ----------------
#
# Without them, training explains a plain background by fog around the object, inside the region.

CELL_PX = 8
"""Side of the cells that are looked at, pixels of the photos."""
MOST_POINTS = 8000
LEAST_POINTS = 5000
"""Start points, at least: with fewer, training invents some between the others, near the object."""


def with_background(scene: Scene, photos: PhotoSource, *, seed: int) -> Scene:
    """Return the scene with points on a sphere around everything.

    They are in the direction of pixels drawn by chance, where neither the cell nor its neighbours
    show a sparse point; where that gives too few, of all pixels.

    ``photos``: small photos of the scene's views.
    """
    random = np.random.default_rng([seed, 7])
    tried = -(-(MOST_POINTS + LEAST_POINTS) // len(scene.views))  # a photo
    found, colors, is_open = [], [], []
    for index in range(len(scene.views)):
        camera, photo, mask = photos.camera(index), photos.photo(index), photos.mask(index)
        row, column = random.integers(0, [[camera.height], [camera.width]], (2, tried))
        if mask is not None:
            row, column = row[mask[row, column]], column[mask[row, column]]
        rays = camera.rays_at(np.stack([column, row], 1) + 0.5) @ camera.rotation
        found.append(onto_sphere(camera.center, rays, LEAST_REACH) * LEAST_REACH)
        colors.append(photo[row, column])
        is_open.append(~_near_points(camera, scene.points)[row // CELL_PX, column // CELL_PX])
    points, color, opened = (np.concatenate(parts) for parts in (found, colors, is_open))
    order = random.permutation(len(opened))
    order = order[np.argsort(~opened[order], kind="stable")]  # open ones first
    wanted = max(min(MOST_POINTS, int(opened.sum())), LEAST_POINTS - len(scene.points))
    chosen = np.sort(order[:wanted])
    return dataclasses.replace(
        scene,
        points=np.concatenate([scene.points, points[chosen]]),
        point_colors=np.concatenate([scene.point_colors, color[chosen]]),
    )


def _near_points(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Return (rows, columns) bool: the cells of a photo with a point, and those around them."""
    _, row, column, _ = camera.shown(points)
    shown = np.zeros((-(-camera.height // CELL_PX) + 2, -(-camera.width // CELL_PX) + 2), bool)
    shown[row // CELL_PX + 1, column // CELL_PX + 1] = True
    wide = shown[:-2] | shown[1:-1] | shown[2:]
    return np.asarray(wide[:, :-2] | wide[:, 1:-1] | wide[:, 2:])


# -- Silhouettes of the Gaussians that stand in a region, as photos show them ---------------------

WHITE = 0.5 / (0.5 / math.sqrt(math.pi))
"""Coefficient of the constant harmonic of a Gaussian whose colour is 1; minus that, of colour 0."""
CLEAR_SHARE = 0.5
"""Share of the way from a camera to the regions in which nothing stands."""


def marked(gaussians: OrientedGaussians, inside: np.ndarray) -> RawArrays:
    """Return Gaussians that are white where ``inside`` (n,) bool, and black elsewhere."""
    sign = torch.from_numpy(np.where(inside, WHITE, -WHITE).astype(np.float32))  # (n,)
    sh = sign[:, None, None].expand(-1, 1, 3).contiguous()
    return RawArrays.from_gaussians(gaussians.detached().replaced(sh=sh.to(gaussians.sh.dtype)))


def silhouettes(
    gaussians: OrientedGaussians,
    inside: np.ndarray,
    cameras: Sequence[Camera],
    renderer: Renderer,
    *,
    bounds: np.ndarray | None = None,
    threads: int,
) -> Iterator[np.ndarray]:
    """Yield how much of each pixel shows what is inside, (h, w) float32 in [0, 1] a camera.

    The share is the sum of the blending weights of the Gaussians inside: what stands in front of
    them takes its part of the light, and so does what they let through.

    Parameters
    ----------
    gaussians : OrientedGaussians
        Scene frame.
    inside : (n,) bool
        Gaussians that belong to the object.
    cameras : sequence of Camera
        Scene frame; silhouettes have their size.
    bounds : (n, 3), optional
        Corners of the regions, scene frame. What is nearer to a camera than half of the way to
        them hides nothing: a short training leaves fog right before single cameras.
    """
    arrays = marked(gaussians, inside)
    for camera in cameras:
        options = RenderOptions(
            depth=False, sh_degree=0, threads=threads, near_z=_near_z(camera, bounds)
        )
        yield np.clip(renderer.render(arrays, camera, options).color[..., 0], 0.0, 1.0)


def _near_z(camera: Camera, bounds: np.ndarray | None) -> float:
    """Return the z-depth from which on Gaussians are rendered."""
    if bounds is None:
        return NEAR_Z
    return max(NEAR_Z, CLEAR_SHARE * float(camera.to_camera(bounds)[:, 2].min()))
