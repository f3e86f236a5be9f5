# SPDX-License-Identifier: GPL-3.0-or-later
"""The scene's frame: grid, up direction, ground plane, scale; frames of files."""

from __future__ import annotations

import dataclasses
import itertools
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..errors import DatasetError, UsageError
from ..limits import MIN_IMAGES, SCENE_RADIUS
from ..names import EXPORT_FORMATS
from .camera import (
    Camera,
    Similarity,
    pose_at,
    quaternion_from_rotation,
    rotation_from_quaternion,
)
from .placement import COINCIDENT, Plane

# -- Round the scene to a grid, so that every similarity of an input gives the same bits ----------
#
# Training amplifies the last digit of its input: a scene that is scaled or moved has other
# rounding errors, and would get another mesh (docs/method.md, section 1.7). The steps below are
# far coarser than rounding errors of float64 in the input and far finer than the errors of solved
# cameras.

CENTER_STEP = 2.0**-17
"""Step of camera centres in scene units. Moves a camera by at most 7e-6: 0.01 pixels for a focal
length of 4000 pixels and a distance of 3. Models in UTM coordinates have errors of 1e-9."""

POINT_STEP = 2.0**-13
"""Step of sparse points in scene units: at most 1e-4 off, 0.03 pixels for a focal length of 1000
pixels and a distance of 3. There are many points, and training only starts from them."""

FRAME_STEP = 2.0**-20
"""Step of the quaternion of the scene's axes: they follow from camera centres, whose errors are
larger than those of rotations. Tilts the scene by at most 2e-6."""

ROTATION_STEP = 2.0**-30
"""Step of the quaternions of cameras: at most 2e-9; rounding errors are 1e-15."""

LENGTH_BITS = 16
"""Significant bits of a requested length in scene units: at most 1e-5 of it off."""


def snapped(values: np.ndarray, step: float) -> np.ndarray:
    """Return the nearest multiples of ``step``, exactly; a power of two."""
    return np.rint(np.asarray(values, np.float64) / step) * step + 0.0  # no negative zeros


def snapped_rotation(rotation: np.ndarray, step: float) -> np.ndarray:
    """Return the (3, 3) rotation of a quaternion rounded to multiples of ``step``."""
    near = rotation_from_quaternion(snapped(quaternion_from_rotation(rotation), step))
    assert near is not None  # its norm is 1 up to the step
    return near


def snapped_camera(camera: Camera) -> Camera:
    """Return a camera of the scene frame with centre and rotation on the grid."""
    rotation = snapped_rotation(camera.rotation, ROTATION_STEP)
    pose = pose_at(rotation, snapped(camera.center, CENTER_STEP))
    return dataclasses.replace(camera, cam_from_world=pose)


def snapped_length(length: float) -> float:
    """Return a length in scene units, rounded to :data:`LENGTH_BITS` significant bits."""
    fraction, exponent = math.frexp(length)
    return math.ldexp(round(math.ldexp(fraction, LENGTH_BITS)), exponent - LENGTH_BITS)


# -- Compute the scene frame: Z up, mean camera centre at 0, cameras within a fixed radius --------

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
        text = f"The cameras lie farther than {MAX_COORDINATE:g} units from the origin."
        raise DatasetError(text, "Solve the cameras again.")
    if int(keep.sum()) < MIN_IMAGES:
        text = f"Only {int(keep.sum())} cameras are near each other; {MIN_IMAGES} are needed."
        raise DatasetError(text, "Solve the cameras again.")
    kept = centers[keep]
    middle = np.median(kept, axis=0)
    offsets = kept - middle  # subtract first: coordinates may be huge
    mean = middle + offsets.mean(0)
    offsets = kept - mean
    reach = float(np.linalg.norm(offsets, axis=1).max())
    if reach <= _COINCIDENT * max(float(np.abs(kept).max()), 1e-300):
        text = "All photos were taken from one place, so that no depth can be measured."
        raise DatasetError(text, "Walk around the object while taking photos.")
    if z_up:
        up, rule = np.array([0.0, 0.0, 1.0]), KNOWN_UP
    else:
        up, rule = up_direction(rotations[keep], offsets)
    # Rounded as seen by the first camera: no similarity of the input changes that view of the axes.
    first = rotations[keep][0]
    rotation = snapped_rotation(_rotation_to_z(up, rotations[keep]) @ first.T, FRAME_STEP) @ first
    spread = np.linalg.svd(offsets, compute_uv=False)
    world_from_scene = Similarity(RADIUS_MARGIN * reach / SCENE_RADIUS, rotation.T, mean)
    return SceneFrame(world_from_scene.inverse(), keep, rule, bool(spread[1] < 1e-3 * spread[0]))


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
    guess = _robust_mean(-rotations[:, 1, :])  # (n, 3): y points down
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
        flat = values[0] < _MAX_PLANE_THICKNESS**2 * values[1]
        flat = flat and values[1] > _MIN_SPREAD_RATIO * values[2]
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
    return np.stack([np.cross(ahead, up), ahead, up])


# -- Estimate the up direction from cameras that may be rolled by quarter turns -------------------

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

    First as in the scene frame (:func:`~.frames.up_direction`). If too few cameras are
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
    near = _angle_to_quarter_turn(roll) < np.radians(QUARTER_DEG)
    return float((near & (seen > _MIN_PROJECTED_UP)).mean())


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


# -- Find the ground plane of a scene from its surface --------------------------------------------

LEVEL_DEG = 20.0
"""Largest tilt of ground faces: the up direction from cameras is off by a few degrees at most."""
BAND_SHARE = 0.02
"""Thickness of the plane's inlier band, as a share of the surface's extent."""
CLEAR_SHARE = 0.4
"""Share of the level, upward-facing area below the top that the plane must contain."""
LOW_SHARE = 0.4
"""The plane must lie in this lowest share of the heights: tops of objects are level as well."""
_ROUNDS = 4


