# SPDX-License-Identifier: GPL-3.0-or-later
"""Where the cameras see the isosurface: points of their depth maps, with what lies behind them.

Pivots of the Gaussians alone (docs/method.md, section 6.1) miss parts that are about as thin as a
pixel: their Gaussians are small, half transparent and many, so that neither a centre nor an outer
pivot need lie inside the solid that they make up together. Each camera's own isosurface finds it.
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
from ..render.view_renderer import ViewRenderer

MAX_SIGHTINGS = 120_000
"""Points kept, about evenly over the surface (memory and time of the triangulation)."""

MAX_SIDE_PX = 960
"""Depth maps are rendered no larger than this on the long side."""

DEPTHS_PX = (0.5, 1.0, 2.0)
"""Steps behind the surface, in pixels at its depth, at which the inside is looked for."""

STEP_OUT_PX = 0.5
"""Step towards the camera: there that camera sees more than half, so it is empty."""

_POOL = 8 * MAX_SIGHTINGS
"""Points that wait for thinning at a time."""


@dataclass(frozen=True)
class Sightings:
    """Points on the cameras' isosurfaces."""

    points: np.ndarray  # (n, 3) float64 scene frame
    directions: np.ndarray  # (n, 3) float64 unit, away from the camera
    footprints: np.ndarray  # (n,) float64 size of a pixel at the point, scene units

    def __len__(self) -> int:
        return len(self.points)

    def kept(self, index: np.ndarray) -> Sightings:
        """Return those of an index or mask."""
        return Sightings(self.points[index], self.directions[index], self.footprints[index])


Contains = Callable[[np.ndarray], np.ndarray]
"""Maps (n, 3) points to (n,) bool."""


def find_sightings(
    gaussians: OrientedGaussians,
    cameras: Sequence[Camera],
    contains: Contains,
    progress: Progress,
    *,
    most: int = MAX_SIGHTINGS,
    near_z: float = tolerances.NEAR_Z,
    threads: int = 0,
) -> Sightings:
    """Collect the points of the cameras' depth maps that lie in a volume, thinned evenly.

    Parameters
    ----------
    gaussians : OrientedGaussians
        Scene frame.
    cameras : sequence of Camera
        In the same frame.
    contains : callable
        Tells which points lie in the volume.
    most : int
        Of the points of a neighbourhood one stays for each octant of viewing directions, with
        neighbourhoods as small as this number allows, but not smaller than a pixel.
    """
    renderer, raw = ViewRenderer(), RawArrays.from_gaussians(gaussians)
    options = RenderOptions(depth=True, sh_degree=0, near_z=near_z, threads=threads)
    found, waiting = [], 0
    for index, camera in enumerate(cameras):
        progress.update(index / len(cameras), "looking for the surface from the cameras")
        shrink = max(1.0, max(camera.width, camera.height) / MAX_SIDE_PX)
        camera = camera.resized(round(camera.width / shrink), round(camera.height / shrink))
        depth = renderer.render(raw, camera, options).depth  # (h, w)
        rays = camera.rays()[depth > 0]  # (k, 3) camera frame, z = 1
        z = depth[depth > 0].astype(np.float64)
        points = (rays * z[:, None]) @ camera.rotation + camera.center
        inside = contains(points)
        toward = rays[inside] @ camera.rotation
        toward /= np.linalg.norm(toward, axis=1)[:, None]
        found.append(Sightings(points[inside], toward, z[inside] / max(camera.fx, camera.fy)))
        waiting += len(found[-1])
        if waiting > _POOL:
            found = [thinned(_joined(found), most)]
            waiting = len(found[0])
    return thinned(_joined(found), most)


def _joined(parts: list[Sightings]) -> Sightings:
    if not parts:
        return Sightings(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    return Sightings(
        np.concatenate([part.points for part in parts]),
        np.concatenate([part.directions for part in parts]),
        np.concatenate([part.footprints for part in parts]),
    )


def thinned(sightings: Sightings, most: int) -> Sightings:
    """Keep one sighting, the sharpest, of each cell and octant of directions; at most ``most``."""
    if len(sightings) == 0:
        return sightings
    low, high = sightings.points.min(0), sightings.points.max(0)
    side = float(np.median(sightings.footprints))
    side = max(side, float((high - low).max()) / 2**20)  # cell numbers fit
    octant = (sightings.directions > 0) @ np.array([1, 2, 4])  # (n,)
    order = np.argsort(sightings.footprints, kind="stable")
    while True:
        cell = np.floor((sightings.points - low) / side).astype(np.int64)  # (n, 3)
        key = ((cell[:, 0] << 20 | cell[:, 1]) << 20 | cell[:, 2]) << 3 | octant
        _, first = np.unique(key[order], return_index=True)
        if len(first) <= most:
            return sightings.kept(np.sort(order[first]))
        # A surface: the number falls with the square of the side.
        side *= max(1.1, float(np.sqrt(len(first) / most)))


def bracket_pairs(
    sightings: Sightings, is_empty: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return points (k, 3) outside and inside of the solid, in pairs across its surface.

    Sightings behind which no camera agrees that there is anything are left out: what one camera
    takes for opaque, another may see through.

    Parameters
    ----------
    is_empty : callable
        Maps (n, 3) points to (n,) bool, over all cameras.
    """
    step = sightings.directions * sightings.footprints[:, None]  # (n, 3) one pixel
    inner = sightings.points.copy()
    waiting = np.arange(len(sightings))
    for depth in DEPTHS_PX:
        trial = sightings.points[waiting] + depth * step[waiting]
        solid = ~is_empty(trial)
        inner[waiting[solid]] = trial[solid]
        waiting = waiting[~solid]
    paired = np.ones(len(sightings), np.bool_)
    paired[waiting] = False
    outer = sightings.points - STEP_OUT_PX * step
    return outer[paired], inner[paired]
