# SPDX-License-Identifier: GPL-3.0-or-later
"""Read, align and score scans of the DTU data set in their original layout."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DatasetError, ParseError
from ..scene.camera import Camera, Similarity
from ..scene.placement import umeyama
from .dtu_chamfer import DENSITY_MM, PATCH_MM, DtuScore, ObservationMask, dtu_chamfer, resample_mesh
from .layouts import read_cloud

MAX_MISFIT_SHARE = 0.05
"""Maximum root mean square distance of aligned centres from the true ones, as a share of the
cameras' spread; wrongly paired cameras have about the full spread."""
NUMBER_OFFSETS = (0, 1, -1)
"""Photo names and camera files count from 0 or from 1: the offset that fits best is used."""

_CAMERA_FOLDERS = ("", "scan{scan}", "dtu_scan{scan}")
_ARCHIVES = ("cameras.npz", "cameras_sphere.npz")


@dataclass(frozen=True)
class DtuScan:
    """Ground truth of one scan, millimetres."""

    scan: int
    cloud: np.ndarray  # (n, 3) float64
    mask: ObservationMask
    plane: np.ndarray  # (4,) ground plane; true points with ``plane . [x, 1] > 0`` are evaluated.
    camera_numbers: np.ndarray  # (m,) int64; empty if no camera files were found.
    camera_centers: np.ndarray  # (m, 3) float64
    camera_source: str  # name of the file or folder of the cameras


@dataclass(frozen=True)
class DtuAlignment:
    """Alignment of the job's cameras to the true ones."""

    transform: Similarity  # ``truth_from_job``
    cameras: int
    number_offset: int
    """Number in the camera files minus the number in the photo's name."""
    rmse_mm: float

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {**vars(self), "transform": self.transform.to_json()}


def _bad(path: Path, place: str, problem: str) -> ParseError:
    return ParseError(path, place, problem, "Use the file that belongs to the data set.")


def is_dtu_folder(folder: Path) -> bool:
    """Return whether the folder holds the data set's ``Points`` or ``ObsMask``."""
    return any((root / n).is_dir() for root in _roots(folder) for n in ("Points/stl", "ObsMask"))


def _roots(folder: Path) -> list[Path]:
    return [folder, folder / "MVS Data", folder / "SampleSet" / "MVS Data"]


def _find(folder: Path, name: str) -> Path:
    for root in _roots(folder):
        if (root / name).is_file():
            return root / name
    raise DatasetError(
        f"{folder.name} holds no {name}.",
        "Required: Points/stl/stl024_total.ply, ObsMask/ObsMask24_10.mat and ObsMask/Plane24.mat "
        "(for scan 24).",
    )


def read_dtu(folder: Path, scan: int) -> DtuScan:
    """Read one scan.

    Raises
    ------
    DatasetError
        A file is missing.
    ParseError
        States the file and the entry that is missing or invalid.
    """
    if not folder.is_dir():
        raise DatasetError(f"{folder} is not a folder.", "Give the folder of the data set.")
    cloud_path = _find(folder, f"Points/stl/stl{scan:03}_total.ply")
    mask = read_observation_mask(_find(folder, f"ObsMask/ObsMask{scan}_10.mat"))
    plane = read_plane(_find(folder, f"ObsMask/Plane{scan}.mat"))
    numbers, centers, source = _read_cameras(folder, scan)
    return DtuScan(scan, read_cloud(cloud_path), mask, plane, numbers, centers, source)


