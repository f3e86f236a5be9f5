# SPDX-License-Identifier: GPL-3.0-or-later
"""Posed photos as described by an input: lens models, poses and sparse points."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from .. import limits
from ..progress import ReportWarning

LENS_PARAMETERS: dict[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "FOV": ("fx", "fy", "cx", "cy", "omega"),
    "SIMPLE_RADIAL_FISHEYE": ("f", "cx", "cy", "k"),
    "RADIAL_FISHEYE": ("f", "cx", "cy", "k1", "k2"),
    "THIN_PRISM_FISHEYE": (
        "fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1",
    ),
    "RAD_TAN_THIN_PRISM_FISHEYE": (
        "fx", "fy", "cx", "cy", "k0", "k1", "k2", "k3", "k4", "k5", "p0", "p1", "s0", "s1", "s2",
        "s3",
    ),
    "SIMPLE_DIVISION": ("f", "cx", "cy", "k"),
    "DIVISION": ("fx", "fy", "cx", "cy", "k"),
    "SIMPLE_FISHEYE": ("f", "cx", "cy"),
    "FISHEYE": ("fx", "fy", "cx", "cy"),
    "EUCM": ("fx", "fy", "cx", "cy", "alpha", "beta"),
}  # fmt: skip
"""COLMAP's lens models in the order of their numbers, then our own."""

LENS_NAMES = tuple(LENS_PARAMETERS)
"""COLMAP's lens models: what its files may name."""

SKEWED_BROWN = "SKEWED_BROWN"
"""Brown's polynomial with a fourth radial coefficient and skew, which COLMAP has no model for."""
LENS_PARAMETERS[SKEWED_BROWN] = (
    "fx", "fy", "cx", "cy", "skew", "k1", "k2", "k3", "k4", "p1", "p2",
)  # fmt: skip

PANORAMA = "EQUIRECTANGULAR"
"""What panoramas are called among lens models; no :class:`LensCamera` has it."""

COLMAP, TRANSFORMS, PHOTOS = "COLMAP model", "transforms.json", "photos"
"""Kinds of inputs; others are named after the program that wrote the cameras."""


def counts_stored_pixels(kind: str) -> bool:
    """Whether the cameras of a kind of input are of the photos as stored.

    COLMAP and photogrammetry programs read pixels as stored; for the frames of a transforms.json
    and where cameras are solved here, the EXIF orientation is applied first.
    """
    return kind not in (TRANSFORMS, PHOTOS)


_FOCAL_SHARE = (1e-3, 1e3)
"""Focal length over the photo's long side: 0.001 is a 179.9 degree lens, 1000 a telescope."""
_PRINCIPAL_POINT_SIDES = 10.0
"""A principal point further out than this many photo sides is a broken file."""
_MAX_DISTORTION = 1e3


@dataclass(frozen=True)
class LensCamera:
    """A camera with its lens model, as written in the input (COLMAP names and order)."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    @property
    def focal(self) -> tuple[float, float]:
        """``(fx, fy)`` in pixels."""
        names = LENS_PARAMETERS[self.model]
        return (self.params[0], self.params[1] if names[1] == "fy" else self.params[0])

    @property
    def principal_point(self) -> tuple[float, float]:
        """``(cx, cy)`` in pixels, first pixel's centre at (0.5, 0.5)."""
        at = LENS_PARAMETERS[self.model].index("cx")
        return (self.params[at], self.params[at + 1])

    @property
    def distortion(self) -> tuple[float, ...]:
        """Every parameter after the principal point."""
        return self.params[LENS_PARAMETERS[self.model].index("cy") + 1 :]

    @property
    def is_pinhole(self) -> bool:
        """Whether straight lines stay straight, so that the photo can be used as it is."""
        if self.model in ("SIMPLE_PINHOLE", "PINHOLE"):
            return True
        polynomial = "FISHEYE" not in self.model and self.model not in ("FOV", "EUCM")
        return polynomial and not any(self.distortion)

    def problem(self) -> str:
        """Return what makes this camera unusable, or an empty text."""
        if self.model not in LENS_PARAMETERS:
            return f"camera model {self.model} is not supported"
        wanted = len(LENS_PARAMETERS[self.model])
        if len(self.params) != wanted:
            return f"{self.model} has {wanted} parameters, not {len(self.params)}"
        side = limits.MAX_IMAGE_SIDE_PX
        if not (0 < self.width <= side and 0 < self.height <= side):
            return f"image size {self.width} x {self.height} is out of range"
        if self.width * self.height > limits.MAX_IMAGE_PIXELS:
            return f"image size {self.width} x {self.height} has too many pixels"
        if not all(math.isfinite(p) for p in self.params):
            return "a parameter is not a finite number"
        longest = max(self.width, self.height)
        low, high = _FOCAL_SHARE[0] * longest, _FOCAL_SHARE[1] * longest
        if not all(low <= f <= high for f in self.focal):
            return f"focal length {self.focal[0]:g} x {self.focal[1]:g} px is out of range"
        if any(abs(c) > _PRINCIPAL_POINT_SIDES * longest for c in self.principal_point):
            return "the principal point lies far outside the image"
        if any(abs(p) > _MAX_DISTORTION for p in self.distortion):
            return "a distortion parameter is out of range"
        return ""

    def resized(self, width: int, height: int) -> LensCamera:
        """Return the camera of the same photo resampled to ``width`` x ``height`` pixels."""
        sx, sy = width / self.width, height / self.height
        model, params = self.model, list(self.params)
        if LENS_PARAMETERS[model][1] != "fy" and not math.isclose(sx, sy, rel_tol=1e-12):
            model, params = _with_two_focal_lengths(self)
        names = LENS_PARAMETERS[model]
        at = names.index("cx")
        params[0] *= sx
        if names[1] == "fy":
            params[1] *= sy
        params[at] *= sx
        params[at + 1] *= sy
        if "skew" in names:
            params[names.index("skew")] *= sx
        return LensCamera(model, int(width), int(height), tuple(params))