def find_ground_plane(
    centers: np.ndarray, normals: np.ndarray, areas: np.ndarray, up: np.ndarray
) -> Plane | None:
    """Find the level plane that contains most of the low, upward-facing surface.

    Parameters
    ----------
    centers, normals : (f, 3) float64
        Centres and outward unit normals of a mesh's faces.
    areas : (f,) float64
    up : (3,) float64
        Unit vector, accurate to :data:`LEVEL_DEG`.

    Returns
    -------
    Plane or None
        None if no plane is distinct.
    """
    good = np.isfinite(centers).all(1) & np.isfinite(normals).all(1) & (areas > 0.0)
    centers, normals, areas = centers[good], normals[good], areas[good]
    level = normals @ up > np.cos(np.radians(LEVEL_DEG))
    if not level.any():
        return None
    middle = centers.mean(0)
    heights = (centers - middle) @ up  # (f,)
    extent = float(np.linalg.norm(np.ptp(centers, 0)))
    band = BAND_SHARE * extent
    if band <= COINCIDENT * float(np.abs(centers).max()):
        return None
    floor, ceiling = float(heights.min()), float(heights.max())
    limit = floor + LOW_SHARE * (ceiling - floor)
    level &= heights < ceiling - band  # a region closes the objects it cuts with a level top
    if not level.any():
        return None
    points, weights, low = centers[level] - middle, areas[level], heights[level] < limit
    start = _fullest_band(heights[level][low], weights[low], band)
    if start is None:
        return None
    normal, offset = up, start
    for _ in range(_ROUNDS):
        near = np.abs(points @ normal - offset) <= band  # (l,)
        if near.sum() < 3:
            return None
        mean = np.average(points[near], axis=0, weights=weights[near])
        spread = points[near] - mean
        values, axes = np.linalg.eigh((spread * weights[near, None]).T @ spread)
        if values[1] <= 1e-4 * values[2]:
            return None  # a strip: rotation about it is undetermined
        normal = axes[:, 0] if axes[:, 0] @ up >= 0.0 else -axes[:, 0]
        offset = float(mean @ normal)
    near = np.abs(points @ normal - offset) <= band
    is_clear = near.any() and weights[near].sum() >= CLEAR_SHARE * weights.sum()
    if not is_clear or normal @ up < np.cos(np.radians(LEVEL_DEG)):
        return None
    mean = np.average(points[near], axis=0, weights=weights[near])
    return Plane(middle + mean, normal)


def _fullest_band(heights: np.ndarray, weights: np.ndarray, width: float) -> float | None:
    """Return the middle of the window of ``width`` that holds the most weight."""
    if len(heights) == 0:
        return None
    order = np.argsort(heights, kind="stable")
    heights, total = heights[order], np.concatenate([[0.0], np.cumsum(weights[order])])
    last = np.searchsorted(heights, heights + width, side="right")  # (k,)
    return float(heights[int(np.argmax(total[last] - total[:-1]))] + 0.5 * width)


# -- Coordinate frame of an exported file: target frame, axes and offset --------------------------
#
# Files of Y-up formats hold (x, z, -y) of the Z-up coordinates, as Blender's own exporters write.

FAR_FROM_ORIGIN = 100.0
"""Further than this many sizes from the origin, float32 rounding exceeds 1e-5 of the size."""

Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Rotation from Z up to Y up."""


@dataclass(frozen=True)
class FileFrame:
    """The frame of one file."""

    format: str
    """A name of :data:`EXPORT_FORMATS`."""
    target_from_scene: Similarity
    """Transform to the world of the input, or to the scene as placed in Blender."""
    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """(3,) float64, target frame: offset subtracted from the file's coordinates."""

    @property
    def turn(self) -> np.ndarray:
        """(3, 3) rotation from the target's axes to those of the file."""
        return Y_UP if EXPORT_FORMATS[self.format].y_up else np.eye(3)

    def local(self, points: np.ndarray) -> np.ndarray:
        """Map (n, 3) scene points to the target frame minus the offset, axes not yet turned."""
        return self.target_from_scene.points(points) - self.offset

    def file_from_scene(self) -> Similarity:
        """Return the transform from the scene frame to the file's coordinates."""
        return Similarity(1.0, self.turn, -(self.turn @ self.offset)).after(self.target_from_scene)

    def to_json(
        self, world_from_scene: Similarity, blender_from_scene: Similarity
    ) -> dict[str, Any]:
        """Return the entries of a sidecar: all transforms from the file's frame, in float64."""
        scene_from_file = self.file_from_scene().inverse()
        y_up = EXPORT_FORMATS[self.format].y_up
        return {
            "up": "+Y" if y_up else "+Z", "front": "+Z" if y_up else "-Y",
            "offset": np.asarray(self.offset, np.float64).tolist(),
            "world_from_file": world_from_scene.after(scene_from_file).to_json(),
            "blender_from_file": blender_from_scene.after(scene_from_file).to_json(),
            "scene_from_file": scene_from_file.to_json(),
            "world_from_scene": world_from_scene.to_json(),
            "blender_from_scene": blender_from_scene.to_json(),
        }  # fmt: skip


def file_offset(world: np.ndarray) -> np.ndarray:
    """Return the (3,) float64 offset to subtract: 0, or whole units near the centre."""
    low, high = world.min(axis=0), world.max(axis=0)
    size = float((high - low).max())
    centre = 0.5 * (low + high)
    if np.abs(centre).max() <= FAR_FROM_ORIGIN * size:
        return np.zeros(3)
    return np.round(centre) if size > 1.0 else centre
