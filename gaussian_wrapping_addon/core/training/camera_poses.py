# SPDX-License-Identifier: GPL-3.0-or-later
"""Camera poses refined while training."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from .. import limits
from ..render.types import VisibleGradients
from ..scene.camera import Camera
from ..scene.scene import PhotoSource
from .exposure import PhotoAdam, photo_rate

# -- Refined camera poses of the training photos (docs/method.md, section 1.8) --------------------
#
# Solved cameras are half a pixel off here and there, and that is the width of a spoke. The motion
# that all cameras share, and their common scale, are those of the given poses: they are the frame
# that users measure in, and no photo tells them.

TRAVEL_PX = 4.0
"""Total of a photo's steps over a training at the first rate; the rate falls, and steps waver, so
that poses a pixel off are reached."""

SMALLEST_RATE_PX, LARGEST_RATE_PX = 0.02, 0.25
"""Bounds of the first rate."""

LAST_SHARE = 0.05
"""Ratio of the last rate to the first: what Adam's last steps add remains as an error."""

LEAST_VIEWS = 4
"""Training photos below which poses stay as given: their common motion would be most of it."""

EPSILON = 1e-20
"""Of Adam; gradients are far smaller than those of Gaussians."""


def pose_rate_px(iteration: int, iterations: int, photos: int) -> float:
    """Return the learning rate of an iteration: how far a step moves the image, in pixels."""
    return photo_rate(
        iteration, iterations, photos,
        travel=TRAVEL_PX, bounds=(SMALLEST_RATE_PX, LARGEST_RATE_PX), last_share=LAST_SHARE,
    )  # fmt: skip