def _with_two_focal_lengths(camera: LensCamera) -> tuple[str, list[float]]:
    """Rewrite a one-focal-length model as the model that can be stretched, where there is one."""
    f, cx, cy, *k = camera.params
    k = [*k, 0.0, 0.0, 0.0, 0.0]
    return {
        "SIMPLE_PINHOLE": ("PINHOLE", [f, f, cx, cy]),
        "SIMPLE_RADIAL": ("OPENCV", [f, f, cx, cy, k[0], 0.0, 0.0, 0.0]),
        "RADIAL": ("OPENCV", [f, f, cx, cy, k[0], k[1], 0.0, 0.0]),
        "SIMPLE_RADIAL_FISHEYE": ("OPENCV_FISHEYE", [f, f, cx, cy, k[0], 0.0, 0.0, 0.0]),
        "RADIAL_FISHEYE": ("OPENCV_FISHEYE", [f, f, cx, cy, k[0], k[1], 0.0, 0.0]),
        "SIMPLE_DIVISION": ("DIVISION", [f, f, cx, cy, k[0]]),
        "SIMPLE_FISHEYE": ("FISHEYE", [f, f, cx, cy]),
    }[camera.model]


@dataclass(frozen=True)
class Brown:
    """Brown's polynomial distortion, from ray to pixel, and skew; tangential terms as of OpenCV."""

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    skew: float = 0.0
    """What y adds to the pixel's x, in the unit of the focal length."""

    def lens(
        self, width: int, height: int, focal: tuple[float, float], center: tuple[float, float]
    ) -> LensCamera:
        """Return the simplest model that holds all of it exactly."""
        four = (self.k1, self.k2, self.p1, self.p2)
        model = "PINHOLE"
        terms: tuple[float, ...] = ()
        if self.skew or self.k4:
            model = SKEWED_BROWN
            terms = (self.skew, self.k1, self.k2, self.k3, self.k4, self.p1, self.p2)
        elif self.k3:
            model, terms = "FULL_OPENCV", (*four, self.k3, 0.0, 0.0, 0.0)
        elif any(four):
            model, terms = "OPENCV", four
        return LensCamera(model, width, height, (*focal, *center, *terms))


@dataclass(frozen=True)
class RelativeLens:
    """A lens in shares of the photo's long side, for inputs that state no photo size."""

    focal: float
    aspect: float
    """Vertical over horizontal focal length."""
    offset: tuple[float, float]
    """Principal point, from the photo's middle."""
    brown: Brown

    def of_size(self, width: int, height: int) -> LensCamera:
        """Return the lens of a photo of ``width`` x ``height`` pixels."""
        side = max(width, height)
        fx = self.focal * side
        center = 0.5 * width + self.offset[0] * side, 0.5 * height + self.offset[1] * side
        brown = replace(self.brown, skew=self.brown.skew * side)
        return brown.lens(width, height, (fx, fx * self.aspect), center)


@dataclass(frozen=True)
class PosedPhoto:
    """One photo of the input: its name there, its lens, its pose."""

    name: str
    lens: LensCamera | None
    """``None`` if the photo's size is needed to complete the intrinsics (``angle_x`` or
    ``relative`` is set), and of panoramas."""
    cam_from_world: np.ndarray
    """(3, 4) float64, COLMAP axes (x right, y down, z forward)."""
    mask_name: str | None = None
    angle_x: float | None = None
    """Horizontal field of view in radians, if the input gives nothing else."""
    mask_path: Path | None = None
    """Mask made while the cameras were solved, of the upright photo's size."""
    observed: int | None = None
    """Sparse points that were found in it, where the input tells."""
    relative: RelativeLens | None = None
    """Intrinsics of a photo of any size."""

    @property
    def is_panorama(self) -> bool:
        """Whether the photo is equirectangular: it has no lens, and is cut into views."""
        return self.lens is None and self.angle_x is None and self.relative is None


@dataclass(frozen=True)
class SourceModel:
    """Cameras and points of an input, world frame, float64."""

    kind: str
    """:data:`COLMAP`, :data:`TRANSFORMS`, :data:`PHOTOS`, or the name of a program."""
    photos: tuple[PosedPhoto, ...]
    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    """(n, 3) float64."""
    point_colors: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.uint8))
    """(n, 3) uint8."""
    warnings: tuple[ReportWarning, ...] = ()
    facts: dict[str, Any] = field(default_factory=dict)
