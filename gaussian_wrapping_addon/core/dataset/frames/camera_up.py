# SPDX-License-Identifier: GPL-3.0-or-later
"""Estimate the up direction from cameras that may be rolled by quarter turns."""

from __future__ import annotations

import itertools

import numpy as np

from ...errors import UsageError
from .normalisation import MEAN_UP, up_direction

MIN_AGREEING_SHARE = 0.7
"""Share of the cameras that must agree with an up direction: about three quarters of hand-held
photos are level or turned by quarters, and a random direction reaches at most half
(:func:`_quarter_turn_share`)."""
UPRIGHT_DEG = 40.0
"""Roll below which a camera counts as upright: below 45 degrees, which is half way between level
and a quarter turn."""
QUARTER_DEG = 12.0
"""Deviation of the roll from a quarter turn below which a camera counts as aligned with it.
Hand-held cameras are within a few degrees; at random a quarter of all cameras would be."""
_MIN_PROJECTED_UP = 0.3
"""Minimum length of the up direction's projection into the image (17 degrees): the roll of a camera
that looks along it is undefined."""
_SAME_DIRECTION_DEG = 30.0
"""Directions within this angle count as the same candidate."""
_AMBIGUOUS_SHARE = 0.9
"""Another direction with this share of the best one's agreement makes the result ambiguous."""
_MIN_PITCH_SINE = 0.05
"""Mean sine of the cameras' pitch beyond which they look down or up (3 degrees)."""
_MIN_SIGN_MAJORITY = 0.2
"""Majority, as a share of all cameras, that decides between up and down."""
_MAX_CAMERAS = 32
"""Number of cameras whose axes are combined to candidates; all cameras score them."""

_HINT = "Pick three points on the ground and press Set Ground."


def camera_up(rotations: np.ndarray, centers: np.ndarray) -> tuple[np.ndarray, str]:
    """Estimate the up direction from how people hold cameras.

    First as in the scene frame (:func:`~.normalisation.up_direction`). If too few cameras are
    upright by that, photos may be rolled by quarter turns (phones whose photos carry no
    orientation): then up is the direction for which most cameras have a roll near a multiple of a
    quarter turn. Its sign is that of upright cameras, or else the side from which they look down.

    Parameters
    ----------
    rotations : (n, 3, 3) float64
        ``cam_from_world`` rotations, camera axes x right, y down, z forward.
    centers : (n, 3) float64
        Camera centres.

    Returns
    -------
    up : (3,) float64, unit length
    rule : str
        A rule of ``up_direction``, or ``"cameras turned by quarters"``.

    Raises
    ------
    UsageError
        There is no camera, or the cameras contradict each other.
    """
    rotations = np.asarray(rotations, np.float64).reshape(-1, 3, 3)
    centers = np.asarray(centers, np.float64).reshape(-1, 3)
    if len(rotations) == 0:
        raise UsageError("The result has no photo cameras.", "Import the result again.")
    if not (np.isfinite(rotations).all() and np.isfinite(centers).all()):
        raise UsageError("A photo camera has no finite position.", "Import the result again.")
    up, rule = up_direction(rotations, centers - centers.mean(0))
    upright = _upright_share(rotations, up, UPRIGHT_DEG) >= MIN_AGREEING_SHARE
    nearly_level = _upright_share(rotations, up, QUARTER_DEG) >= MIN_AGREEING_SHARE
    if upright and (nearly_level or rule != MEAN_UP):
        return up, rule
    try:
        return _up_from_quarter_turns(rotations), "cameras turned by quarters"
    except UsageError:
        # On an arc, the mean of cameras that lie on their sides resembles a loosely held upright
        # camera; if quarter turns explain nothing, it was the latter.
        if upright:
            return up, rule
        raise


