# SPDX-License-Identifier: GPL-3.0-or-later
"""Tanks and Temples: layout of its files, crop volumes; meshes and clouds read for evaluation."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .. import limits
from ..errors import DatasetError, ParseError, UsageError
from ..files import read_json
from ..mesh.exchange import read_mesh_file
from ..ply import read_ply_header
from ..progress import Progress
from ..readers.point_files import read_point_ply
from ..scene.camera import Camera, Similarity
from ..scene.placement import RansacResult, umeyama_ransac
from .alignment import refine_as_tanks
from .surface_scores import (
    sample_legacy,
    sample_uniformly,
    scan_virtually,
    score_clouds,
    voxel_downsample,
)

# -- Read meshes and point clouds for evaluation from common file formats -------------------------


_MESH_INPUT_AGAIN = "Export the file again."


def is_cloud(path: Path) -> bool:
    """Return whether a file is a PLY without faces; other formats count as meshes.

    Raises
    ------
    ParseError
        The header of the PLY is invalid.
    """
    if path.suffix.lower() != ".ply":
        return False
    return not read_ply_header(path, _MESH_INPUT_AGAIN).count("face")


def read_mesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return (v, 3) float64 vertices and (f, 3) int64 faces, in the coordinates of the file.

    Raises
    ------
    ParseError, WorkerError
        As :func:`~.exchange.read_mesh_file`.
    """
    mesh = read_mesh_file(path)
    return mesh.vertices, mesh.faces


def read_cloud(path: Path) -> np.ndarray:
    """Read the points of a PLY, (n, 3) float64.

    Raises
    ------
    ParseError
        Not a PLY, truncated, empty, or with points that are not finite.
    """
    announced = read_ply_header(path, _MESH_INPUT_AGAIN).count("vertex")
    points, _ = read_point_ply(path)
    if announced == 0:
        raise ParseError(path, "header", "the cloud is empty.", _MESH_INPUT_AGAIN)
    if len(points) < announced:
        text = f"{announced - len(points)} of {announced} are not finite."
        raise ParseError(path, "vertices", text, _MESH_INPUT_AGAIN)
    return points


# -- Crop volumes of Tanks and Temples: a polygon swept along an axis (Open3D's selection volume)


CLASS_NAME = "SelectionPolygonVolume"
VERSION = 1
_PLANES = {"X": (1, 2, 0), "Y": (0, 2, 1), "Z": (0, 1, 2)}
"""For each axis: the two coordinates of the polygon's plane, then the axis itself."""


