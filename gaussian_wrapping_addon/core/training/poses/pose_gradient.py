# SPDX-License-Identifier: GPL-3.0-or-later
"""Gradient with respect to a camera's pose, from those of the Gaussians that it sees."""

from __future__ import annotations

import numpy as np

from ...render.types.gradients import VisibleGradients

# Row k maps a quaternion (w, x, y, z) to that of the k-th unit rotation vector times it.
LEFT = np.array(
    [
        [[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 0, -1], [0, 0, 1, 0]],
        [[0, 0, -1, 0], [0, 0, 0, 1], [1, 0, 0, 0], [0, -1, 0, 0]],
        [[0, 0, 0, -1], [0, 0, -1, 0], [0, 1, 0, 0], [1, 0, 0, 0]],
    ],
    np.float64,
)


def pose_gradient(
    cam_from_world: np.ndarray, gradients: VisibleGradients, means: np.ndarray, quats: np.ndarray
) -> np.ndarray:
    """Return the gradient of a scalar with respect to a small motion in camera coordinates.

    Moving the camera is moving everything that it sees the other way, so the gradients of means
    and rotations hold all of it: x in camera coordinates becomes ``x + w cross x + t``, and every
    Gaussian turns by ``w``. Two small parts are left out: a rotation leaves the viewing directions
    in the world, by which harmonics change colour, as they are; and the orientation, which only
    the normals of wrapped Gaussians depend on. See docs/method.md, section 1.8.

    Parameters
    ----------
    cam_from_world : (3, 4) float64
        Pose at which the gradients were taken.
    gradients : VisibleGradients
        Of this view alone.
    means : (n, 3) float32
        Of all Gaussians, scene frame.
    quats : (n, 4) float32
        Raw, of all Gaussians.

    Returns
    -------
    (6,) float64
        With respect to the rotation vector w, radians, and the translation t, scene units.
    """
    rotation, translation = cam_from_world[:, :3], cam_from_world[:, 3]
    by_means = gradients.means.astype(np.float64)
    force = by_means.sum(0)  # (3,)
    # Sums by einsum: those of BLAS depend on the number of its threads.
    outer = np.einsum("vi,vj->ij", means[gradients.ids].astype(np.float64), by_means)
    local = rotation @ outer @ rotation.T + np.outer(translation, rotation @ force)
    odd = local - local.T
    torque = np.array([odd[1, 2], odd[2, 0], odd[0, 1]])
    by_quats = gradients.quats.astype(np.float64)
    turned = np.einsum("va,vb->ab", by_quats, quats[gradients.ids].astype(np.float64))
    torque += rotation @ (0.5 * np.einsum("kab,ab->k", LEFT, turned))
    return np.concatenate([torque, rotation @ force])
