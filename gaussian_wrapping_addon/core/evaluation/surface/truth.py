# SPDX-License-Identifier: GPL-3.0-or-later
"""Ground truth of a reconstruction: the true surface, its samples and their visibility."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol
from zipfile import BadZipFile

import numpy as np

from ...errors import DatasetError, ParseError
from ...regions.convex_region import Region
from ...regions.region import read_region
from .samples import SurfaceSamples

TRUTH_FILE = "truth.npz"
CROP_FILE = "crop.json"
MIN_CAMERAS = 2
"""A sample counts as visible if this many training cameras see it; fewer give no depth."""

_AGAIN = "Make the scene again."


class CropVolume(Protocol):
    """Volume outside which samples are not evaluated."""

    def inside(self, points: np.ndarray) -> np.ndarray:
        """Return whether (n, 3) points are inside, (n,) bool."""
        ...


@dataclass(frozen=True)
class RegionCrop:
    """The convex body of a region as a crop volume."""

    region: Region

    def inside(self, points: np.ndarray) -> np.ndarray:
        """Return whether (n, 3) points are inside or on the boundary, (n,) bool."""
        return self.region.contains(points)


@dataclass(frozen=True)
class Truth:
    """The true surface, in the frame of the surfaces compared with it.

    Raises
    ------
    DatasetError
        Arrays of different lengths, values that are not finite, or no samples.
    """

    samples: SurfaceSamples
    vertices: np.ndarray | None = None
    """(v, 3) float64, or ``None`` if only a cloud is known."""
    faces: np.ndarray | None = None
    """(f, 3) int."""
    thin: np.ndarray | None = None
    """(n,) bool: the sample lies on a thin structure; ``None`` if not labelled."""
    seen: np.ndarray | None = None
    """(n,) int32: number of training cameras that see the sample, or (n,) bool: visible or not;
    ``None`` if unknown."""
    crop: CropVolume | None = None

    def __post_init__(self) -> None:
        count = len(self.samples)
        if count == 0:
            raise DatasetError("The ground truth has no samples.", _AGAIN)
        if self.samples.points.shape != (count, 3) or self.samples.normals.shape != (count, 3):
            raise DatasetError("The ground truth's points or normals are not (n, 3).", _AGAIN)
        if not (np.isfinite(self.samples.points).all() and np.isfinite(self.samples.normals).all()):
            raise DatasetError("The ground truth has values that are not finite.", _AGAIN)
        for name, values in (("thin", self.thin), ("seen", self.seen)):
            if values is not None and values.shape != (count,):
                raise DatasetError(
                    f"The ground truth has {count} samples, but {name!r} has the shape "
                    f"{values.shape}.",
                    _AGAIN,
                )
        if (self.vertices is None) != (self.faces is None):
            raise DatasetError("The ground truth has vertices or faces, not both.", _AGAIN)

    @property
    def mesh(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Vertices and faces, or ``None`` for a cloud."""
        if self.vertices is None or self.faces is None:
            return None
        return self.vertices, self.faces

    def judged(self) -> np.ndarray:
        """Return whether each sample is inside the crop, (n,) bool."""
        if self.crop is None:
            return np.ones(len(self.samples), np.bool_)
        return self.crop.inside(self.samples.points)

    def visible(self, min_cameras: int = MIN_CAMERAS) -> np.ndarray:
        """Return whether at least ``min_cameras`` see each sample, (n,) bool; true if unknown."""
        if self.seen is None:
            return np.ones(len(self.samples), np.bool_)
        return self.seen if self.seen.dtype == np.bool_ else self.seen >= min_cameras

    def kept(self, mask: np.ndarray) -> Truth:
        """Return the same surface with the samples selected by a (n,) bool mask."""
        return replace(
            self,
            samples=self.samples.kept(mask),
            thin=None if self.thin is None else self.thin[mask],
            seen=None if self.seen is None else self.seen[mask],
        )


def read_truth(folder: Path) -> Truth:
    """Read ``truth.npz`` and ``crop.json`` of a ground-truth scene's folder.

    ``truth.npz`` holds ``vertices`` (v, 3) and ``faces`` (f, 3) of the closed true surface,
    outward, in the world frame of the cameras; ``points`` and unit ``normals`` (n, 3); ``thin``
    (n,) bool; ``seen`` (n,) int32, the number of training cameras that see a sample. ``crop.json``
    is a bounding volume (docs/method.md, section 7.3) in the same frame.

    Raises
    ------
    ParseError
        States the file and the entry that is missing or invalid.
    """
    path = Path(folder) / TRUTH_FILE
    try:
        with np.load(path, allow_pickle=False) as stored:
            entries = {name: stored[name] for name in stored.files}
    except (OSError, ValueError, EOFError, BadZipFile) as error:
        raise ParseError(path, "whole file", f"cannot be read ({error}).", _AGAIN) from None
    shapes = (
        ("vertices", 3, "f"), ("faces", 3, "iu"), ("points", 3, "f"), ("normals", 3, "f"),
        ("thin", 0, "b"), ("seen", 0, "iu"),
    )  # fmt: skip
    for name, width, kinds in shapes:
        if name not in entries:
            raise ParseError(path, name, "is missing.", _AGAIN)
        values = entries[name]
        if values.ndim != (2 if width else 1) or (width and values.shape[1] != width):
            raise ParseError(path, name, f"has the shape {values.shape}.", _AGAIN)
        if values.dtype.kind not in kinds:
            raise ParseError(path, name, f"has the type {values.dtype}.", _AGAIN)
    faces = entries["faces"].astype(np.int64)
    if len(faces) and not (faces.min() >= 0 and faces.max() < len(entries["vertices"])):
        raise ParseError(path, "faces", "refers to vertices that do not exist.", _AGAIN)
    samples = SurfaceSamples(
        entries["points"].astype(np.float64), entries["normals"].astype(np.float64)
    )
    try:
        return Truth(
            samples,
            entries["vertices"].astype(np.float64),
            faces,
            entries["thin"],
            entries["seen"].astype(np.int32),
            RegionCrop(read_region(Path(folder) / CROP_FILE)),
        )
    except ParseError:
        raise
    except DatasetError as error:
        raise ParseError(path, "arrays", error.message, error.hint) from None