def read_observation_mask(path: Path) -> ObservationMask:
    """Read ``ObsMask`` (volume), ``BB`` (2x3) and ``Res`` of a MATLAB file.

    Raises
    ------
    ParseError
    """
    values = _read_mat(path, ("ObsMask", "BB", "Res"))
    volume = values["ObsMask"]
    if volume.ndim != 3 or volume.dtype.kind not in "bui" or volume.size == 0:
        raise _bad(path, "ObsMask", f"{volume.dtype} {volume.shape} is not a volume.")
    box = _floats(path, "BB", values["BB"], (2, 3))
    resolution = float(_floats(path, "Res", values["Res"].reshape(-1), (1,))[0])
    if not (box[1] > box[0]).all():
        raise _bad(path, "BB", "the box is empty.")
    if not resolution > 0:
        raise _bad(path, "Res", f"{resolution:g} is not positive.")
    return ObservationMask(volume != 0, box[0], box[1], resolution)


def read_plane(path: Path) -> np.ndarray:
    """Read the ground plane ``P``, (4,), of a MATLAB file.

    Raises
    ------
    ParseError
    """
    plane = _floats(path, "P", _read_mat(path, ("P",))["P"].reshape(-1), (4,))
    if not plane[:3].any():
        raise _bad(path, "P", "the plane has no direction.")
    return plane


def _read_mat(path: Path, keys: tuple[str, ...]) -> dict[str, np.ndarray]:
    from scipy.io import loadmat

    try:
        values = loadmat(path, variable_names=keys)
    except Exception as error:  # a broken file can make the reader raise anything
        text = f"cannot be read as a MATLAB file up to version 7.2 ({error})."
        raise _bad(path, "whole file", text) from None
    for key in keys:
        if not isinstance(values.get(key), np.ndarray):
            raise _bad(path, key, "there is no such entry.")
    return {key: values[key] for key in keys}


