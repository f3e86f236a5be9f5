# SPDX-License-Identifier: GPL-3.0-or-later
"""Read, align and score scenes of Tanks and Temples in their original layout.

See docs/method.md, section 9.1.

A folder holds ``<Scene>.ply`` (the scanned cloud), ``<Scene>.json`` (crop volume),
``<Scene>_trans.txt`` (4x4, truth from the log's frame) and ``<Scene>_COLMAP_SfM.log`` (for every
photo a line ``i i 0`` and a 4x4 matrix, world from camera).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ... import limits
from ...dataset.camera import Camera
from ...dataset.frames.similarity_fit import RansacResult, umeyama_ransac
from ...dataset.similarity import Similarity
from ...errors import DatasetError, ParseError, UsageError
from ...progress import Progress
from ..alignment.similarity_alignment import refine_as_tanks
from ..surface.samples import (
    sample_legacy,
    sample_uniformly,
    scan_virtually,
    voxel_downsample_points,
)
from ..surface.scores import score_clouds
from .mesh_input import read_cloud
from .polygon_volume import PolygonVolume, read_polygon_volume

THRESHOLDS = {
    "barn": 0.01, "caterpillar": 0.005, "courthouse": 0.025, "ignatius": 0.003,
    "meetingroom": 0.01, "truck": 0.005,
}  # fmt: skip
"""Distance threshold by scene (docs/method.md, section 9.1)."""
RANSAC_DISTANCE = 0.2
RANSAC_ITERATIONS = 100_000
MIN_AGREEING_SHARE = 0.5
"""With a smaller share of cameras on the reference trajectory, photos were paired wrongly."""
SAMPLES = 10_000_000
ALIGNMENT_SAMPLES = 1_000_000
SCAN_KEPT_POINTS = 20_000_000
"""Scanned points are downsampled together whenever there are more than this."""

_TRUTH_SUFFIX, _LOG_SUFFIX = "_trans.txt", "_COLMAP_SfM.log"
_ROTATION_TOLERANCE = 1e-2
_AGAIN = "Use the file that belongs to the data set."


@dataclass(frozen=True)
class TanksScene:
    """Ground truth of one scene, in the frame of the scanned cloud."""

    name: str
    threshold: float
    cloud: np.ndarray
    """(n, 3) float64."""
    crop: PolygonVolume
    log_numbers: np.ndarray
    """(m,) int64, photo number of each entry of the trajectory."""
    log_centers: np.ndarray
    """(m, 3) camera centres of the trajectory, transformed by ``_trans.txt``."""


def is_tanks_folder(folder: Path) -> bool:
    """Return whether the folder holds a trajectory or an alignment matrix of the data set."""
    return any(any(folder.glob(f"*{suffix}")) for suffix in (_TRUTH_SUFFIX, _LOG_SUFFIX))


def read_tanks(folder: Path, threshold: float | None = None) -> TanksScene:
    """Read a scene.

    Parameters
    ----------
    folder : Path
        Must have the name of the scene if it holds the files of several.
    threshold : float or None
        Replaces that of :data:`THRESHOLDS`.

    Raises
    ------
    ParseError
        States the file and the location in it.
    DatasetError
        A file is missing, or the scene is ambiguous.
    UsageError
        The scene has no known threshold and none was given.
    """
    name = _scene_name(folder)
    paths = {s: folder / f"{name}{s}" for s in (".ply", ".json", _TRUTH_SUFFIX, _LOG_SUFFIX)}
    for path in paths.values():
        if not path.is_file():
            raise DatasetError(
                f"{folder.name} holds no {path.name}.",
                "A scene of Tanks and Temples needs NAME.ply, NAME.json, NAME_trans.txt and "
                "NAME_COLMAP_SfM.log.",
            )
    if threshold is None:
        threshold = THRESHOLDS.get(name.lower(), THRESHOLDS.get(folder.name.lower()))
    if threshold is None:
        raise UsageError(
            f"No threshold is known for the scene {name}.",
            f"Give --distances; known are {', '.join(n.capitalize() for n in THRESHOLDS)}.",
        )
    crop = read_polygon_volume(paths[".json"])
    truth_from_log = read_matrix(paths[_TRUTH_SUFFIX])
    numbers, world_from_camera = read_trajectory(paths[_LOG_SUFFIX])
    centers = truth_from_log.points(world_from_camera[:, :3, 3])
    return TanksScene(name, threshold, read_cloud(paths[".ply"]), crop, numbers, centers)


def _scene_name(folder: Path) -> str:
    if not folder.is_dir():
        raise DatasetError(f"{folder} is not a folder.", "Give the folder of one scene.")
    names = sorted(
        {
            path.name.removesuffix(suffix)
            for suffix in (_TRUTH_SUFFIX, _LOG_SUFFIX)
            for path in folder.glob(f"*{suffix}")
        }
    )
    same = [name for name in names if name.lower() == folder.name.lower()]
    if len(names) == 1 or len(same) == 1:
        return (same or names)[0]
    if not names:
        return folder.name
    raise DatasetError(
        f"{folder.name} holds the scenes {', '.join(names)}.",
        "Put each into a folder of its name.",
    )


def read_matrix(path: Path) -> Similarity:
    """Read a 4x4 similarity in plain text.

    Raises
    ------
    ParseError
        Not 4x4 finite numbers, or not rotation, scale and translation.
    """
    rows = [line.split() for _, line in _lines(path) if line.strip()]
    if len(rows) != 4 or any(len(row) != 4 for row in rows):
        shape = f"{len(rows)} lines of {sorted({len(r) for r in rows})} numbers"
        raise ParseError(path, "whole file", f"a 4x4 matrix was expected, not {shape}.", _AGAIN)
    return _similarity(path, "whole file", _numbers(path, "whole file", rows))


def read_trajectory(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read a trajectory log.

    Returns
    -------
    numbers : (m,) int64
        First number of each entry's line ``i i 0``: index of the photo in sorted order, from 0.
    world_from_camera : (m, 4, 4) float64

    Raises
    ------
    ParseError
        With the line: truncated, not numbers, or not a pose.
    """
    lines = [(number, line.split()) for number, line in _lines(path) if line.strip()]
    if len(lines) < 15 or len(lines) % 5:
        raise ParseError(
            path, f"line {lines[-1][0] if lines else 1}",
            f"{len(lines)} lines are not at least 3 entries of 5; the file may be cut off.", _AGAIN,
        )  # fmt: skip
    numbers, poses = [], []
    for begin in range(0, len(lines), 5):
        line, words = lines[begin]
        place = f"line {line}"
        if len(words) != 3 or not words[0].isdecimal() or len(words[0]) > 9:
            raise ParseError(path, place, "three whole numbers were expected.", _AGAIN)
        rows = [row for _, row in lines[begin + 1 : begin + 5]]
        if any(len(row) != 4 for row in rows):
            raise ParseError(path, place, "four rows of four numbers must follow.", _AGAIN)
        matrix = _numbers(path, place, rows)
        _similarity(path, place, matrix)
        numbers.append(int(words[0]))
        poses.append(matrix)
    if len(set(numbers)) != len(numbers):
        raise ParseError(path, "whole file", "a photo has two poses.", _AGAIN)
    return np.array(numbers, np.int64), np.array(poses)


