# SPDX-License-Identifier: GPL-3.0-or-later
"""Compute the scene frame: Z up, mean camera centre at 0, cameras within a fixed radius."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...errors import DatasetError
from ...limits import MIN_IMAGES
from ...tolerances import SCENE_RADIUS
from ..similarity import Similarity
from .scene_grid import FRAME_STEP, snapped_rotation

RADIUS_MARGIN = 1.1
"""The largest camera distance times this becomes ``SCENE_RADIUS`` (docs/method.md, section 1.7)."""
FAR_CAMERA_FACTOR = 30.0
"""A camera further than this many median distances from the median position is an outlier."""
_COINCIDENT = 1e-12
"""Share of the coordinates' size below which positions coincide in float64."""
_MAX_LEVEL_TILT = 0.15
"""Mean |sin| of the angle between level camera axes and the horizon: about 9 degrees."""
_MIN_SPREAD_RATIO = 0.03
"""Smallest ratio of the middle to the largest eigenvalue: directions fan out by 20 degrees."""
_MAX_NOISE_RATIO = 0.2
"""Largest ratio of the smallest to the middle eigenvalue: the plane is above the noise."""
_MAX_PLANE_THICKNESS = 0.05
"""Largest thickness over width of a planar camera path."""
MEAN_UP = "mean camera up"
"""The rule of :func:`up_direction` that falls back to the mean."""
KNOWN_UP = "metric frame"
"""The rule where the world's up is known."""
_MIN_AGREEMENT_COS = np.cos(np.radians(50.0))
"""Largest angle between the up direction and the cameras' mean up, as a cosine."""


MAX_COORDINATE = 1e100
"""Of a camera, in world units: squares of larger ones come near the end of float64."""


@dataclass(frozen=True)
class SceneFrame:
    """The similarity to the scene frame, the cameras to keep, and the rule for up."""

    scene_from_world: Similarity
    keep: np.ndarray
    """(n,) bool; outliers far from all other cameras are excluded."""
    up_rule: str
    collinear: bool
    """Whether all camera centres lie on one line."""