def _floats(path: Path, place: str, value: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    if value.shape != shape or value.dtype.kind not in "fiub":
        raise _bad(path, place, f"{value.shape} is not {shape} numbers.")
    values = value.astype(np.float64)
    if not np.isfinite(values).all():
        raise _bad(path, place, "a number is not finite.")
    return values


def _read_cameras(folder: Path, scan: int) -> tuple[np.ndarray, np.ndarray, str]:
    for place in _CAMERA_FOLDERS:
        for name in _ARCHIVES:
            path = folder / place.format(scan=scan) / name
            if path.is_file():
                return (*_archive_centers(path), path.name)
    for root in _roots(folder):
        texts = sorted((root / "Calibration" / "cal18").glob("pos_*.txt"))
        if texts:
            return (*_text_centers(texts), "Calibration/cal18")
    return np.zeros(0, np.int64), np.zeros((0, 3)), ""


def _archive_centers(path: Path) -> tuple[np.ndarray, np.ndarray]:
    numbers, centers = [], []
    try:
        with np.load(path, allow_pickle=False) as arrays:
            for key in arrays.files:
                found = re.fullmatch(r"world_mat_(\d{1,6})", key)
                if found:
                    matrix = _floats(path, key, arrays[key], (4, 4))
                    numbers.append(int(found.group(1)))
                    centers.append(_center(path, key, matrix[:3]))
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise _bad(path, "whole file", f"cannot be read ({error}).") from None
    if not numbers:
        raise _bad(path, "world_mat_0", "there is no such entry.")
    return np.array(numbers, np.int64), np.array(centers)


def _text_centers(paths: list[Path]) -> tuple[np.ndarray, np.ndarray]:
    numbers, centers = [], []
    for path in paths:
        digits = re.fullmatch(r"pos_(\d{1,6})", path.stem)
        if digits is None:
            continue
        try:
            words = path.read_bytes().decode(errors="replace").split()
            values = np.array([float(word) for word in words])
        except (OSError, ValueError) as error:
            raise _bad(path, "whole file", f"{error}.") from None
        if len(values) != 12 or not np.isfinite(values).all():
            text = f"12 finite numbers (3x4) were expected, not {len(values)}."
            raise _bad(path, "whole file", text)
        numbers.append(int(digits.group(1)))
        centers.append(_center(path, "whole file", values.reshape(3, 4)))
    return np.array(numbers, np.int64), np.array(centers).reshape(-1, 3)


def _center(path: Path, place: str, projection: np.ndarray) -> np.ndarray:
    """Return the centre of a (3, 4) projection, its null space."""
    linear = projection[:, :3]
    if not np.linalg.cond(linear) < 1e12:
        raise _bad(path, place, "the projection has no centre.")
    return -np.linalg.solve(linear, projection[:, 3])


def align_to_scan(cameras: Sequence[Camera], truth: DtuScan) -> DtuAlignment:
    """Return ``truth_from_job`` from the camera centres (Umeyama, with scale).

    The first number in a photo's name (``rect_001_3_r5000.png``, ``000000.png``) is that of its
    camera file; whether it counts from 0 or 1 is decided by the better fit.

    Raises
    ------
    DatasetError
        No camera files, names without numbers, fewer than three matches, or no pairing that fits.
    """
    if not len(truth.camera_numbers):
        raise DatasetError(
            f"No true cameras of scan {truth.scan} were found.",
            "Add Calibration/cal18/pos_*.txt or cameras.npz, or place the mesh yourself and use "
            "--align none.",
        )
    row_of = {int(number): row for row, number in enumerate(truth.camera_numbers)}
    numbers = []
    for camera in cameras:
        digits = re.findall(r"\d+", Path(camera.name).stem)
        if not digits:
            raise DatasetError(
                f"The photo {camera.name!r} has no number.", "Keep the data set's photo names."
            )
        numbers.append(int(digits[0]))
    centers = np.array([camera.center for camera in cameras]).reshape(-1, 3)
    best: DtuAlignment | None = None
    matched = 0
    for offset in NUMBER_OFFSETS:
        rows = np.array([row_of.get(n + offset, -1) for n in numbers], np.int64)
        known = rows >= 0
        matched = max(matched, int(known.sum()))
        # Every photo must have a camera under the right offset.
        if known.sum() < 3 or not known.all():
            continue
        true = truth.camera_centers[rows]
        fit = umeyama(centers, true, with_scale=True)
        rmse = float(np.sqrt(((fit.points(centers) - true) ** 2).sum(1).mean()))
        if best is None or rmse < best.rmse_mm:
            best = DtuAlignment(fit, len(rows), offset, rmse)
    if best is None:
        raise DatasetError(
            f"{matched} of {len(cameras)} photos have a camera in {truth.camera_source}.",
            "Keep the data set's photo names; at least 3 photos are needed.",
        )
    true_spread = truth.camera_centers - truth.camera_centers.mean(0)
    spread = float(np.sqrt((true_spread**2).sum(1).mean()))
    if best.rmse_mm > MAX_MISFIT_SHARE * spread:
        raise DatasetError(
            f"The cameras are off those of {truth.camera_source} by {best.rmse_mm:.3g} mm (RMS).",
            "Photos and cameras do not match, or the cameras were solved wrongly.",
        )
    return best


def score_dtu(
    vertices: np.ndarray, faces: np.ndarray, truth: DtuScan, truth_from_job: Similarity, *,
    seed: int = 0, threads: int = 1,
) -> DtuScore:  # fmt: skip
    """Align a mesh, resample it as points, and compare (see :func:`~.dtu_chamfer.dtu_chamfer`).

    Faces farther than the patch from the observed box are left out, as they would not count.

    Raises
    ------
    UsageError, MeshingError, ResourceError
        See :mod:`~.dtu_chamfer`.
    """
    placed = truth_from_job.points(vertices)
    corners = placed[faces]  # (f, 3, 3)
    near = (corners.max(1) >= truth.mask.low - PATCH_MM) & (
        corners.min(1) <= truth.mask.high + PATCH_MM
    )
    points = resample_mesh(placed, faces[near.all(1)], DENSITY_MM)
    return dtu_chamfer(points, truth.cloud, truth.mask, truth.plane, seed=seed, threads=threads)