class CameraPoses:
    """Poses of all photos, with their optimizer state.

    Parameters
    ----------
    given : (n, 3, 4) float64
        Poses ``cam_from_world`` of the scene's views.
    trained : sequence of int
        Training views; the others keep their poses.
    """

    def __init__(self, given: np.ndarray, trained: Sequence[int]) -> None:
        self.given = np.array(given, np.float64).reshape(-1, 3, 4)
        self.trained = np.unique(np.asarray(trained, np.int64))
        self.active = len(self.trained) >= LEAST_VIEWS
        """Whether steps move poses."""
        self.refined = self.given.copy()
        self.adam = PhotoAdam(len(self.given), 6, np.float64, EPSILON)

    def camera(self, view: int, camera: Camera) -> Camera:
        """Return a photo's camera with its refined pose."""
        if self.adam.steps[view] == 0:
            return camera
        return dataclasses.replace(camera, cam_from_world=self.refined[view])

    def step(self, view: int, camera: Camera, gradient: np.ndarray, rate_px: float) -> None:
        """Move a photo's pose against the (6,) ``gradient`` of :func:`pose_gradient`, by Adam.

        ``rate_px`` is the size of a step: pixels of ``camera``'s image by rotation, and by
        translation of what lies as far away as the cameras are from the middle of the scene.
        """
        if not self.active:
            return
        unit = np.repeat([1.0, limits.SCENE_RADIUS], 3)
        rate = rate_px / max(camera.fx, camera.fy)
        # Translations in multiples of that distance.
        motion = -self.adam.step(view, gradient * unit, rate) * unit
        turn = Rotation.from_rotvec(motion[:3]).as_matrix()
        pose = turn @ self.refined[view]
        pose[:, 3] += motion[3:]
        self.refined[view] = pose

    def anchor(self) -> None:
        """Take out what the refined poses have in common, to first order.

        In world coordinates: the mean rotation, and the similarity without rotation that brings
        the centres closest to those of the given poses. In camera coordinates: the mean motion.
        Photos hardly tell that one either: if all cameras around a thing look up a little, the
        thing can move up instead.
        """
        if not self.active:
            return
        given = self.given[self.trained]
        refined = _without_common_motion(given, self.refined[self.trained])
        turns = np.einsum("nij,nkj->nik", refined[:, :, :3], given[:, :, :3])
        alike = Rotation.from_rotvec(-Rotation.from_matrix(turns).as_rotvec().mean(0)).as_matrix()
        shifts = refined[:, :, 3] - np.einsum("nij,nj->ni", turns, given[:, :, 3])
        refined = alike @ refined
        refined[:, :, 3] -= shifts.mean(0)
        self.refined[self.trained] = refined

    def give_up(self) -> None:
        """Go back to the given poses, and keep them."""
        self.active = False
        self.refined[...] = self.given
        self.adam.steps[...] = 0

    def moved(self) -> np.ndarray | None:
        """Return a copy of the (n, 3, 4) refined poses, or ``None`` if they are those given."""
        return self.refined.copy() if self.active and self.adam.steps.any() else None

    def shifts_px(self, cameras: Mapping[int, Camera], points: np.ndarray) -> np.ndarray:
        """Return how far refined poses move what the given ones show, (photos,) float64, pixels.

        The median over the points (n, 3), scene frame, in a photo; 0 where it shows none.
        ``cameras`` are those of photos, by view, with any pose.
        """
        shifts = []
        for view, camera in cameras.items():
            before = dataclasses.replace(camera, cam_from_world=self.given[view])
            after = dataclasses.replace(camera, cam_from_world=self.refined[view])
            pixels, depth = before.project(points)
            size = (camera.width, camera.height)
            shown = (depth > 0) & (pixels >= 0).all(1) & (pixels < size).all(1)
            moved = after.project(points[shown])[0] - pixels[shown]
            lengths = np.linalg.norm(moved, axis=1)
            shifts.append(float(np.median(lengths)) if len(lengths) else 0.0)
        return np.array(shifts)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return copies of all arrays, by name."""
        arrays = {name: getattr(self, name).copy() for name in ("given", "refined", "trained")}
        return arrays | self.adam.to_arrays() | {"active": np.array(self.active)}

    @classmethod
    def restore(cls, arrays: dict[str, np.ndarray]) -> CameraPoses:
        """Build from :meth:`to_arrays`.

        Raises
        ------
        KeyError, ValueError
            An array is missing or has the wrong shape.
        """
        poses = cls(arrays["given"], arrays["trained"].tolist())
        if arrays["refined"].shape != poses.refined.shape:
            raise ValueError(f"camera poses: refined has the shape {arrays['refined'].shape}")
        poses.refined[...] = arrays["refined"]
        poses.adam.load(arrays)
        poses.active = bool(arrays["active"])
        return poses


def _without_common_motion(given: np.ndarray, refined: np.ndarray) -> np.ndarray:
    """Return poses without the rotation, shift and scale of the world that they share."""
    turns = np.einsum("nij,nik->njk", refined[:, :, :3], given[:, :, :3])
    common = Rotation.from_rotvec(Rotation.from_matrix(turns).as_rotvec().mean(0)).as_matrix()
    rotations = refined[:, :, :3] @ common
    centers, wanted = (
        -np.einsum("nji,nj->ni", r, t)
        for r, t in ((rotations, refined[:, :, 3]), (given[:, :, :3], given[:, :, 3]))
    )
    middle, about = wanted.mean(0), centers - centers.mean(0)
    spread = float((about**2).sum())
    scale = float((about * (wanted - middle)).sum()) / spread if spread > 0.0 else 1.0
    moved = np.einsum("nij,nj->ni", rotations, -(middle + scale * about))
    return np.concatenate([rotations, moved[:, :, None]], 2)


# -- Photos whose cameras have refined poses ------------------------------------------------------


class PosedPhotos:
    """Photo source whose cameras follow the poses of a training instead of those given."""

    def __init__(self, photos: PhotoSource) -> None:
        self._photos = photos
        self.poses: CameraPoses | None = None
        """Poses to follow; ``None``: those given."""

    def camera(self, index: int, divisor: int = 1) -> Camera:
        camera = self._photos.camera(index, divisor)
        return camera if self.poses is None else self.poses.camera(index, camera)

    def photo(self, index: int, divisor: int = 1) -> np.ndarray:
        return self._photos.photo(index, divisor)

    def mask(self, index: int, divisor: int = 1) -> np.ndarray | None:
        return self._photos.mask(index, divisor)


# -- Gradient with respect to a camera's pose, from those of the Gaussians that it sees -----------


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
