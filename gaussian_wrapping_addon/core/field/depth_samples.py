# SPDX-License-Identifier: GPL-3.0-or-later
"""Surface samples from the cameras' depth maps, and point pairs across the surface from them.

Pivots of the Gaussians alone (docs/method.md, section 6.1) miss parts about as thin as a pixel:
their Gaussians are small, half transparent and many, so that no centre or outer pivot need lie
inside the solid that they form together. The isosurface of each camera finds it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from .. import tolerances
from ..dataset.camera import Camera
from ..gaussians.model import OrientedGaussians
from ..progress import Progress
from ..render.projection.projection import RawArrays
from ..render.types.options import RenderOptions
from ..render.types.renderer import Renderer
from ..render.view_renderer import ViewRenderer

MAX_DEPTH_SAMPLES = 120_000
"""Largest number of samples, about evenly over the surface (bounds the triangulation)."""

MAX_SIDE_PX = 960
"""Largest long side of the rendered depth maps."""

DEPTHS_PX = (0.5, 1.0, 2.0)
"""Steps behind the surface, in pixels at its depth, that are tested for being inside."""

STEP_OUT_PX = 0.5
"""Step towards the camera: transmittance exceeds 0.5 there, so the point is empty."""

_POOL = 8 * MAX_DEPTH_SAMPLES
"""Number of pending samples from which they are thinned."""


@dataclass(frozen=True)
class DepthSamples:
    """Points on the cameras' isosurfaces."""

    points: np.ndarray  # (n, 3) float64 scene frame
    directions: np.ndarray  # (n, 3) float64 unit, away from the camera
    footprints: np.ndarray  # (n,) float64 size of a pixel at the point, scene units

    def __len__(self) -> int:
        return len(self.points)

    def kept(self, index: np.ndarray) -> DepthSamples:
        """Return the samples of an index or mask."""
        return DepthSamples(self.points[index], self.directions[index], self.footprints[index])


Contains = Callable[[np.ndarray], np.ndarray]
"""Maps (n, 3) points to (n,) bool."""


def sample_depth_maps(
    gaussians: OrientedGaussians,
    cameras: Sequence[Camera],
    contains: Contains,
    progress: Progress,
    *,
    most: int = MAX_DEPTH_SAMPLES,
    near_z: float = tolerances.NEAR_Z,
    threads: int = 0,
    renderer: Renderer | None = None,
) -> DepthSamples:
    """Sample the cameras' depth maps inside a volume, thinned evenly.

    Parameters
    ----------
    gaussians : OrientedGaussians
        Scene frame.
    cameras : sequence of Camera
        Cameras in the same frame.
    contains : callable
        Tells which points lie in the volume.
    most : int
        Largest number of samples. One is kept per cell and octant of viewing directions, with cells
        as small as this number allows, but not smaller than a pixel.
    renderer : Renderer, optional
        By default that of the processor, which ``threads`` is for.
    """
    renderer, raw = renderer or ViewRenderer(), RawArrays.from_gaussians(gaussians)
    options = RenderOptions(depth=True, sh_degree=0, near_z=near_z, threads=threads)
    found, waiting = [], 0
    for index, camera in enumerate(cameras):
        progress.update(index / len(cameras), "sampling depth maps")
        shrink = max(1.0, max(camera.width, camera.height) / MAX_SIDE_PX)
        camera = camera.resized(round(camera.width / shrink), round(camera.height / shrink))
        depth = renderer.render(raw, camera, options).depth  # (h, w)
        rays = camera.rays()[depth > 0]  # (k, 3) camera frame, z = 1
        z = depth[depth > 0].astype(np.float64)
        points = (rays * z[:, None]) @ camera.rotation + camera.center
        inside = contains(points)
        toward = rays[inside] @ camera.rotation
        toward /= np.linalg.norm(toward, axis=1)[:, None]
        found.append(DepthSamples(points[inside], toward, z[inside] / max(camera.fx, camera.fy)))
        waiting += len(found[-1])
        if waiting > _POOL:
            found = [thin_evenly(_concatenated(found), most)]
            waiting = len(found[0])
    return thin_evenly(_concatenated(found), most)


def _concatenated(parts: list[DepthSamples]) -> DepthSamples:
    if not parts:
        return DepthSamples(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    return DepthSamples(
        np.concatenate([part.points for part in parts]),
        np.concatenate([part.directions for part in parts]),
        np.concatenate([part.footprints for part in parts]),
    )


def thin_evenly(depth_samples: DepthSamples, most: int) -> DepthSamples:
    """Keep the sharpest sample of each cell and octant of directions; at most ``most`` samples."""
    if len(depth_samples) == 0:
        return depth_samples
    low, high = depth_samples.points.min(0), depth_samples.points.max(0)
    side = float(np.median(depth_samples.footprints))
    side = max(side, float((high - low).max()) / 2**20)  # cell indices fit into 20 bits
    octant = (depth_samples.directions > 0) @ np.array([1, 2, 4])  # (n,)
    order = np.argsort(depth_samples.footprints, kind="stable")
    while True:
        cell = np.floor((depth_samples.points - low) / side).astype(np.int64)  # (n, 3)
        key = ((cell[:, 0] << 20 | cell[:, 1]) << 20 | cell[:, 2]) << 3 | octant
        _, first = np.unique(key[order], return_index=True)
        if len(first) <= most:
            return depth_samples.kept(np.sort(order[first]))
        # On a surface the number falls with the square of the side.
        side *= max(1.1, float(np.sqrt(len(first) / most)))


def bracket_pairs(
    depth_samples: DepthSamples, is_empty: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs of points (k, 3) outside and inside the solid, across its surface.

    Samples without an occupied point behind them are dropped: what is opaque for one camera may be
    transparent for another.

    Parameters
    ----------
    is_empty : callable
        Maps (n, 3) points to (n,) bool, over all cameras.
    """
    step = depth_samples.directions * depth_samples.footprints[:, None]  # (n, 3) one pixel
    inner = depth_samples.points.copy()
    waiting = np.arange(len(depth_samples))
    for depth in DEPTHS_PX:
        trial = depth_samples.points[waiting] + depth * step[waiting]
        solid = ~is_empty(trial)
        inner[waiting[solid]] = trial[solid]
        waiting = waiting[~solid]
    paired = np.ones(len(depth_samples), np.bool_)
    paired[waiting] = False
    outer = depth_samples.points - STEP_OUT_PX * step
    return outer[paired], inner[paired]
