# SPDX-License-Identifier: GPL-3.0-or-later
"""A pinhole camera in the COLMAP convention."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np

from .. import limits
from .similarity import Similarity


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

        Returns
        -------
        pixels : (n, 2) float64
            Pixel coordinates; meaningless where ``depth <= 0``.
        depth : (n,) float64
            z-depth, world units.
        """
        local = self.to_camera(points)
        depth = local[:, 2]
        safe = np.where(np.abs(depth) > 1e-300, depth, 1e-300)
        pixels = np.stack(
            [self.fx * local[:, 0] / safe + self.cx, self.fy * local[:, 1] / safe + self.cy], 1
        )
        return pixels, depth

    def shown(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Look (n, 3) world points up in the image.

        Returns
        -------
        indices : (m,) int64
            Of the points that project into the image.
        row, column : (m,) int64
            Their pixels.
        depth : (m,) float64
            Their z-depths, > 0, world units.
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
        out[..., 0] = u[None, :]
        out[..., 1] = v[:, None]
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
            self,
            width=int(width),
            height=int(height),
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=self.cx * sx,
            cy=self.cy * sy,
        )

    def moved(self, new_from_old: Similarity) -> Camera:
        """Return the same camera expressed in another world frame (depths scale along)."""
        rotation = self.rotation @ new_from_old.rotation.T
        center = new_from_old.points(self.center[None])[0]
        pose = np.concatenate([rotation, -(rotation @ center)[:, None]], 1)
        return dataclasses.replace(self, cam_from_world=pose)

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        values = dataclasses.asdict(self)
        values["cam_from_world"] = np.asarray(self.cam_from_world).tolist()
        return values

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Camera:
        """Build from :meth:`to_json`'s values.

        Raises
        ------
        KeyError, TypeError, ValueError
            An entry is missing, of another kind, or such as no camera has.
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
