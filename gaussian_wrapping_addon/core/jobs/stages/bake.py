# SPDX-License-Identifier: GPL-3.0-or-later
"""Bake stage: the photos onto a mesh from elsewhere; its files go to ``baked/NAME``."""

from __future__ import annotations

import hashlib
import shutil
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...array_file import is_whole
from ...errors import UsageError
from ...files import write_json
from ...progress import Progress
from ...settings import key_values
from ..store.job_file import BakeRequest, JobFile, training_keys
from ..store.job_folder import JobFolder
from ..store.rollback import new_result, no_finished_training
from ..store.stage_folder import STAGE_VERSIONS, Stage, read_done, run_stage, stage_key

if TYPE_CHECKING:
    from ...mesh.exchange import FileMesh
    from ...scene.camera import Similarity

BAKE_FILE = "bake.json"
"""Figures of a bake, beside its files."""
VERSION = 1


def require_training(folder: JobFolder, job: JobFile, cameras: Stage) -> None:
    """Raise if a bake would have to train first."""
    key, _ = training_keys(cameras.key, job)
    if read_done(folder.stages / f"train-{key}") is None:
        raise no_finished_training(folder.root)


def run_bake(
    folder: JobFolder, job: JobFile, cameras: Stage, trained: Stage, progress: Progress, *,
    threads: int,
) -> Stage:  # fmt: skip
    """Bake onto the mesh of a job and replace ``baked/NAME``, or re-use the finished stage.

    Raises UsageError: the job names no mesh; DatasetError, MeshingError: the mesh cannot be read or
    textured, or no photo sees it; ResourceError: memory or disk space is not sufficient.
    """
    request = job.bake
    if request is None:
        raise UsageError("job.json names no mesh to bake onto.", "Start the bake again.")
    request = request.validated()
    files = [request.mesh, request.dense, request.sidecar]
    key = stage_key(
        STAGE_VERSIONS["bake"], cameras.key, trained.key, [_fingerprint(path) for path in files],
        request.up, request.uvs, request.faces, key_values(request.texture), sorted(request.export),
    )  # fmt: skip

    def work(stage_folder: Path, progress: Progress) -> dict[str, Any]:
        return _bake(request, cameras, trained, stage_folder, progress, threads)

    baked = run_stage(
        folder.stages, f"bake-{request.name}", key, progress.span(0.0, 0.98), work,
        whole=lambda stage_folder: is_whole(stage_folder / "files" / "mesh.npz"),
    )  # fmt: skip
    with new_result(folder.baked) as new:
        shutil.copytree(baked.folder / "files", new / request.name)
    progress.update(1.0, "finished")
    return baked


def _bake(
    request: BakeRequest, cameras: Stage, trained: Stage, stage_folder: Path, progress: Progress,
    threads: int,
) -> dict[str, Any]:  # fmt: skip
    from ...evaluation.photo_views import compare_with_photos
    from ...limits import MAX_IMAGE_SIDE_PX
    from ...mesh.textured_mesh import POLYGONS_FILE, write_polygons
    from ...photos.store import PhotoStore
    from ...scene.scene import load_refined_scene
    from ...texture.bake_onto import BakeChoices, bake_onto, welded
    from ...texture.files import write_textured
    from .meshing import free_bytes
    from .texture import photo_source

    progress.update(0.0, "reading the mesh")
    scene = load_refined_scene(cameras.folder, trained.folder)
    given = _read_in_scene(request.mesh, request, scene.world_from_scene)
    dense = None
    if request.dense:
        dense = welded(_read_in_scene(request.dense, request, scene.world_from_scene))
    photos = PhotoStore(scene, MAX_IMAGE_SIDE_PX)
    source = photo_source(request.texture, trained, photos, threads)
    textured = bake_onto(
        given, scene, source, request.texture, BakeChoices(request.uvs, request.faces),
        stage_folder, progress.span(0.02, 0.9),
        threads=threads, dense=dense, free_bytes=free_bytes(stage_folder, threads),
    )  # fmt: skip
    files = stage_folder / "files"
    progress.update(0.9, "writing the files")
    write_textured(textured, files, request.export, scene.world_from_scene)
    if given.is_new and given.polygons is not None:
        write_polygons(files / POLYGONS_FILE, given.polygons)
    progress.update(0.93, "comparing with photos")
    rendering = compare_with_photos(
        textured, scene, photos, (), files, progress.span(0.93, 1.0),
        from_gaussians=request.texture.source == "gaussians", threads=threads,
    )  # fmt: skip
    figures = {
        "version": VERSION, "name": request.name, "vertices": len(textured.mesh.vertices),
        "faces": len(textured.mesh.faces), "faces_given": len(given.faces),
        "udims": list(textured.udims), "texture": textured.statistics, "mesh_rendering": rendering,
    }  # fmt: skip
    write_json(files / BAKE_FILE, figures)
    return figures


def _read_in_scene(path: str, request: BakeRequest, world_from_scene: Similarity) -> FileMesh:
    """Read a mesh and bring it from its file's frame into the scene frame."""
    from ...mesh.exchange import SUFFIX, read_handed_over, read_mesh_file, world_from_file

    file = Path(path)
    if file.suffix.lower() == SUFFIX:
        mesh = read_handed_over(file)
        world = mesh.vertices
    else:
        mesh = read_mesh_file(file)
        sidecar = Path(request.sidecar) if request.sidecar else None
        world = world_from_file(file, sidecar, request.up).points(mesh.vertices)
    return replace(mesh, vertices=world_from_scene.inverse().points(world))


def _fingerprint(path: str) -> str:
    """Return a hash of a file's content, and of what lies beside it and tells its frame."""
    if not path:
        return ""
    digest = hashlib.sha256()
    file = Path(path)
    for part in (file, file.with_name(file.name + ".json"), file.with_name("transform.json")):
        if part.is_file():
            with part.open("rb") as stream:
                digest.update(hashlib.file_digest(stream, "sha256").digest())
    return digest.hexdigest()