def _lines(path: Path) -> list[tuple[int, str]]:
    try:
        size_bytes = path.stat().st_size
        if size_bytes > limits.MAX_JSON_BYTES:
            raise ParseError(path, "whole file", f"{size_bytes} bytes are too many.", _AGAIN)
        text = path.read_bytes().decode("utf-8-sig", errors="replace")
    except OSError as error:
        raise ParseError(path, "whole file", f"cannot be read: {error.strerror}.", _AGAIN) from None
    return list(enumerate(text.splitlines(), 1))


def _numbers(path: Path, place: str, rows: list[list[str]]) -> np.ndarray:
    try:
        values = np.array([[float(word) for word in row] for row in rows])
    except ValueError as error:
        raise ParseError(path, place, f"{error}.", _AGAIN) from None
    if not np.isfinite(values).all():
        raise ParseError(path, place, "a number is not finite.", _AGAIN)
    return values


def _similarity(path: Path, place: str, matrix: np.ndarray) -> Similarity:
    linear = matrix[:3, :3]
    determinant = float(np.linalg.det(linear))
    if not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-6):
        raise ParseError(path, place, "the last row must be 0 0 0 1.", _AGAIN)
    if not determinant > 0:
        raise ParseError(path, place, "the matrix mirrors or flattens.", _AGAIN)
    scale = determinant ** (1.0 / 3.0)
    u, _, vt = np.linalg.svd(linear / scale)
    if np.abs(u @ vt - linear / scale).max() > _ROTATION_TOLERANCE:
        raise ParseError(path, place, "not a rotation with a scale.", _AGAIN)
    return Similarity(scale, u @ vt, matrix[:3, 3])