def _up_from_quarter_turns(rotations: np.ndarray) -> np.ndarray:
    candidates = _candidates(rotations)
    shares = np.array([_quarter_turn_share(rotations, c) for c in candidates])
    best = int(np.argmax(shares))
    apart = np.abs(candidates @ candidates[best]) < np.cos(np.radians(_SAME_DIRECTION_DEG))
    second_best = float(shares[apart].max()) if apart.any() else 0.0
    if shares[best] < MIN_AGREEING_SHARE:
        raise UsageError("The cameras are rolled too differently to find the up direction.", _HINT)
    if second_best >= _AMBIGUOUS_SHARE * shares[best]:
        raise UsageError("The cameras allow two different up directions.", _HINT)
    up = _refined(rotations, candidates[best])
    return up * _sign(rotations, up)


def _roll_and_projection(rotations: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return roll relative to ``up`` in radians and length of its projection into each image.

    Both (n,).
    """
    across, along = rotations[:, 0] @ up, -(rotations[:, 1] @ up)
    return np.arctan2(across, along), np.hypot(across, along)


def _angle_to_quarter_turn(roll: np.ndarray) -> np.ndarray:
    quarter = 0.5 * np.pi
    return np.abs(roll - quarter * np.round(roll / quarter))


def _upright_share(rotations: np.ndarray, up: np.ndarray, limit_deg: float) -> float:
    """Return the share of cameras with a smaller roll, among those with a defined roll.

    Cameras that look straight down do not count against a direction, unless most of them do.
    """
    roll, seen = _roll_and_projection(rotations, up)
    held = (np.abs(roll) < np.radians(limit_deg)) & (seen > _MIN_PROJECTED_UP)
    return float(held.sum() / max((seen > _MIN_PROJECTED_UP).sum(), 0.5 * len(roll)))


def _quarter_turn_share(rotations: np.ndarray, up: np.ndarray) -> float:
    """Return the share of all cameras near a quarter turn, excluding those looking along ``up``."""
    roll, seen = _roll_and_projection(rotations, up)
    return float(
        (
            (_angle_to_quarter_turn(roll) < np.radians(QUARTER_DEG)) & (seen > _MIN_PROJECTED_UP)
        ).mean()
    )


def _candidates(rotations: np.ndarray) -> np.ndarray:
    """Return (k, 3) unit directions: image axes, and normals of the image axes of two cameras."""
    step = max(1, -(-len(rotations) // _MAX_CAMERAS))
    subset = rotations[::step, :2, :]  # (c, 2, 3): either axis may be the level one
    found = [*subset.reshape(-1, 3)]
    for first, second in itertools.combinations(subset, 2):
        for a, b in itertools.product(first, second):
            normal = np.cross(a, b)
            length = np.linalg.norm(normal)
            if length > 0.2:  # nearer to parallel, noise turns the direction freely
                found.append(normal / length)
    return np.array(found)


def _refined(rotations: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return the direction most nearly orthogonal to the level axes of the aligned cameras."""
    for _ in range(10):
        roll, seen = _roll_and_projection(rotations, up)
        held = (_angle_to_quarter_turn(roll) < np.radians(QUARTER_DEG)) & (seen > _MIN_PROJECTED_UP)
        upright = np.abs(np.cos(roll)) > np.sqrt(0.5)
        level = np.where(upright[:, None], rotations[:, 0], rotations[:, 1])[held]  # (m, 3)
        values, axes = np.linalg.eigh(level.T @ level)
        if values[1] < 0.01 * values[2]:
            return up  # all level axes are parallel: the pitch is undetermined
        up = axes[:, 0] if axes[:, 0] @ up >= 0.0 else -axes[:, 0]
    return up


def _sign(rotations: np.ndarray, up: np.ndarray) -> float:
    vote = float((-(rotations[:, 1] @ up)).mean())
    if abs(vote) > _MIN_SIGN_MAJORITY:
        return float(np.sign(vote))
    pitch = float((rotations[:, 2] @ up).mean())
    if abs(pitch) > _MIN_PITCH_SINE:
        return float(-np.sign(pitch))
    raise UsageError("The cameras do not distinguish up from down.", _HINT)
