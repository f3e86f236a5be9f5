# SPDX-License-Identifier: GPL-3.0-or-later
"""The 3D smoothing filter: no Gaussian is smaller than the closest camera can resolve."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from .. import tolerances
from ..dataset.camera import Camera
from ..kernels.compiled import kernel
from ..kernels.parallel import default_threads, even_bounds, run_chunks
from ..settings import TrainingSettings

FILTER_VARIANCE_PX = TrainingSettings.filter_variance
"""Default variance of the filter in squared pixels of the closest camera, 0.05. The usual 0.2
(docs/method.md, section 1.5) was found to reduce the opacity of thin parts: a Gaussian as narrow as
0.4 pixels in two directions keeps 44 % of it, and spokes of three pixels stay half transparent;
with this value it keeps 76 %."""

IMAGE_MARGIN = 0.15
"""Share by which the image is enlarged on each side in the visibility test of Gaussians."""


@kernel(fast=False)
def _nearest_depth_rows(begin, end, means, cameras, near_z, out):  # type: ignore[no-untyped-def]
    """out[i] = smallest z-depth over the cameras that see mean i, or inf."""
    for i in range(begin, end):
        x, y, z = means[i, 0], means[i, 1], means[i, 2]
        nearest = math.inf
        for c in range(cameras.shape[0]):
            cam = cameras[c]
            depth = cam[6] * x + cam[7] * y + cam[8] * z + cam[11]
            if not depth > near_z or depth >= nearest:
                continue
            u = cam[12] * (cam[0] * x + cam[1] * y + cam[2] * z + cam[9]) / depth + cam[14]
            v = cam[13] * (cam[3] * x + cam[4] * y + cam[5] * z + cam[10]) / depth + cam[15]
            if cam[16] <= u <= cam[17] and cam[18] <= v <= cam[19]:
                nearest = depth
        out[i] = nearest


def mip_filter(
    means: np.ndarray,
    cameras: Sequence[Camera],
    *,
    variance_px: float = FILTER_VARIANCE_PX,
    near_z: float = tolerances.NEAR_Z,
    threads: int = 0,
) -> np.ndarray:
    """Return the filter's standard deviation of each Gaussian (docs/method.md, section 1.5).

    ``f = z_min / focal_max * sqrt(variance_px)``, with ``z_min`` the smallest z-depth over
    the cameras whose image, enlarged by 15 % on each side, contains the mean.

    Parameters
    ----------
    means : (n, 3)
        Scene units.
    cameras : sequence of Camera
        Training cameras at the training resolution, scene frame.
    variance_px : float
        Variance of the filter, squared pixels of the closest camera.
    near_z : float
        Smaller z-depths are ignored, scene units.

    Returns
    -------
    (n,) float64
        Scene units. Gaussians that no camera sees get the largest value of the others.
    """
    if len(cameras) == 0 or len(means) == 0:
        return np.zeros(len(means))
    packed = np.array([_pack(camera) for camera in cameras])
    points = np.ascontiguousarray(means, np.float64)
    depth = np.empty(len(points))
    threads = threads or default_threads()

    def run(begin: int, end: int) -> None:
        _nearest_depth_rows(begin, end, points, packed, near_z, depth)

    run_chunks(run, even_bounds(len(points), threads), threads)
    seen = np.isfinite(depth)
    depth[~seen] = depth[seen].max() if seen.any() else near_z
    focal_px = max(max(camera.fx, camera.fy) for camera in cameras)
    return depth / focal_px * math.sqrt(variance_px)


def _pack(camera: Camera) -> list[float]:
    wide, high = IMAGE_MARGIN * camera.width, IMAGE_MARGIN * camera.height
    return [
        *camera.rotation.reshape(-1).tolist(), *camera.cam_from_world[:, 3].tolist(),
        camera.fx, camera.fy, camera.cx, camera.cy,
        -wide, camera.width + wide, -high, camera.height + high,
    ]  # fmt: skip