def photo_numbers(names: Sequence[str], log_numbers: np.ndarray) -> np.ndarray:
    """Return the row of the trajectory for each photo, -1 if it is missing.

    The trajectory counts the photos in sorted order of their names, from 0. If there are as many
    photos as entries, the sorted names are the entries in order. Otherwise (a job with fewer
    photos) the last number in the name is used: the data set names its photos 000001.jpg and on,
    so entry i is photo i + 1.

    Raises
    ------
    DatasetError
        A name without a number where one is needed.
    """
    row_of = {int(number): row for row, number in enumerate(log_numbers)}
    if len(names) == len(log_numbers):
        order = np.argsort(np.array(names))
        rows = np.empty(len(names), np.int64)
        rows[order] = np.argsort(log_numbers)
        return rows
    rows = np.full(len(names), -1)
    for i, name in enumerate(names):
        digits = re.findall(r"\d+", Path(name).stem)
        if not digits:
            raise DatasetError(
                f"The photo {name!r} has no number, and {len(names)} photos are not the "
                f"{len(log_numbers)} of the trajectory.",
                "Keep the data set's photo names.",
            )
        rows[i] = row_of.get(int(digits[-1]) - 1, -1)
    return rows


def align_to_log(cameras: Sequence[Camera], scene: TanksScene, *, seed: int) -> RansacResult:
    """Return ``truth_from_job`` from the camera centres by RANSAC, with scale.

    See docs/method.md, section 9.1.

    Raises
    ------
    DatasetError
        Fewer than three photos are in the trajectory, their centres are degenerate, or fewer than
        half of them are inliers of one similarity.
    """
    rows = photo_numbers([camera.name for camera in cameras], scene.log_numbers)
    known = np.flatnonzero(rows >= 0)
    if len(known) < 3:
        raise DatasetError(
            f"{len(known)} of {len(cameras)} photos are in the trajectory of {scene.name}.",
            "Keep the data set's photo names (000001.jpg and on).",
        )
    centers = np.array([cameras[i].center for i in known])
    found = umeyama_ransac(
        centers,
        scene.log_centers[rows[known]],
        threshold=RANSAC_DISTANCE,
        iterations=RANSAC_ITERATIONS,
        seed=seed,
        with_scale=True,
    )
    if found.inliers.mean() < MIN_AGREEING_SHARE:
        raise DatasetError(
            f"{int(found.inliers.sum())} of {len(known)} cameras match the trajectory of "
            f"{scene.name} within {RANSAC_DISTANCE:g}.",
            "Photos and trajectory do not match, or the cameras were solved wrongly.",
        )
    return found


