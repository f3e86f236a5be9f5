# SPDX-License-Identifier: GPL-3.0-or-later
"""Result folders read into plain arrays, validated before they reach Blender."""

from __future__ import annotations

import hashlib
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..core import limits
from ..core.array_file import read_arrays
from ..core.errors import DatasetError, ParseError
from ..core.files import read_json, real_path, reject_foreign_entries
from ..core.regions.files import read_region_file
from ..core.scene.camera import Camera, Similarity
from ..core.scene.placement import FILE_NAME, read_placement
from ..core.settings import MAX_LODS
from ..core.texture.file_checks import SINGLE_MAX, atlas_file, validate_face_atlas
from .report_data import figures_of_report

_logger = logging.getLogger(__name__)

# An import of this size already takes minutes; a larger claim is a broken or hostile file.
MAX_MESH_BYTES = 4 * 2**30


@dataclass(frozen=True)
class MeshResult:
    """A mesh and its textures: of a region, or of a level of detail below it."""

    vertices: np.ndarray
    """(v, 3) float64, scene frame, finite."""
    faces: np.ndarray
    """(f, 3) int32, indices within range."""
    corner_uvs: np.ndarray
    """(f, 3, 2) float32, finite."""
    albedo: tuple[Path, ...]
    """One for each atlas."""
    normal_map: tuple[Path, ...]
    """The same, or empty."""
    occlusion: tuple[Path, ...]
    """Ambient occlusion: the same, or empty."""
    face_atlas: np.ndarray | None
    """(f,) uint8 atlas of each face; None if there is one."""


@dataclass(frozen=True)
class RegionResult:
    """One region's mesh, its box and its coarser levels."""

    name: str
    mesh: MeshResult
    box_vertices: np.ndarray
    """(n, 3) float64, world frame: corners of the region."""
    stamp: str
    """Changes when the mesh file changes."""
    levels: tuple[MeshResult, ...]
    """Levels of detail 1, 2, ..."""


@dataclass(frozen=True)
class ResultFiles:
    """Contents of a result folder that Blender shows."""

    folder: Path
    cameras: tuple[tuple[Camera, str], ...]
    """Cameras in the scene frame with the path of their photo."""
    world_from_scene: Similarity
    radius: float
    fingerprint: str
    """Hash of ``scene.json``: finds a result again whose folder was moved."""
    regions: tuple[RegionResult, ...]
    figures: dict[str, Any]
    """The figures of the report that the panel shows; empty without a report."""
    placement: Similarity | None
    """``blender_from_scene`` if the scene was placed before."""


def read_result(folder: Path) -> ResultFiles:
    """Read and check ``DIR/result`` (docs/architecture.md, "Result folder").

    Raises DatasetError: the folder is not a result folder, contains no region, or holds links;
    ParseError: a file is invalid; names file and position.
    """
    folder = real_path(folder)
    scene_path = folder / "scene.json"
    if not scene_path.is_file():
        raise DatasetError(
            f"{folder} holds no scene.json.", "Choose the folder named result of a finished job."
        )
    reject_foreign_entries(folder)
    cameras, world_from_scene, radius = _scene(scene_path)
    regions = tuple(
        _region(path.parent) for path in sorted(folder.glob("*/mesh.npz")) if path.is_file()
    )
    if not regions:
        raise DatasetError(f"{folder} holds no mesh.", "Mesh a region first.")
    report_path = folder / "report.json"
    report = read_json(report_path) if report_path.is_file() else {}
    placement_path = folder / FILE_NAME
    placement = None
    if placement_path.is_file():
        placement = read_placement(placement_path, world_from_scene)
        if placement is None:
            _logger.warning("%s is for other cameras: not used", placement_path)
    fingerprint = hashlib.sha256(scene_path.read_bytes()).hexdigest()[:16]
    return ResultFiles(
        folder, cameras, world_from_scene, radius, fingerprint, regions,
        figures_of_report(report), placement,
    )  # fmt: skip


def _scene(path: Path) -> tuple[tuple[tuple[Camera, str], ...], Similarity, float]:
    values = read_json(path)
    hint = "Run the job again."
    try:
        world_from_scene = Similarity.from_json(values["world_from_scene"])
        radius = float(values["radius"])
        entries = values["cameras"]
        if not isinstance(entries, list) or len(entries) > limits.MAX_IMAGES:
            raise ValueError("cameras is not a list of a possible length")
        cameras = []
        for entry in entries:
            entry = dict(entry)
            photo = str(entry.pop("photo"))
            cameras.append((Camera.from_json(entry), photo))
        numbers = [*world_from_scene.matrix().ravel(), radius]
        for c, _ in cameras:
            numbers += [*c.cam_from_world.ravel(), c.fx, c.fy, c.cx, c.cy, c.width, c.height]
        if not np.isfinite(np.array(numbers, np.float64)).all():
            raise ValueError("a number is not finite")
        if not (world_from_scene.scale > 0.0 and radius > 0.0):
            raise ValueError("the scale or the radius is not positive")
        if any(min(c.fx, c.fy, c.width, c.height) <= 0 for c, _ in cameras):
            raise ValueError("a camera has no size or focal length")
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise ParseError(path, "whole file", f"not a scene file ({error}).", hint) from None
    return tuple(cameras), world_from_scene, radius


