# SPDX-License-Identifier: GPL-3.0-or-later
"""Similarity transforms of Gaussians: means, shapes, orientations and harmonics."""

from __future__ import annotations

import functools
import math

import numpy as np
import torch
from torch import Tensor

from ...dataset.loading.splat_cameras import fibonacci_directions
from ...dataset.quaternion import quaternion_from_rotation
from ...dataset.scene import usable_points
from ...dataset.similarity import Similarity
from ...errors import DatasetError
from ...gaussians.model import OrientedGaussians
from ...render.reference.reference_projection import harmonics_basis
from ...report_warning import LEFT_OUT_HINT, ReportWarning
from ...tolerances import POINT_REACH, SCENE_RADIUS

_DIRECTIONS = 64
"""Directions for the fit of rotated harmonics; 16 would do, more are better conditioned."""


def transform_gaussians(
    gaussians: OrientedGaussians, target_from_source: Similarity
) -> OrientedGaussians:
    """Transform Gaussians to another frame.

    They look the same from transformed cameras.

    Parameters
    ----------
    gaussians : OrientedGaussians
        Source frame; lengths (``filter_3d`` too) in its units.
    target_from_source : Similarity

    Returns
    -------
    OrientedGaussians
        float64, target frame.
    """
    wide = {name: t.detach().cpu().double() for name, t in gaussians.tensors()}
    similarity = target_from_source
    rotation = torch.from_numpy(np.array(similarity.rotation, np.float64))
    means = torch.from_numpy(similarity.points(wide["means"].numpy()))
    direction = wide["orientation"][:, :3] @ rotation.T
    return OrientedGaussians(
        means=means,
        log_scales=wide["log_scales"] + math.log(similarity.scale),
        quats=_rotated(wide["quats"], quaternion_from_rotation(similarity.rotation)),
        opacity_logits=wide["opacity_logits"],
        sh=rotate_harmonics(wide["sh"], rotation),
        orientation=torch.cat([direction, wide["orientation"][:, 3:]], dim=1),
        filter_3d=wide["filter_3d"] * similarity.scale,
    )


def within_reach(
    gaussians: OrientedGaussians,
) -> tuple[OrientedGaussians, list[ReportWarning]]:
    """Leave out Gaussians of the scene frame that are too far away to be trained.

    Raises
    ------
    DatasetError
        None is left.
    """
    near = usable_points(gaussians.means.detach().numpy())
    if near.all():
        return gaussians, []
    if not near.any():
        raise DatasetError(
            "All Gaussians of the splat are far away from the cameras.",
            "Give the camera poses that the splat was trained with, or wrap the splat alone.",
        )
    text = (
        f"{int((~near).sum())} of {len(near)} Gaussians of the splat were left out: they are "
        f"farther away than {POINT_REACH / SCENE_RADIUS:.0f} scene radii."
    )
    kept = torch.from_numpy(np.flatnonzero(near))
    return gaussians.select(kept), [ReportWarning("gaussians-far-away", text, LEFT_OUT_HINT)]


def _rotated(quats: Tensor, turn: np.ndarray) -> Tensor:
    """Return the (n, 4) products ``turn * quats`` of quaternions w x y z."""
    a, b, c, d = turn.tolist()
    left = quats.new_tensor([[a, -b, -c, -d], [b, a, -d, c], [c, d, a, -b], [d, -c, b, a]])
    return quats @ left.T


def rotate_harmonics(sh: Tensor, rotation: Tensor) -> Tensor:
    """Rotate functions on the sphere, given by real spherical harmonics.

    The coefficients are fitted to the function in :data:`_DIRECTIONS` directions, by least squares
    for each degree; rotations do not mix degrees, so the fit is exact.

    Parameters
    ----------
    sh : (n, (degree + 1)^2, 3)
        Of degree 0 to 3.
    rotation : (3, 3)
        Rotation of the frame: the result at ``rotation @ d`` equals the input at ``d``.

    Returns
    -------
    Tensor
        Same shape and type as ``sh``.
    """
    degree = math.isqrt(sh.shape[1]) - 1
    if torch.equal(rotation, torch.eye(3, dtype=rotation.dtype)):
        return sh
    before = _directions()  # (m, 3)
    after = before @ rotation.double().T
    basis, turned = harmonics_basis(before, degree), harmonics_basis(after, degree)  # (m, k)
    out = sh.double().clone()
    for level in range(1, degree + 1):
        band = slice(level * level, (level + 1) ** 2)
        matrix = torch.linalg.lstsq(turned[:, band], basis[:, band]).solution  # (2l+1, 2l+1)
        out[:, band] = torch.einsum("ij,njc->nic", matrix, sh[:, band].double())
    return out.to(sh.dtype)


@functools.cache
def _directions() -> Tensor:
    """Return (m, 3) evenly spread unit vectors: a spherical Fibonacci lattice."""
    return torch.from_numpy(fibonacci_directions(_DIRECTIONS))


def with_degree(gaussians: OrientedGaussians, degree: int) -> OrientedGaussians:
    """Return the Gaussians with harmonics of a degree, truncated or zero-padded."""
    wanted = (degree + 1) ** 2
    sh = gaussians.sh[:, :wanted]
    missing = sh.new_zeros((len(sh), wanted - sh.shape[1], 3))
    return gaussians.replaced(sh=torch.cat([sh, missing], dim=1))
