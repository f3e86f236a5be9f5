# SPDX-License-Identifier: GPL-3.0-or-later
"""Result folders and their reports, read."""

from __future__ import annotations

import functools
import hashlib
import json
import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..core import limits
from ..core.errors import DatasetError, ParseError
from ..core.evaluation.report.figures import (
    NOT_MEASURED,
    bytes_text,
    collect_warnings,
    duration,
    items,
    measured,
    number,
    part,
    percent,
    plural,
)
from ..core.files import read_arrays, read_json, real_path, reject_foreign_entries
from ..core.regions.files import read_region_file
from ..core.scene.camera import Camera, Similarity
from ..core.scene.placement import FILE_NAME, read_placement
from ..core.settings import MAX_LODS
from ..core.texture.file_checks import SINGLE_MAX, atlas_file, validate_face_atlas

# -- Figures of a job's report in the panel: selected at import, then stored in the .blend file
#
# The figures are stored as JSON text on the result's parent empty, so that drawing reads no file
# and a .blend still shows them if the result folder is gone.


MAX_WARNINGS = 50
MAX_TEXT = 400
"""Characters stored of one warning or name."""
MAX_ROWS = 100
"""Stages and regions stored at most."""

_DECISIONS = {
    "exposure": "Exposure",
    "multi_view": "Compare Photos",
    "growth": "Add Gaussians",
    "full_size": "Photo Size",
    "dense_start": "Dense Start",
    "refine_poses": "Refine Cameras",
}
"""Labels of what was decided, as the panel Training has them."""

_STAGES = {
    "cameras": "Cameras", "masks": "Masks", "masked": "Masked Photos", "train": "Training",
    "mesh": "Mesh", "texture": "Texture",
}  # fmt: skip

Row = tuple[str, str]


@dataclass(frozen=True)
class RegionRows:
    """Figures of one region as label and text."""

    name: str
    rows: tuple[Row, ...]


@dataclass(frozen=True)
class ReportData:
    """Rows of the panel, ready to draw."""

    rows: tuple[Row, ...] = ()
    stages: tuple[Row, ...] = ()
    decisions: tuple[Row, ...] = ()
    """Model selection: decided from the photos, or by the user."""
    regions: tuple[RegionRows, ...] = ()
    warnings: tuple[str, ...] = ()
    device_reason: str = ""
    """Why the job ran on the device that the rows name."""
    known: bool = False
    """Whether there is a report."""

    @property
    def training(self) -> str:
        """Summary of the training, for a heading: ``"12,235 Gaussians, 23.0 dB"``, or ``""``."""
        rows = dict(self.rows)
        gaussians, quality = rows.get("Gaussians"), rows.get("Held-Out PSNR")
        parts = [f"{gaussians} Gaussians"] if gaussians and gaussians != NOT_MEASURED else []
        if quality and quality != NOT_MEASURED:
            parts.append(quality.partition(" (")[0])
        return ", ".join(parts)

    def as_text(self) -> str:
        """Return all of it as text, a line for each row."""
        lines = [f"{name}: {value}" for name, value in (*self.rows, *self.stages, *self.decisions)]
        for region in self.regions:
            lines += ["", region.name, *(f"  {name}: {value}" for name, value in region.rows)]
        if self.device_reason:
            lines += ["", f"Device: {self.device_reason}"]
        if self.warnings:
            lines += ["", "Warnings", *(f"  {text}" for text in self.warnings)]
        return "\n".join(lines) + "\n"