def _region(folder: Path) -> RegionResult:
    state = (folder / "mesh.npz").stat()
    region_path = folder / "region.json"
    if not region_path.is_file():
        raise DatasetError(f"{folder} holds no region.json.", "Mesh the region again.")
    mesh, box = _mesh(folder), read_region_file(region_path).vertices
    levels: list[MeshResult] = []
    while (level := folder / f"lod{len(levels) + 1}" / "mesh.npz").is_file():
        if len(levels) == MAX_LODS:
            raise DatasetError(f"{folder} holds too many levels.", "Mesh the region again.")
        levels.append(_mesh(level.parent))
    stamp = f"{state.st_size}:{state.st_mtime_ns}"
    return RegionResult(folder.name, mesh, box, stamp, tuple(levels))


def _mesh(folder: Path) -> MeshResult:
    vertices, faces, corner_uvs, face_atlas = read_mesh_arrays(folder / "mesh.npz")
    atlases = range(1 if face_atlas is None else int(face_atlas.max()) + 1)
    albedo, normal_map, occlusion = (
        tuple(folder / atlas_file(name, number) for number in atlases)
        for name in ("albedo", "normal", "occlusion")
    )
    # Normal maps exist for all atlases or for none; occlusion counts where it does for all.
    normal_map = normal_map if normal_map[0].is_file() else ()
    for path in (*albedo, *normal_map):
        if not path.is_file():
            raise DatasetError(f"{folder} holds no {path.name}.", "Mesh the region again.")
    occlusion = occlusion if all(path.is_file() for path in occlusion) else ()
    return MeshResult(vertices, faces, corner_uvs, albedo, normal_map, occlusion, face_atlas)


def read_mesh_arrays(
    path: Path, *, repair: bool = True
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
    """Read and check ``mesh.npz``.

    ``repair``: whether broken faces are left out.
    Returns vertices, faces, corner_uvs, face_atlas.
    Raises ParseError: the file is invalid; names the position.
    """
    hint = "Mesh the region again."
    try:
        arrays = read_arrays(
            path, ("vertices", "faces", "corner_uvs"), optional=("face_atlas",),
            most_bytes=MAX_MESH_BYTES, hint=hint,
        )  # fmt: skip
        vertices = np.asarray(arrays["vertices"], np.float64)
        faces = arrays["faces"]
        corner_uvs = np.asarray(arrays["corner_uvs"], np.float64)
        face_atlas = arrays.get("face_atlas")
        if face_atlas is not None:
            face_atlas = validate_face_atlas(face_atlas, len(faces))
    except (ValueError, TypeError, MemoryError) as error:
        raise ParseError(path, "whole file", f"not a mesh file ({error}).", hint) from None
    if vertices.ndim != 2 or vertices.shape[1:] != (3,):
        raise ParseError(path, "vertices", f"shape {vertices.shape} is not (v, 3).", hint)
    if faces.ndim != 2 or faces.shape[1:] != (3,) or faces.dtype.kind not in "iu":
        raise ParseError(path, "faces", f"shape {faces.shape} is not (f, 3) of integers.", hint)
    if corner_uvs.shape != (len(faces), 3, 2):
        raise ParseError(path, "corner_uvs", f"shape {corner_uvs.shape} is not (f, 3, 2).", hint)
    if len(faces) == 0:
        raise ParseError(path, "faces", "there is none.", hint)
    for name, values in (("vertices", vertices), ("corner_uvs", corner_uvs)):
        # Blender stores 32-bit floats: larger values would become infinite.
        bad = np.flatnonzero(~(np.abs(values) <= SINGLE_MAX).reshape(len(values), -1).all(1))
        if len(bad):
            raise ParseError(path, f"{name}[{bad[0]}]", "not a finite number of 32 bits.", hint)
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ParseError(path, "faces", "an index is out of range.", hint)
    sound = sound_faces(faces) if repair else np.ones(len(faces), bool)
    if not sound.all():
        removed = int(np.count_nonzero(~sound))
        _logger.warning("%s: %d broken faces are left out", path, removed)
        faces, corner_uvs = faces[sound], corner_uvs[sound]
        face_atlas = None if face_atlas is None else face_atlas[sound]
    return vertices, faces.astype(np.int32), corner_uvs.astype(np.float32), face_atlas


def sound_faces(faces: np.ndarray) -> np.ndarray:
    """Return (f,) bool: three different corners, and no earlier face of the same three.

    ``faces``: (f, 3) ndarray of int. Indices within range.
    """
    corners = np.sort(faces.astype(np.int64), axis=1)  # (f, 3)
    a, b, c = corners.T
    order = np.lexsort((c, b, a))  # stable: the first of equals stays first
    again = np.zeros(len(faces), bool)
    again[order[1:]] = (corners[order[1:]] == corners[order[:-1]]).all(1)
    return (a != b) & (b != c) & ~again
