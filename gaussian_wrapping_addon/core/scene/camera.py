# SPDX-License-Identifier: GPL-3.0-or-later
"""Cameras, rotations and similarities."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .. import limits
from ..limits import QUATERNION_MIN_NORM

# -- Rotations from quaternions and back, in float64 ----------------------------------------------


def rotation_from_quaternion(quaternion: np.ndarray) -> np.ndarray | None:
    """Return the (3, 3) rotation of a Hamilton quaternion w x y z; ``None`` if zero or NaN."""
    q = np.asarray(quaternion, np.float64)
    largest = np.abs(q).max()
    if not np.isfinite(q).all() or largest < QUATERNION_MIN_NORM:
        return None
    q = q / largest  # the squares of a huge quaternion would overflow
    w, x, y, z = q / np.linalg.norm(q)
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def quaternion_from_rotation(rotation: np.ndarray) -> np.ndarray:
    """Return the quaternion w x y z (w >= 0) of a (3, 3) rotation.

    The largest eigenvector of Bar-Itzhack's symmetric matrix: no case distinction, no loss of
    precision near half turns.
    """
    (a, b, c), (d, e, f), (g, h, i) = np.asarray(rotation, np.float64)
    matrix = np.array([
        [a + e + i, h - f, c - g, d - b],
        [h - f, a - e - i, b + d, c + g],
        [c - g, b + d, e - a - i, f + h],
        [d - b, c + g, f + h, i - a - e],
    ])  # fmt: skip
    quaternion = np.linalg.eigh(matrix)[1][:, -1]
    return quaternion if quaternion[0] >= 0 else -quaternion


def pose_at(cam_from_world: np.ndarray, center: np.ndarray) -> np.ndarray:
    """Return the (3, 4) pose of a camera with rotation (3, 3) and centre (3,)."""
    return np.concatenate([cam_from_world, -(cam_from_world @ center)[:, None]], 1)


# -- Similarity transforms in float64: scale, rotation, translation -------------------------------


@dataclass(frozen=True)
class Similarity:
    """Map ``x -> scale * rotation @ x + translation``.

    A variable that holds one is named ``target_from_source``.
    """

    scale: float = 1.0
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    """(3, 3) float64, orthonormal, determinant +1."""
    translation: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """(3,) float64, units of the target frame."""
    origin: np.ndarray | None = None
    """(3,) float64: the point that is mapped to 0, where it is known. It is subtracted first, so
    that points near it keep the digits that a huge translation would take from them."""

    def points(self, points: np.ndarray) -> np.ndarray:
        """Map (n, 3) points; float64 in, float64 out."""
        points = np.asarray(points, np.float64)
        if self.origin is not None:
            return self.scale * ((points - self.origin) @ self.rotation.T)
        return self.scale * (points @ self.rotation.T) + self.translation

    def directions(self, directions: np.ndarray) -> np.ndarray:
        """Rotate (n, 3) directions; lengths stay."""
        return np.asarray(directions, np.float64) @ self.rotation.T

    def inverse(self) -> Similarity:
        """Return the inverse transform; twice gives the translation bit for bit."""
        rotation = self.rotation.T
        if self.origin is not None:
            return Similarity(1.0 / self.scale, rotation, self.origin)
        translation = -(rotation @ self.translation) / self.scale
        return Similarity(1.0 / self.scale, rotation, translation, self.translation)

    def after(self, first: Similarity) -> Similarity:
        """Return the composition that applies ``first``, then this transform."""
        return Similarity(
            self.scale * first.scale,
            self.rotation @ first.rotation,
            self.points(first.translation[None])[0],
        )

    def matrix(self) -> np.ndarray:
        """Return the (4, 4) float64 matrix; not finite where numbers are too large."""
        matrix = np.eye(4)
        with np.errstate(over="ignore", invalid="ignore"):
            matrix[:3, :3] = self.scale * self.rotation
        matrix[:3, 3] = self.translation
        return matrix

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {
            "scale": float(self.scale),
            "rotation": np.asarray(self.rotation).tolist(),
            "translation": np.asarray(self.translation).tolist(),
        }

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Similarity:
        """Build from :meth:`to_json`'s values.

        Raises KeyError, TypeError, ValueError: an entry is missing, of another kind, or beyond
        float64.
        """
        try:
            return cls(
                float(values["scale"]),
                np.asarray(values["rotation"], np.float64).reshape(3, 3),
                np.asarray(values["translation"], np.float64).reshape(3),
            )
        except OverflowError:
            raise ValueError("a number is too large") from None


# -- A pinhole camera in the COLMAP convention ----------------------------------------------------


@dataclass(frozen=True)
class Camera:
    """A pinhole camera: x right, y down, z forward; first pixel's centre at (0.5, 0.5).

    ``cam_from_world`` maps the frame of whatever holds the camera ("world") into camera
    coordinates. Inside a :class:`~.scene.Scene` that frame is the scene frame.
    """

    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    cam_from_world: np.ndarray
    """(3, 4) float64, rotation and translation."""

    @property
    def rotation(self) -> np.ndarray:
        """(3, 3) rotation of ``cam_from_world``."""
        return self.cam_from_world[:, :3]

    @property
    def center(self) -> np.ndarray:
        """(3,) position of the camera in the world frame."""
        return -self.cam_from_world[:, :3].T @ self.cam_from_world[:, 3]

    @property
    def forward(self) -> np.ndarray:
        """(3,) unit viewing direction in the world frame."""
        return self.cam_from_world[2, :3]

    @property
    def gaze(self) -> np.ndarray:
        """(3,) direction of the image's middle in the world frame, with a z-depth of 1.

        It is :attr:`forward` unless the principal point is off the middle, as in a cropped photo.
        """
        x = (0.5 * self.width - self.cx) / self.fx
        y = (0.5 * self.height - self.cy) / self.fy
        return np.array([x, y, 1.0]) @ self.rotation

    def to_camera(self, points: np.ndarray) -> np.ndarray:
        """Map (n, 3) world points to camera coordinates, float64."""
        return np.asarray(points, np.float64) @ self.rotation.T + self.cam_from_world[:, 3]

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project (n, 3) world points.

        Returns ``pixels``, (n, 2) float64, meaningless where ``depth <= 0``, and ``depth``, (n,)
        float64, the z-depth in world units.
        """
        local = self.to_camera(points)
        depth = local[:, 2]
        safe = np.where(np.abs(depth) > 1e-300, depth, 1e-300)
        x, y = self.fx * local[:, 0] / safe + self.cx, self.fy * local[:, 1] / safe + self.cy
        return np.stack([x, y], 1), depth

    def shown(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Look (n, 3) world points up in the image.

        Returns ``indices``, (m,) int64, of the points that project into the image; ``row`` and
        ``column``, (m,) int64, of their pixels; ``depth``, (m,) float64, z-depths > 0, world units.
        """
        pixels, depth = self.project(points)
        size = (self.width, self.height)
        indices = np.flatnonzero((depth > 0) & (pixels >= 0).all(1) & (pixels < size).all(1))
        column, row = pixels[indices].astype(np.int64).T
        return indices, row, column, depth[indices]

    def rays(self) -> np.ndarray:
        """Return (height, width, 3) float64 directions with z = 1, camera frame."""
        u = (np.arange(self.width) + 0.5 - self.cx) / self.fx
        v = (np.arange(self.height) + 0.5 - self.cy) / self.fy
        out = np.ones((self.height, self.width, 3))
        out[..., 0], out[..., 1] = u[None, :], v[:, None]
        return out

    def rays_at(self, pixels: np.ndarray) -> np.ndarray:
        """Return (n, 3) float64 directions with z = 1, camera frame, of (n, 2) pixel positions."""
        out = np.ones((len(pixels), 3))
        out[:, 0] = (pixels[:, 0] - self.cx) / self.fx
        out[:, 1] = (pixels[:, 1] - self.cy) / self.fy
        return out

    def resized(self, width: int, height: int) -> Camera:
        """Return the camera of the same photo resampled to ``width`` x ``height`` pixels."""
        sx, sy = width / self.width, height / self.height
        return dataclasses.replace(
            self, width=int(width), height=int(height), fx=self.fx * sx, fy=self.fy * sy,
            cx=self.cx * sx, cy=self.cy * sy,
        )  # fmt: skip

    def moved(self, new_from_old: Similarity) -> Camera:
        """Return the same camera expressed in another world frame (depths scale along)."""
        rotation = self.rotation @ new_from_old.rotation.T
        pose = pose_at(rotation, new_from_old.points(self.center[None])[0])
        return dataclasses.replace(self, cam_from_world=pose)

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        values = dataclasses.asdict(self)
        values["cam_from_world"] = np.asarray(self.cam_from_world).tolist()
        return values

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Camera:
        """Build from :meth:`to_json`'s values.

        Raises KeyError, TypeError, ValueError: an entry is missing, of another kind, or such as no
        camera has.
        """
        values = dict(values)
        try:
            pose = np.asarray(values.pop("cam_from_world"), np.float64).reshape(3, 4)
            lens = [float(values[name]) for name in ("fx", "fy", "cx", "cy")]
        except OverflowError:
            raise ValueError("a number is too large") from None
        sides = (values["width"], values["height"])
        if not isinstance(values["name"], str) or any(type(side) is not int for side in sides):
            raise TypeError("a camera needs a name and whole numbers as its size")
        if not (np.isfinite(pose).all() and np.isfinite(lens).all()):
            raise ValueError("a number is not finite")
        if min(*sides, *lens[:2]) <= 0 or max(sides) > limits.MAX_IMAGE_SIDE_PX:
            raise ValueError("the size or the focal length is out of range")
        return cls(**values, cam_from_world=pose)