def figures_of_report(report: Any) -> dict[str, Any]:
    """Select the figures that the panel shows; those missing from the report are omitted.

    Parameters
    ----------
    report : any
        Content of ``report.json``, of any version.

    Returns
    -------
    dict
        ``seconds``, ``gaussians``, ``psnr`` (held-out photos, dB), ``psnr_count``,
        ``memory_bytes``, ``device``, ``device_reason``, ``stages`` (pairs of name and seconds),
        ``decisions`` (name, choice and setting), ``warnings`` (texts), and
        ``regions``: for each name ``faces``, ``vertices``, ``closed``, ``coverage``,
        ``mesh_psnr`` (dB, where the mesh covers the photos), ``uncovered`` (share of the photos)
        and ``whole_psnr`` (dB, uncovered pixels black).
    """
    if not isinstance(report, dict) or not report:
        return {}
    training = part(report, "training")
    held_out = items(training.get("held_out"))
    memory = [measured(value) for value in part(report, "peak_memory_bytes").values()]
    figures: dict[str, Any] = _measured(
        seconds=report.get("wall_seconds"),
        gaussians=training.get("gaussians"),
        psnr=training.get("held_out_psnr") if held_out else None,
        psnr_count=len(held_out),
        memory_bytes=max((value for value in memory if value), default=None),
    )
    figures |= {
        key: str(report[key])[:MAX_TEXT] for key in ("device", "device_reason") if key in report
    }
    figures["stages"] = [
        [str(stage.get("name", ""))[:MAX_TEXT], stage["seconds"]]
        for stage in map(part, items(report.get("stages"))[:MAX_ROWS])
        if measured(stage.get("seconds")) is not None
    ]
    figures["decisions"] = [
        [str(entry.get(key, ""))[:MAX_TEXT] for key in ("name", "chosen", "setting")]
        for entry in map(part, items(training.get("decisions"))[:MAX_ROWS])
    ]
    figures["warnings"] = [
        f"{warning.stage}: {warning.text} {warning.hint}".strip()[:MAX_TEXT]
        for warning in collect_warnings(report)[:MAX_WARNINGS]
    ]
    figures["regions"] = {
        str(name)[:MAX_TEXT]: _rows_of_region(region)
        for name, region in list(part(report, "regions").items())[:MAX_ROWS]
    }
    return figures


def _rows_of_region(region: Any) -> dict[str, Any]:
    statistics = part(region, "statistics")
    figures = _measured(
        faces=statistics.get("faces"),
        vertices=statistics.get("vertices"),
        coverage=part(region, "texture").get("coverage"),
        mesh_psnr=part(region, "mesh_rendering").get("psnr"),
        uncovered=part(region, "mesh_rendering").get("uncovered"),
        whole_psnr=part(region, "mesh_rendering").get("whole_psnr"),
    )
    if isinstance(statistics.get("closed"), bool):
        figures["closed"] = statistics["closed"]
    figures["open_by_request"] = part(region, "provenance").get("boundary") == "open"
    return figures


def _measured(**values: Any) -> dict[str, Any]:
    return {key: value for key, value in values.items() if measured(value) is not None}


@functools.lru_cache(maxsize=16)
def report_of(text: str) -> ReportData:
    """Parse the figures stored in a .blend for the panel; any text is accepted.

    Parameters
    ----------
    text : str
        JSON text of :func:`figures_of_report`; parsed once, as panels draw often.
    """
    try:
        figures = json.loads(text)
    except (ValueError, RecursionError):
        return ReportData()
    return _report_data(figures) if isinstance(figures, dict) and figures else ReportData()


def _report_data(figures: dict[str, Any]) -> ReportData:
    psnr, count = measured(figures.get("psnr")), measured(figures.get("psnr_count"))
    quality = number(psnr, "dB", digits=1)
    if psnr is not None and count:
        quality += f" ({plural(int(count), 'photo')})"
    device = figures.get("device")
    rows: tuple[Row, ...] = (
        ("Time of Last Job", duration(figures.get("seconds"))),
        ("Peak Memory", bytes_text(figures.get("memory_bytes"))),
        ("Gaussians", number(figures.get("gaussians"))),
        ("Held-Out PSNR", quality),
    )
    if isinstance(device, str):  # version 0.1.0 had no choice
        rows = (*rows, ("Device", "Processor" if device == "cpu" else device[:MAX_TEXT]))
    reason = figures.get("device_reason")
    stages = tuple(
        (_stage(str(entry[0])), duration(entry[1]))
        for entry in items(figures.get("stages"))[:MAX_ROWS]
        if isinstance(entry, list) and len(entry) == 2
    )
    regions = tuple(
        RegionRows(name, _region_rows(part(region)))
        for name, region in list(part(figures, "regions").items())[:MAX_ROWS]
    )
    warnings = tuple(
        text[:MAX_TEXT]
        for text in items(figures.get("warnings"))[:MAX_WARNINGS]
        if isinstance(text, str)
    )
    decisions = tuple(
        _decision(*map(str, entry))
        for entry in items(figures.get("decisions"))[:MAX_ROWS]
        if isinstance(entry, list) and len(entry) == 3
    )
    why = reason[:MAX_TEXT] if isinstance(reason, str) else ""
    return ReportData(rows, stages, decisions, regions, warnings, why, True)


