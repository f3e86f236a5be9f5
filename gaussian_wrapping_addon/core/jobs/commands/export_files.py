# SPDX-License-Identifier: GPL-3.0-or-later
"""The ``export`` command: GLB, OBJ, PLY and splat files; USD and FBX need Blender (``ops``)."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ...array_file import read_arrays
from ...errors import DatasetError, ParseError, UsageError, WrapError
from ...files import read_json, real_path, reject_foreign_entries, write_bytes
from ...names import EXPORT_FORMATS, JOB_MARKER, SHADINGS, SPLAT_STEM, WORKER_FORMATS, file_stems
from ...photos.formats import open_image, without_warnings
from ...scene.camera import Similarity
from ...scene.frames import FileFrame, file_offset
from ...scene.placement import FILE_NAME, read_placement
from ...texture.file_checks import atlas_file
from ..store.job_file import write_sidecar
from .run_in_worker import run_command

if TYPE_CHECKING:
    from PIL.Image import Image

SPLAT_NAME = f"{SPLAT_STEM}.ply"


@dataclass(frozen=True)
class ExportRequest:
    """The files to export from a result."""

    result: Path
    """The result folder."""
    out: Path
    """Output folder, created if missing; files of the same names are replaced."""
    formats: tuple[str, ...]
    """Among :data:`WORKER_FORMATS`."""
    placed: bool = False
    """Whether coordinates are as placed in Blender, else in the world frame of the input."""
    regions: tuple[str, ...] = ()
    """Names of regions; empty for all."""
    levels: bool = False
    """Whether levels of detail are exported too."""
    shading: str = "auto"
    """Of GLB: lit, unlit, or auto: lit if there is a normal or occlusion map."""


@dataclass(frozen=True)
class StoredMesh:
    """One mesh of a result folder."""

    region: str
    level: int
    folder: Path
    vertices: np.ndarray  # (v, 3) float64, scene frame
    faces: np.ndarray  # (f, 3) int32
    corner_uvs: np.ndarray  # (f, 3, 2) float32
    stem: str
    """Name of its files without suffix."""
    face_atlas: np.ndarray | None = None  # (f,) uint8, None where there is one atlas

    def maps(self, name: str) -> list[Path]:
        """Return the files of a map, one for each atlas; empty if the mesh has no such map."""
        atlases = 1 if self.face_atlas is None else int(self.face_atlas.max()) + 1
        paths = [self.folder / atlas_file(name, number) for number in range(atlases)]
        return paths if paths[0].is_file() else []


def result_of(folder: Path) -> Path:
    """Return the result folder of a job folder or of a result folder.

    Raises UsageError: it is neither; DatasetError: there is no result yet, or its folder holds
    links.
    """
    for path in (folder / "result", folder):
        if (path / "scene.json").is_file():
            reject_foreign_entries(folder)
            return real_path(path)
    if (folder / JOB_MARKER).exists():
        raise DatasetError(f"The job {folder} has no result yet.", "Resume it first.")
    raise UsageError(f"{folder} holds no job's result.", "Give the folder of a finished job.")


def frames_of(result: Path) -> tuple[Similarity, Similarity]:
    """Return ``world_from_scene`` and ``blender_from_scene`` of a result.

    Raises ParseError: ``scene.json`` or ``placement.json`` holds no valid transform.
    """
    path = result / "scene.json"
    try:
        world_from_scene = Similarity.from_json(read_json(path)["world_from_scene"])
        if not (np.isfinite(world_from_scene.matrix()).all() and world_from_scene.scale > 0.0):
            raise ValueError("a number is not finite")
    except (KeyError, TypeError, ValueError, IndexError):
        raise ParseError(
            path, "world_from_scene", "not a transform.", "Run the job again."
        ) from None
    placement = result / FILE_NAME
    found = read_placement(placement, world_from_scene) if placement.is_file() else None
    return world_from_scene, found or Similarity()


def export_files(request: ExportRequest) -> Iterator[Path]:
    """Write every file of a request; yield each once it and its sidecar are complete.

    Raises UsageError: an unknown format, shading or region; DatasetError, ParseError: the result is
    incomplete; MeshingError: a mesh or Gaussian is not finite; ResourceError: it cannot be written.
    """
    from ...texture.file_checks import write_errors

    for name, known in (("formats", WORKER_FORMATS), ("shading", SHADINGS)):
        given = getattr(request, name)
        wrong = sorted({*([given] if isinstance(given, str) else given)} - set(known))
        if wrong:
            raise UsageError(f"{wrong[0]!r} cannot be exported.", f"Use {', '.join(known)}.")
    frames = frames_of(request.result)
    if "splat" in request.formats:
        _splat_of(request.result)  # before anything is written
    if request.out.exists() and not request.out.is_dir():
        raise UsageError(f"{request.out} is a file.", "Give a folder for the exports.")
    made = [path for path in (request.out, *request.out.parents) if not path.exists()]
    try:
        with write_errors(request.out):
            request.out.mkdir(parents=True, exist_ok=True)
        wanted = [f for f in request.formats if f != "splat"]
        if wanted:
            for mesh in _meshes(request):
                for name in wanted:
                    yield _write_mesh(request, mesh, name, *frames)
        if "splat" in request.formats:
            yield _write_splat(request, *frames)
    except WrapError:
        with contextlib.suppress(OSError):  # the innermost first, until one holds something
            for folder in made:
                folder.rmdir()
        raise


def _meshes(request: ExportRequest) -> Iterator[StoredMesh]:
    known = sorted(path.parent.name for path in request.result.glob("*/mesh.npz"))
    missing = sorted(set(request.regions) - set(known))
    if not known:
        raise DatasetError(f"{request.result} holds no mesh.", "Mesh a region first.")
    if missing:
        raise UsageError(
            f"{request.result} holds no mesh {missing[0]}.", f"Use {', '.join(known)}."
        )
    level_folders = {(r, n): path for r in known for n, path in _levels(request.result / r)}
    stems = file_stems(level_folders)
    for region in dict.fromkeys(request.regions or known):
        for (owner, level), folder in level_folders.items():
            if owner == region and (request.levels or level == 0):
                yield _read_mesh(region, level, folder, stems[region, level])


def _levels(folder: Path) -> Iterator[tuple[int, Path]]:
    """Yield number and folder of each level of detail of a region."""
    level, level_folder = 0, folder
    while (level_folder / "mesh.npz").is_file():
        yield level, level_folder
        level += 1
        level_folder = folder / f"lod{level}"


def _read_mesh(region: str, level: int, folder: Path, stem: str) -> StoredMesh:
    from ...texture.file_checks import validate_face_atlas, validate_for_export

    path = folder / "mesh.npz"
    kinds = {"vertices": "f8", "faces": "i4", "corner_uvs": "f4"}
    hint = "Mesh the region again."
    arrays = read_arrays(path, kinds, optional=("face_atlas",), hint=hint)
    try:
        vertices, faces, corner_uvs = (np.asarray(arrays[n], t) for n, t in kinds.items())
        face_atlas = arrays.get("face_atlas")
        if face_atlas is not None:
            face_atlas = validate_face_atlas(face_atlas, len(faces))
        if vertices.shape[1:] != (3,) or faces.shape[1:] != (3,):
            raise ValueError("not lists of triples")
        if corner_uvs.shape != (len(faces), 3, 2):
            raise ValueError("UVs are not those of the faces")
    except (ValueError, TypeError) as error:
        raise ParseError(path, "whole file", f"not a mesh file ({error}).", hint) from None
    mesh = StoredMesh(region, level, folder, vertices, faces, corner_uvs, stem, face_atlas)
    validate_for_export(vertices, faces, corner_uvs, name=f"mesh {mesh.stem}")
    return mesh


def _write_mesh(
    request: ExportRequest, mesh: StoredMesh, format: str, world_from_scene: Similarity,
    blender_from_scene: Similarity,
) -> Path:  # fmt: skip
    from ...texture.file_checks import vertex_colors, write_errors, write_mesh_ply
    from ...texture.files import write_glb, write_obj

    target_from_scene = blender_from_scene if request.placed else world_from_scene
    frame = FileFrame(format, target_from_scene)
    if not request.placed and not EXPORT_FORMATS[format].doubles:
        # Use the offset of the finest level, so that all levels align.
        finest = mesh
        if mesh.level:
            finest = _read_mesh(mesh.region, 0, mesh.folder.parent, mesh.stem)
        frame = FileFrame(
            format, target_from_scene, file_offset(target_from_scene.points(finest.vertices))
        )
    local = frame.local(mesh.vertices)
    path = request.out / f"{mesh.stem}{EXPORT_FORMATS[format].suffix}"
    textures: list[str] = []
    missing = mesh.folder / "albedo.png"
    shading = "lit"
    if format == "ply":
        albedos = [np.asarray(_image(file)) for file in mesh.maps("albedo") or [missing]]
        colors = vertex_colors(len(local), mesh.faces, mesh.corner_uvs, albedos, mesh.face_atlas)
        write_mesh_ply(path, local, mesh.faces, colors)
    elif format == "obj":
        sources = {name: mesh.maps(name) for name in ("albedo", "normal")}
        copy_names = {n: [f"{mesh.stem}-{f.name}" for f in files] for n, files in sources.items()}
        textures = [*copy_names["albedo"], *copy_names["normal"]]
        for file in [*sources["albedo"], *sources["normal"]]:
            data, copy = _png(file), request.out / f"{mesh.stem}-{file.name}"
            with write_errors(copy):
                write_bytes(copy, data)
        write_obj(
            path, local @ frame.turn.T, mesh.faces, mesh.corner_uvs,
            copy_names["albedo"], copy_names["normal"], mesh.face_atlas,
        )  # fmt: skip
    elif format == "glb":
        maps = {
            f"{name}_png": [_png(file) for file in files]
            for name in ("normal", "occlusion")
            if (files := mesh.maps(name))
        }
        albedo_png = [_png(file) for file in mesh.maps("albedo") or [missing]]
        shading = request.shading
        if shading == "auto":
            shading = "lit" if maps else "unlit"
        write_glb(
            path, local, mesh.faces, mesh.corner_uvs, albedo_png, frame.offset,
            shading=shading, face_atlas=mesh.face_atlas, **maps,
        )  # fmt: skip
    else:
        raise UsageError(f"The worker writes no {format} files.", "Export it from Blender.")
    contents = {
        "region": mesh.region, "level": mesh.level, "shading": shading, "textures": textures,
        "vertices": len(mesh.vertices), "faces": len(mesh.faces),
    }  # fmt: skip
    write_sidecar(
        path, frame, world_from_scene, blender_from_scene,
        placed=request.placed, result=request.result, contents=contents,
    )  # fmt: skip
    return path


def _image(path: Path) -> Image:
    """Read an RGB image; raises if it is broken."""
    from PIL import Image

    try:
        with without_warnings():
            return open_image(path).convert("RGB")
    except (OSError, ValueError, Image.DecompressionBombError) as error:
        raise ParseError(
            path, "whole file", f"not an image ({error}).", "Mesh the region again."
        ) from None


def _png(path: Path) -> bytes:
    """Return the bytes of an image file after checking that it can be read."""
    _image(path)
    return path.read_bytes()


def _splat_of(result: Path) -> Path:
    path = result / "gaussians.ply"
    if not path.is_file():
        raise DatasetError(f"{result} holds no gaussians.ply.", "Run the job again.")
    return path


def _write_splat(
    request: ExportRequest, world_from_scene: Similarity, blender_from_scene: Similarity
) -> Path:
    from ...gaussians.files import read_splat_ply, write_viewer_ply
    from ...texture.file_checks import write_errors
    from ...training.splat_start import transform_gaussians

    found = read_splat_ply(_splat_of(request.result))
    target_from_scene = blender_from_scene if request.placed else world_from_scene
    offset = np.zeros(3)
    if not request.placed:
        offset = file_offset(target_from_scene.points(found.gaussians.means.double().numpy()))
    frame = FileFrame("splat", target_from_scene, offset)
    moved = transform_gaussians(found.gaussians, frame.file_from_scene())
    path = request.out / SPLAT_NAME
    with write_errors(path):
        write_viewer_ply(path, moved)
    write_sidecar(
        path, frame, world_from_scene, blender_from_scene,
        placed=request.placed, result=request.result,
        contents={"gaussians": len(moved), "dropped": found.dropped, "filter": "baked in"},
    )  # fmt: skip
    return path


def main(arguments: list[str]) -> int:
    """Export ``arguments = [the request as JSON]`` in this process; return the exit code."""

    def work() -> Iterator[str]:
        given = json.loads(arguments[0])
        request = ExportRequest(
            Path(given["result"]), Path(given["out"]), tuple(given["formats"]), given["placed"],
            tuple(given["regions"]), given["levels"], given["shading"],
        )  # fmt: skip
        yield from (f"written: {path}" for path in export_files(request))

    return run_command(work)