def score_tanks(
    vertices: np.ndarray,
    faces: np.ndarray,
    cameras: Sequence[Camera],
    scene: TanksScene,
    start: Similarity,
    *,
    refine: bool,
    protocols: Sequence[str],
    samples: int = SAMPLES,
    seed: int = 0,
    threads: int = 1,
    progress: Progress | None = None,
) -> dict[str, dict[str, Any]]:
    """Score a mesh by the data set's protocol: sampling, refinement, crop, voxel tau / 2, F1.

    ``uniform`` samples uniformly (1e6 samples, or ``samples`` if that is less, for the refinement);
    samples outside the crop are dropped individually, so faces need no cropping. ``scan`` uses the
    surface seen by the cameras, downsampled to voxels of tau / 4. ``legacy`` uses vertices and
    face centres. Each is refined separately, as in the original scripts.

    Parameters
    ----------
    vertices, faces : (v, 3), (f, 3)
        In the job's frame, like the cameras.
    start : Similarity
        ``truth_from_job`` before the refinement.

    Returns
    -------
    dict
        For each protocol ``score``, ``transform``, ``refinement`` (or ``None``); plain JSON values.

    Raises
    ------
    UsageError
        Unknown protocol, or a scan without cameras.
    DatasetError
        The refinement finds no correspondences, or the crop holds no truth.
    """
    progress = progress or Progress()
    truth = scene.cloud[scene.crop.inside(scene.cloud)]
    if len(truth) == 0:
        raise DatasetError(
            f"The crop of {scene.name} holds no point of its cloud.",
            "Crop and cloud may belong to different scenes.",
        )
    results: dict[str, dict[str, Any]] = {}
    for index, protocol in enumerate(protocols):
        progress.update(index / len(protocols), f"{protocol}: refining the alignment")
        transform, refinement = start, None
        near = _near_faces(vertices, faces, scene, start, reach=80.0 if refine else 0.0)
        points = np.zeros((0, 3))
        if protocol == "scan":
            points = _scan(vertices, faces, cameras, scene, start, threads, progress)
        elif protocol == "legacy":
            points = sample_legacy(vertices, near).points if len(near) else points
        elif protocol != "uniform":
            raise UsageError(f"Protocol {protocol!r} is unknown.", "Use uniform, scan or legacy.")
        if refine:
            probe = points
            if protocol == "uniform" and len(near):
                probe = sample_uniformly(
                    vertices, near, min(samples, ALIGNMENT_SAMPLES), seed=seed
                ).points
            refinement = refine_as_tanks(
                probe, truth, start, scene.threshold, inside=scene.crop.inside, threads=threads
            )
            transform = refinement.transform
        progress.update((index + 0.5) / len(protocols), f"{protocol}: measuring distances")
        if protocol == "uniform":
            near = _near_faces(vertices, faces, scene, transform, reach=0.0)
            if len(near):
                points = sample_uniformly(vertices, near, samples, seed=seed + 1).points
        placed = transform.points(points)
        placed = placed[scene.crop.inside(placed)]
        score = score_clouds(
            placed, truth, scene.threshold, voxel=scene.threshold / 2, threads=threads
        )
        results[protocol] = {
            "score": score.to_json(),
            "points_in_crop": len(placed),
            "transform": transform.to_json(),
            "refinement": None if refinement is None else refinement.to_json(),
        }
    return results


def _near_faces(
    vertices: np.ndarray, faces: np.ndarray, scene: TanksScene, start: Similarity, *, reach: float
) -> np.ndarray:
    """Return the faces whose box intersects the crop's, widened by ``reach`` thresholds."""
    low, high = scene.crop.bounds()
    margin = reach * scene.threshold
    corners = start.points(vertices)[faces]  # (f, 3, 3)
    touches = (corners.max(1) >= low - margin) & (corners.min(1) <= high + margin)
    return faces[touches.all(1)]


def _scan(
    vertices: np.ndarray,
    faces: np.ndarray,
    cameras: Sequence[Camera],
    scene: TanksScene,
    start: Similarity,
    threads: int,
    progress: Progress,
) -> np.ndarray:
    """Return the points that cameras see in the (widened) crop, downsampled to tau / 4."""
    if not cameras:
        raise UsageError(
            "A virtual scan needs cameras.",
            "Evaluate a job folder, give --cameras, or omit the scan.",
        )
    voxel = scene.threshold / 4
    low, high = scene.crop.bounds()
    margin = 80.0 * scene.threshold
    back = start.inverse()
    kept: list[np.ndarray] = []
    count = 0
    for camera in cameras:
        progress.check()
        seen = start.points(scan_virtually(vertices, faces, [camera], threads=threads).points)
        near = ((seen >= low - margin) & (seen <= high + margin)).all(1)
        kept.append(voxel_downsample_points(seen[near], voxel))
        count += len(kept[-1])
        if count > SCAN_KEPT_POINTS:
            kept = [voxel_downsample_points(np.concatenate(kept), voxel)]
            # The rest cannot get sparser: downsample again only after as many new points.
            count = 0
    return back.points(voxel_downsample_points(np.concatenate(kept), voxel))