def _decision(name: str, chosen: str, setting: str) -> Row:
    """Return label and choice of a decision, and whether the user made it."""
    value = chosen.capitalize()[:MAX_TEXT]
    return _DECISIONS.get(name, name), value if setting == "auto" else f"{value} (set by you)"


def _region_rows(region: dict[str, Any]) -> tuple[Row, ...]:
    closed = region.get("closed")
    no = "Open by request" if region.get("open_by_request") else "No"
    rows = (
        ("Faces", number(region.get("faces"))),
        ("Closed", ("Yes" if closed else no) if isinstance(closed, bool) else NOT_MEASURED),
        ("Texture Coverage", percent(region.get("coverage"))),
        ("Textured Mesh PSNR", number(region.get("mesh_psnr"), "dB", digits=1)),
    )
    uncovered = measured(region.get("uncovered"))
    if uncovered is None:  # version 0.1.0 did not measure it
        return rows
    return (
        *rows,
        ("Photo Not Covered", percent(uncovered)),
        ("PSNR, That as Black", number(region.get("whole_psnr"), "dB", digits=1)),
    )


def _stage(name: str) -> str:
    kind, _, region = name.partition("-")
    return f"{_STAGES.get(kind, kind)} {region}".strip()


# -- Read a result folder into plain arrays, validated before they reach Blender ------------------


_logger = logging.getLogger(__name__)

# An import of this size already takes minutes; a larger claim is a broken or hostile file.
MAX_MESH_BYTES = 4 * 2**30


@dataclass(frozen=True)
class LevelResult:
    """One level of detail below a region's mesh."""

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
    face_atlas: np.ndarray | None = None
    """(f,) uint8 atlas of each face; None if there is one."""
    occlusion: tuple[Path, ...] = ()
    """Ambient occlusion, one for each atlas, or empty."""


@dataclass(frozen=True)
class RegionResult:
    """One region's mesh and texture."""

    name: str
    vertices: np.ndarray
    """(v, 3) float64, scene frame, finite."""
    faces: np.ndarray
    """(f, 3) int32, indices within range."""
    corner_uvs: np.ndarray
    """(f, 3, 2) float32, finite."""
    albedo: tuple[Path, ...]
    """One for each atlas."""
    box_vertices: np.ndarray
    """(n, 3) float64, world frame: corners of the region."""
    stamp: str
    """Changes when the mesh file changes."""
    normal_map: tuple[Path, ...] = ()
    """One for each atlas, or empty."""
    face_atlas: np.ndarray | None = None
    """(f,) uint8 atlas of each face; None if there is one."""
    levels: tuple[LevelResult, ...] = ()
    """Levels of detail 1, 2, ..."""
    occlusion: tuple[Path, ...] = ()
    """Ambient occlusion, one for each atlas, or empty."""


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
    figures: dict[str, Any] = field(default_factory=dict)
    """The figures of the report that the panel shows; empty without a report."""
    placement: Similarity | None = None
    """``blender_from_scene`` if the scene was placed before."""