@dataclass(frozen=True)
class PolygonVolume:
    """All points between two heights whose projection along an axis lies in a polygon."""

    polygon: np.ndarray
    """(k, 3) float64 corners in order, the last joined to the first; the coordinate along the axis
    is not used. The polygon may be concave; self-intersections follow the even-odd rule."""
    orthogonal_axis: str  # ``"X"``, ``"Y"`` or ``"Z"``
    axis_min: float
    axis_max: float

    def inside(self, points: np.ndarray) -> np.ndarray:
        """Return whether (n, 3) points lie inside, (n,) bool.

        The heights ``axis_min`` and ``axis_max`` are inside. A point on the polygon's border is on
        the side with larger coordinates, so that exactly one of two volumes that share an edge
        contains it. NaN is outside.
        """
        points = np.asarray(points, np.float64)
        u, v, w = _PLANES[self.orthogonal_axis]
        height = points[:, w]
        result = (height >= self.axis_min) & (height <= self.axis_max)
        candidates = np.flatnonzero(result)
        x, y = points[candidates, u], points[candidates, v]
        odd = np.zeros(len(candidates), bool)
        corners = self.polygon[:, (u, v)]
        for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            if y0 == y1:
                continue
            crosses = (y0 > y) != (y1 > y)
            odd ^= crosses & (x < x0 + (y - y0) * ((x1 - x0) / (y1 - y0)))
        result[candidates] = odd
        return result

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and upper corner, (3,) each, of the axis-aligned box around it."""
        low, high = self.polygon.min(0), self.polygon.max(0)
        axis = _PLANES[self.orthogonal_axis][2]
        low[axis], high[axis] = self.axis_min, self.axis_max
        return low, high


def read_polygon_volume(path: Path) -> PolygonVolume:
    """Read a crop file.

    Raises
    ------
    ParseError
        States the entry: missing, not finite, an unknown axis or version, too few corners.
    """

    def bad(place: str, problem: str) -> ParseError:
        return ParseError(path, place, problem, "Use the crop file that belongs to the data set.")

    def number(place: str, value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise bad(place, "a number was expected.")
        if not math.isfinite(value):
            raise bad(place, "the number is not finite.")
        return float(value)

    try:
        values = read_json(path, follow_links=True)
    except OSError as error:
        raise bad("whole file", f"cannot be read: {error.strerror}.") from None
    if not isinstance(values, dict):
        raise bad("top level", "an object was expected.")
    if values.get("class_name", CLASS_NAME) != CLASS_NAME:
        raise bad("class_name", f"is not {CLASS_NAME!r}.")
    version = values.get("version_major", values.get("version", VERSION))
    if isinstance(version, bool) or version != VERSION:
        raise bad("version_major", f"{str(version)[:20]} is not known.")
    axis = values.get("orthogonal_axis")
    if not isinstance(axis, str) or axis.upper() not in _PLANES:
        raise bad("orthogonal_axis", "X, Y or Z was expected.")
    low, high = (number(key, values.get(key)) for key in ("axis_min", "axis_max"))
    if not low < high:
        raise bad("axis_min", f"{low:g} is not below axis_max {high:g}.")
    rows = values.get("bounding_polygon")
    if not isinstance(rows, list) or len(rows) < 3:
        raise bad("bounding_polygon", "at least 3 corners were expected.")
    corners = []
    for i, row in enumerate(rows):
        place = f"bounding_polygon[{i}]"
        if not isinstance(row, list) or len(row) != 3:
            raise bad(place, "three numbers were expected.")
        corners.append([number(place, value) for value in row])
    return PolygonVolume(np.array(corners, np.float64), axis.upper(), low, high)


# -- Read, align and score scenes of Tanks and Temples in their original layout -------------------
#
# See docs/method.md, section 9.1.
#
# A folder holds ``<Scene>.ply`` (the scanned cloud), ``<Scene>.json`` (crop volume),
# ``<Scene>_trans.txt`` (4x4, truth from the log's frame) and ``<Scene>_COLMAP_SfM.log`` (for
# every photo a line ``i i 0`` and a 4x4 matrix, world from camera).


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


@dataclass(frozen=True)
class TanksScene:
    """Ground truth of one scene, in the frame of the scanned cloud."""

    name: str
    threshold: float
    cloud: np.ndarray  # (n, 3) float64
    crop: PolygonVolume
    log_numbers: np.ndarray  # (m,) int64, photo number of each entry of the trajectory
    log_centers: np.ndarray
    """(m, 3) camera centres of the trajectory, transformed by ``_trans.txt``."""


def _bad(path: Path, place: str, problem: str) -> ParseError:
    return ParseError(path, place, problem, "Use the file that belongs to the data set.")


def is_tanks_folder(folder: Path) -> bool:
    """Return whether the folder holds a trajectory or an alignment matrix of the data set."""
    return any(any(folder.glob(f"*{suffix}")) for suffix in (_TRUTH_SUFFIX, _LOG_SUFFIX))


def read_tanks(folder: Path, threshold: float | None = None) -> TanksScene:
    """Read a scene; a folder with the files of several must have the name of the scene.

    ``threshold`` replaces that of :data:`THRESHOLDS`.

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
    suffixes = _TRUTH_SUFFIX, _LOG_SUFFIX
    names = sorted({p.name.removesuffix(s) for s in suffixes for p in folder.glob(f"*{s}")})
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
        raise _bad(path, "whole file", f"a 4x4 matrix was expected, not {shape}.")
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
        raise _bad(
            path, f"line {lines[-1][0] if lines else 1}",
            f"{len(lines)} lines are not at least 3 entries of 5; the file may be cut off.",
        )  # fmt: skip
    numbers, poses = [], []
    for begin in range(0, len(lines), 5):
        line, words = lines[begin]
        place = f"line {line}"
        if len(words) != 3 or not words[0].isdecimal() or len(words[0]) > 9:
            raise _bad(path, place, "three whole numbers were expected.")
        rows = [row for _, row in lines[begin + 1 : begin + 5]]
        if any(len(row) != 4 for row in rows):
            raise _bad(path, place, "four rows of four numbers must follow.")
        matrix = _numbers(path, place, rows)
        _similarity(path, place, matrix)
        numbers.append(int(words[0]))
        poses.append(matrix)
    if len(set(numbers)) != len(numbers):
        raise _bad(path, "whole file", "a photo has two poses.")
    return np.array(numbers, np.int64), np.array(poses)