def find_scene_frame(
    rotations: np.ndarray, centers: np.ndarray, *, z_up: bool = False
) -> SceneFrame:
    """Compute the scene frame of posed cameras.

    Parameters
    ----------
    rotations : (n, 3, 3) float64
        ``cam_from_world`` rotations, camera axes x right, y down, z forward.
    centers : (n, 3) float64
        Camera centres, world frame; may be far from the origin.
    z_up : bool
        Whether the world's z is known to point up.

    Returns
    -------
    SceneFrame

    Raises
    ------
    DatasetError
        All cameras coincide, or too few remain.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        keep = near_cameras(centers)
        vast = bool(keep.any()) and np.abs(centers[keep]).max() > MAX_COORDINATE
    if vast:
        raise DatasetError(
            f"The cameras lie farther than {MAX_COORDINATE:g} units from the origin.",
            "Solve the cameras again.",
        )
    if int(keep.sum()) < MIN_IMAGES:
        raise DatasetError(
            f"Only {int(keep.sum())} cameras are near each other; {MIN_IMAGES} are needed.",
            "Solve the cameras again.",
        )
    kept = centers[keep]
    middle = np.median(kept, axis=0)
    offsets = kept - middle  # subtract first: coordinates may be huge
    mean = middle + offsets.mean(0)
    offsets = kept - mean
    reach = float(np.linalg.norm(offsets, axis=1).max())
    size = float(np.abs(centers[keep]).max())
    if reach <= _COINCIDENT * max(size, 1e-300):
        raise DatasetError(
            "All photos were taken from one place, so that no depth can be measured.",
            "Walk around the object while taking photos.",
        )
    if z_up:
        up, rule = np.array([0.0, 0.0, 1.0]), KNOWN_UP
    else:
        up, rule = up_direction(rotations[keep], offsets)
    # Rounded as seen by the first camera: no similarity of the input changes that view of the axes.
    first = rotations[keep][0]
    rotation = snapped_rotation(_rotation_to_z(up, rotations[keep]) @ first.T, FRAME_STEP) @ first
    spread = np.linalg.svd(offsets, compute_uv=False)
    return SceneFrame(
        Similarity(RADIUS_MARGIN * reach / SCENE_RADIUS, rotation.T, mean).inverse(),
        keep,
        rule,
        bool(spread[1] < 1e-3 * spread[0]),
    )


def near_cameras(centers: np.ndarray) -> np.ndarray:
    """Return (n,) bool: which of the (n, 3) camera centres are not outliers."""
    finite = np.isfinite(centers).all(1)
    if not finite.any():
        return finite
    middle = np.median(centers[finite], axis=0)
    distances = np.linalg.norm(np.where(finite[:, None], centers - middle, 0.0), axis=1)
    typical = float(np.median(distances[finite]))
    if typical <= _COINCIDENT * max(float(np.abs(middle).max()), 1e-300):
        return finite
    return finite & (distances <= FAR_CAMERA_FACTOR * typical)


def up_direction(rotations: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, str]:
    """Estimate the up direction from how people hold cameras.

    The mean of the cameras' up axes gives the sign and a first guess, which is tilted by a constant
    pitch over part of a circle. Level cameras have horizontal x axes at any pitch, so the direction
    most nearly orthogonal to all of these is preferred; then the normal of a planar camera path.
    Both are used only if they are well determined and agree with the first guess.

    Parameters
    ----------
    rotations : (n, 3, 3) float64, cam_from_world
    offsets : (n, 3) float64
        Camera centres relative to their mean.

    Returns
    -------
    up : (3,) float64, unit length, world frame
    rule : str
        ``"level cameras"``, ``"plane camera path"`` or ``"mean camera up"``.
    """
    ups = -rotations[:, 1, :]  # (n, 3): y points down
    guess = _robust_mean(ups)
    rights = rotations[:, 0, :]  # (n, 3)
    level, values = _least_aligned(rights)
    tilt = float(np.median(np.abs(rights @ level)))
    fans_out = (
        values[1] > _MIN_SPREAD_RATIO * values[2] and values[0] < _MAX_NOISE_RATIO * values[1]
    )
    if fans_out and tilt < _MAX_LEVEL_TILT and abs(level @ guess) > _MIN_AGREEMENT_COS:
        return _signed(level, guess), "level cameras"
    if len(offsets) >= 8:
        normal, values = _least_aligned(offsets)
        flat = (
            values[0] < _MAX_PLANE_THICKNESS**2 * values[1]
            and values[1] > _MIN_SPREAD_RATIO * values[2]
        )
        if flat and abs(normal @ guess) > _MIN_AGREEMENT_COS:
            return _signed(normal, guess), "plane camera path"
    return guess, MEAN_UP


def _robust_mean(directions: np.ndarray) -> np.ndarray:
    """Return the geometric median direction of (n, 3) unit vectors."""
    best = directions.mean(0)
    for _ in range(30):
        gaps = np.linalg.norm(directions - best, axis=1)
        weights = 1.0 / np.maximum(gaps, 1e-3)
        best = (weights[:, None] * directions).sum(0) / weights.sum()
    length = np.linalg.norm(best)
    if length < 1e-6:  # directions cancel out: any direction is as good
        return directions[0] / np.linalg.norm(directions[0])
    return best / length


def _least_aligned(vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the direction most nearly orthogonal to (n, 3) vectors, and ascending eigenvalues.

    Cauchy weights on the sine of the angle keep a few rolled cameras from tilting the result.
    """
    lengths = np.linalg.norm(vectors, axis=1)
    unit = vectors / np.maximum(lengths, 1e-300)[:, None]
    weights = np.ones(len(vectors))
    values, axes = np.zeros(3), np.eye(3)
    for _ in range(20):
        values, axes = np.linalg.eigh((vectors * weights[:, None]).T @ vectors)
        sines = unit @ axes[:, 0]
        spread = max(1.5 * float(np.median(np.abs(sines))), 1e-3)
        weights = 1.0 / (1.0 + (sines / spread) ** 2)
    return axes[:, 0], np.maximum(values, 0.0)


def _signed(direction: np.ndarray, guess: np.ndarray) -> np.ndarray:
    return direction if direction @ guess >= 0 else -direction


def _rotation_to_z(up: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Return the (3, 3) rotation that turns ``up`` to +Z and the mean view towards +Y.

    The heading comes from the cameras too, so that the scene frame does not depend on the axes of
    the input.
    """
    forward = rotations[:, 2, :].sum(0)
    ahead = forward - up * (up @ forward)
    if np.linalg.norm(ahead) < 1e-3 * len(rotations):
        first = rotations[0, 2, :] if abs(rotations[0, 2, :] @ up) < 0.99 else -rotations[0, 1, :]
        ahead = first - up * (up @ first)
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, up)
    return np.stack([right, ahead, up])