def read_result(folder: Path) -> ResultFiles:
    """Read and check ``DIR/result`` (docs/architecture.md, "Result folder").

    Raises
    ------
    DatasetError
        The folder is not a result folder, contains no region, or holds links.
    ParseError
        A file is invalid; names file and position.
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
    return ResultFiles(
        folder,
        cameras,
        world_from_scene,
        radius,
        hashlib.sha256(scene_path.read_bytes()).hexdigest()[:16],
        regions,
        figures_of_report(report),
        placement,
    )


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
        numbers = np.concatenate(
            [
                world_from_scene.matrix().ravel(),
                np.array([radius]),
                *(
                    np.array([*c.cam_from_world.ravel(), c.fx, c.fy, c.cx, c.cy, c.width, c.height])
                    for c, _ in cameras
                ),
            ]
        )
        if not np.isfinite(numbers).all():
            raise ValueError("a number is not finite")
        if not (world_from_scene.scale > 0.0 and radius > 0.0):
            raise ValueError("the scale or the radius is not positive")
        if any(min(c.fx, c.fy, c.width, c.height) <= 0 for c, _ in cameras):
            raise ValueError("a camera has no size or focal length")
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise ParseError(path, "whole file", f"not a scene file ({error}).", hint) from None
    return tuple(cameras), world_from_scene, radius


def _region(folder: Path) -> RegionResult:
    path = folder / "mesh.npz"
    vertices, faces, corner_uvs, face_atlas = read_mesh_arrays(path)
    state = path.stat()
    region_path = folder / "region.json"
    if not region_path.is_file():
        raise DatasetError(f"{folder} holds no region.json.", "Mesh the region again.")
    albedo, normal_map = _textures(folder, face_atlas)
    box = read_region_file(region_path).vertices
    stamp = f"{state.st_size}:{state.st_mtime_ns}"
    levels: list[LevelResult] = []
    while (level := folder / f"lod{len(levels) + 1}" / "mesh.npz").is_file():
        if len(levels) == MAX_LODS:
            raise DatasetError(f"{folder} holds too many levels.", "Mesh the region again.")
        arrays = read_mesh_arrays(level)
        textures = _textures(level.parent, arrays[3])
        dark = _occlusion(level.parent, len(textures[0]))
        levels.append(LevelResult(*arrays[:3], *textures, arrays[3], dark))
    return RegionResult(
        folder.name, vertices, faces, corner_uvs, albedo, box, stamp, normal_map, face_atlas,
        tuple(levels), _occlusion(folder, len(albedo)),
    )  # fmt: skip


def _textures(
    folder: Path, face_atlas: np.ndarray | None
) -> tuple[tuple[Path, ...], tuple[Path, ...]]:
    atlases = range(1 if face_atlas is None else int(face_atlas.max()) + 1)
    albedo, normal_map = (
        tuple(folder / atlas_file(name, number) for number in atlases)
        for name in ("albedo", "normal")
    )
    # Normal maps exist for all atlases or for none.
    for path in (*albedo, *(normal_map if normal_map[0].is_file() else ())):
        if not path.is_file():
            raise DatasetError(f"{folder} holds no {path.name}.", "Mesh the region again.")
    return albedo, normal_map if normal_map[0].is_file() else ()


def _occlusion(folder: Path, atlases: int) -> tuple[Path, ...]:
    """Return the occlusion maps if there is one for each atlas; they are optional."""
    paths = tuple(folder / atlas_file("occlusion", number) for number in range(atlases))
    return paths if all(path.is_file() for path in paths) else ()


def read_mesh_arrays(
    path: Path, *, repair: bool = True
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
    """Read and check ``mesh.npz``.

    Parameters
    ----------
    path : Path
    repair : bool
        Whether broken faces are left out.

    Returns
    -------
    vertices, faces, corner_uvs, face_atlas

    Raises
    ------
    ParseError
        The file is invalid; names the position.
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

    Parameters
    ----------
    faces : (f, 3) ndarray of int
        Indices within range.
    """
    corners = np.sort(faces.astype(np.int64), axis=1)  # (f, 3)
    a, b, c = corners.T
    order = np.lexsort((c, b, a))  # stable: the first of equals stays first
    again = np.zeros(len(faces), bool)
    again[order[1:]] = (corners[order[1:]] == corners[order[:-1]]).all(1)
    return (a != b) & (b != c) & ~again