def _lines(path: Path) -> list[tuple[int, str]]:
    try:
        size_bytes = path.stat().st_size
        if size_bytes > limits.MAX_JSON_BYTES:
            raise _bad(path, "whole file", f"{size_bytes} bytes are too many.")
        text = path.read_bytes().decode("utf-8-sig", errors="replace")
    except OSError as error:
        raise _bad(path, "whole file", f"cannot be read: {error.strerror}.") from None
    return list(enumerate(text.splitlines(), 1))


def _numbers(path: Path, place: str, rows: list[list[str]]) -> np.ndarray:
    try:
        values = np.array([[float(word) for word in row] for row in rows])
    except ValueError as error:
        raise _bad(path, place, f"{error}.") from None
    if not np.isfinite(values).all():
        raise _bad(path, place, "a number is not finite.")
    return values


def _similarity(path: Path, place: str, matrix: np.ndarray) -> Similarity:
    linear = matrix[:3, :3]
    determinant = float(np.linalg.det(linear))
    if not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-6):
        raise _bad(path, place, "the last row must be 0 0 0 1.")
    if not determinant > 0:
        raise _bad(path, place, "the matrix mirrors or flattens.")
    scale = determinant ** (1.0 / 3.0)
    u, _, vt = np.linalg.svd(linear / scale)
    if np.abs(u @ vt - linear / scale).max() > _ROTATION_TOLERANCE:
        raise _bad(path, place, "not a rotation with a scale.")
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
        centers, scene.log_centers[rows[known]], threshold=RANSAC_DISTANCE,
        iterations=RANSAC_ITERATIONS, seed=seed,
    )  # fmt: skip
    if found.inliers.mean() < MIN_AGREEING_SHARE:
        raise DatasetError(
            f"{int(found.inliers.sum())} of {len(known)} cameras match the trajectory of "
            f"{scene.name} within {RANSAC_DISTANCE:g}.",
            "Photos and trajectory do not match, or the cameras were solved wrongly.",
        )
    return found


def score_tanks(
    mesh: tuple[np.ndarray, np.ndarray], cameras: Sequence[Camera], scene: TanksScene,
    start: Similarity, *, refine: bool, protocols: Sequence[str], samples: int = SAMPLES,
    seed: int = 0, threads: int = 1, progress: Progress | None = None,
) -> dict[str, dict[str, Any]]:  # fmt: skip
    """Score a mesh by the data set's protocol: sampling, refinement, crop, voxel tau / 2, F1.

    ``uniform`` samples uniformly (1e6 samples, or ``samples`` if that is less, for the refinement);
    samples outside the crop are dropped individually, so faces need no cropping. ``scan`` uses the
    surface seen by the cameras, downsampled to voxels of tau / 4. ``legacy`` uses vertices and
    face centres. Each is refined separately, as in the original scripts.

    The mesh is vertices (v, 3) and faces (f, 3) in the job's frame, like the cameras; ``start`` is
    ``truth_from_job`` before the refinement. Returns for each protocol ``score``, ``transform``
    and ``refinement`` (or ``None``), plain JSON values.

    Raises
    ------
    UsageError
        Unknown protocol, or a scan without cameras.
    DatasetError
        The refinement finds no correspondences, or the crop holds no truth.
    """
    vertices, faces = mesh
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
                few = min(samples, ALIGNMENT_SAMPLES)
                probe = sample_uniformly(vertices, near, few, seed=seed).points
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
    vertices: np.ndarray, faces: np.ndarray, cameras: Sequence[Camera], scene: TanksScene,
    start: Similarity, threads: int, progress: Progress,
) -> np.ndarray:  # fmt: skip
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
        kept.append(voxel_downsample(seen[near], voxel))
        count += len(kept[-1])
        if count > SCAN_KEPT_POINTS:
            kept = [voxel_downsample(np.concatenate(kept), voxel)]
            # The rest cannot get sparser: downsample again only after as many new points.
            count = 0
    return back.points(voxel_downsample(np.concatenate(kept), voxel))
