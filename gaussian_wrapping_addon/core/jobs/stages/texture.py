# SPDX-License-Identifier: GPL-3.0-or-later
"""Stages of textures, bakes and exports."""

from __future__ import annotations

import contextlib
import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...array_file import is_whole
from ...errors import ParseError, UsageError
from ...evaluation.report.report import CURVE, write_report
from ...files import finite_json, read_json, resolve_inside, write_json
from ...names import REPORT_FOLDER, RESULT_FORMATS
from ...progress import Progress
from ...scene.camera import Similarity
from ...scene.placement import FILE_NAME as PLACEMENT
from ...scene.placement import read_placement, write_placement
from ...settings import TextureSettings, key_values, to_json
from ...units.georeference import blender_start
from ..store.job_file import BakeRequest, JobFile, training_keys
from ..store.job_folder import JobFolder
from ..store.rollback import new_result, no_finished_training
from ..store.stage_folder import STAGE_VERSIONS, Stage, read_done, run_stage, stage_key
from .cameras import write_scene_summary
from .meshing import DENSE_MESH, free_bytes

if TYPE_CHECKING:
    from ...mesh.exchange import FileMesh
    from ...photos.store import PhotoStore
    from ...scene.scene import PhotoSource, Scene


# -- Texture stage: bake a region's textures, write its files, and compare it with the photos -----

OCCLUSION_VERSION = 2
"""Raise it where ambient occlusion alone is computed otherwise: other textures stay valid."""


def run_texture(
    folder: JobFolder, job: JobFile, name: str, cameras: Stage, trained: Stage, meshed: Stage,
    progress: Progress, *, threads: int,
) -> Stage:  # fmt: skip
    """Texture the mesh of a region and write its files, or re-use the finished stage.

    Raises ResourceError: memory or disk space is not sufficient.
    """
    texture = job.settings.texture
    occlusion = [OCCLUSION_VERSION] if texture.ambient_occlusion == "on" else []
    key = stage_key(STAGE_VERSIONS["texture"], meshed.key, to_json(texture), *occlusion)

    def work(stage_folder: Path, progress: Progress) -> dict[str, Any]:
        from ...evaluation.photo_views import compare_with_photos, write_preview
        from ...limits import MAX_IMAGE_SIDE_PX
        from ...mesh.surface_mesh import load_mesh
        from ...photos.store import PhotoStore
        from ...regions.scene_regions import parse_region, region_in_scene
        from ...scene.frames import file_offset
        from ...scene.scene import load_refined_scene
        from ...texture.files import write_textured
        from ...texture.levels_of_detail import levels_of_detail
        from ...texture.texture_mesh import texture_mesh

        scene = load_refined_scene(cameras.folder, trained.folder)
        photos = PhotoStore(scene, MAX_IMAGE_SIDE_PX)
        mesh = load_mesh(meshed.folder / "mesh.npz")
        dense_path = meshed.folder / DENSE_MESH
        dense = load_mesh(dense_path) if dense_path.is_file() else None
        source = photo_source(texture, trained, photos, threads)
        coarse_from = 0.7 if texture.lods else 0.9
        textured = texture_mesh(
            mesh, scene, source, texture, stage_folder, progress.span(0.0, coarse_from),
            threads=threads, dense=dense, free_bytes=free_bytes(stage_folder),
        )  # fmt: skip
        region_path = meshed.folder / "region.json"
        region = parse_region(read_json(region_path), region_path)
        levels = levels_of_detail(
            textured, dense, texture, stage_folder, progress.span(coarse_from, 0.9),
            threads=threads, region=region_in_scene(region, scene.world_from_scene),
        )  # fmt: skip
        formats = tuple(f for f in job.settings.export if f in RESULT_FORMATS)
        offset = file_offset(scene.world_from_scene.points(mesh.vertices))
        for number, level in enumerate([textured, *levels]):
            folder = stage_folder / "files" / (f"lod{number}" if number else "")
            write_textured(level, folder, formats, scene.world_from_scene, offset)
        if levels:
            textured.statistics["lods"] = [level.statistics for level in levels]
        progress.update(0.92, "comparing with photos")
        held_out = {figure["name"] for figure in trained.done["held_out"]}
        rendering = compare_with_photos(
            textured, scene, photos, held_out, stage_folder, progress.span(0.92, 0.97),
            from_gaussians=texture.source == "gaussians", threads=threads,
            exposed=_exposures_fitted(trained),
        )  # fmt: skip
        progress.update(0.97, "rendering the preview")
        write_preview(textured, scene, photos, stage_folder / "preview.png", threads=threads)
        return {"texture": textured.statistics, "mesh_rendering": rendering}

    formats = json.dumps(sorted(job.settings.export))
    return run_stage(
        folder.stages, f"texture-{name}", stage_key(key, formats), progress, work,
        whole=lambda stage_folder: is_whole(stage_folder / "files" / "mesh.npz"),
    )  # fmt: skip


def photo_source(
    texture: TextureSettings, trained: Stage, photos: PhotoStore, threads: int
) -> PhotoSource:
    """Return what a texture is made of: the photos, or renderings of the Gaussians instead."""
    from ...gaussians.files import load_gaussians
    from ...texture.atlas_colors import GaussianPhotos

    if texture.source != "gaussians":
        return photos
    return GaussianPhotos(load_gaussians(trained.folder / "gaussians.npz"), photos, threads=threads)


# -- Bake stage: the photos onto a mesh from elsewhere; its files go to ``baked/NAME`` ------------

BAKE_FILE = "bake.json"
"""Figures of a bake, beside its files."""
BAKE_VERSION = 1


def _exposures_fitted(trained: Stage) -> bool:
    """Tell whether held-out photos were measured in an exposure of their own."""
    return bool(trained.done.get("held_out_exposure_fitted"))


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
        from ...evaluation.photo_views import compare_with_photos
        from ...limits import MAX_IMAGE_SIDE_PX
        from ...mesh.textured_mesh import POLYGONS_FILE, write_polygons
        from ...photos.store import PhotoStore
        from ...scene.scene import load_refined_scene
        from ...texture.bake_onto import BakeChoices, bake_onto, welded
        from ...texture.files import write_textured

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
            threads=threads, dense=dense, free_bytes=free_bytes(stage_folder),
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
            exposed=_exposures_fitted(trained),
        )  # fmt: skip
        figures = {
            "version": BAKE_VERSION, "name": request.name, "vertices": len(textured.mesh.vertices),
            "faces": len(textured.mesh.faces), "faces_given": len(given.faces),
            "udims": list(textured.udims), "texture": textured.statistics,
            "mesh_rendering": rendering,
        }  # fmt: skip
        write_json(files / BAKE_FILE, figures)
        return figures

    baked = run_stage(
        folder.stages, f"bake-{request.name}", key, progress.span(0.0, 0.98), work,
        whole=lambda stage_folder: is_whole(stage_folder / "files" / "mesh.npz"),
    )  # fmt: skip
    with new_result(folder.baked) as new:
        shutil.copytree(baked.folder / "files", new / request.name)
    progress.update(1.0, "finished")
    return baked


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


# -- Export stage: gather the results of all regions in ``result/`` and write the report ----------

REPORTS = ("report.json", "report.md")
"""Replaced last, since they describe all other files."""


def export_results(
    folder: JobFolder, job: JobFile, cameras: Stage, trained: Stage,
    regions: list[tuple[str, Stage, Stage]], summary: dict[str, Any], progress: Progress,
) -> None:  # fmt: skip
    """Fill ``result/``; regions of earlier jobs in the same folder stay.

    Files are replaced together at the end: after a failure the result is unchanged.

    ``summary``: measurements of the whole job, from the runner.
    """
    from ...gaussians.files import load_gaussians, write_splat_ply
    from ...scene.scene import load_refined_scene

    with new_result(folder.result, last=REPORTS) as new:
        progress.update(0.1, "writing the scene")
        scene = load_refined_scene(cameras.folder, trained.folder)
        write_scene_summary(new / "scene.json", scene)
        _place_in_metres(folder.result, new, scene)
        gaussians = load_gaussians(trained.folder / "gaussians.npz")
        write_splat_ply(new / "gaussians.ply", gaussians, scene.world_from_scene)
        for index, (name, meshed, textured) in enumerate(regions):
            progress.update(0.2 + 0.6 * index / len(regions), f"writing {name}")
            target = new / name
            shutil.copytree(textured.folder / "files", target)
            shutil.copy2(meshed.folder / "region.json", target / "region.json")
            for picture in sorted(textured.folder.glob("comparison-*.jpg")):
                shutil.copy2(picture, target / picture.name)
            shutil.copy2(textured.folder / "preview.png", target / "preview.png")
            seconds = {"mesh": meshed.done["seconds"], "texture": textured.done["seconds"]}
            figures = _json_values(
                {**meshed.done, **textured.done, "training": trained.key, "seconds": seconds}
            )
            figures["world"] = _in_world_units(meshed, figures, scene.world_from_scene)
            write_json(target / "figures.json", _json_values(figures))
        shutil.copy2(regions[0][2].folder / "preview.png", new / "preview.png")
        progress.update(0.9, "writing the report")
        # A region of this job or of an earlier one may have the name of this folder.
        if (folder.result / REPORT_FOLDER).is_dir() and not (new / REPORT_FOLDER).exists():
            shutil.copytree(folder.result / REPORT_FOLDER, new / REPORT_FOLDER)
        _training_pictures(trained, new / REPORT_FOLDER)
        # Regions of an earlier training stay on disk; the report covers this training only.
        known = {**_figures_in(folder.result), **_figures_in(new)}
        of_training = {n: f for n, f in sorted(known.items()) if f.get("training") == trained.key}
        report = _json_values({**summary, **_job_report(cameras, trained, regions)})
        write_report(new, report, of_training, earlier=folder.result)


def _place_in_metres(earlier: Path, new: Path, scene: Scene) -> None:
    """Write the first placement of a scene that has metres; one made in Blender stays."""
    start = blender_start(scene.facts.get("georeference"), scene.world_from_scene)
    if start is None:
        return
    path = earlier / PLACEMENT
    with contextlib.suppress(ParseError):  # a damaged one is replaced
        if path.is_file() and read_placement(path, scene.world_from_scene) is not None:
            return
    write_placement(new / PLACEMENT, start, scene.world_from_scene)


def _figures_in(result: Path) -> dict[str, dict[str, Any]]:
    return {path.parent.name: read_json(path) for path in sorted(result.glob("*/figures.json"))}


def _job_report(
    cameras: Stage, trained: Stage, regions: list[tuple[str, Stage, Stage]]
) -> dict[str, Any]:
    times = ("seconds", "processor_seconds")
    training = [*trained.before, trained]
    stages = [*cameras.before, cameras, *training, *(s for _, m, t in regions for s in (m, t))]
    return {
        "stages": [
            {"name": s.name, **{t: s.done.get(t) for t in times}, "reused": s.reused}
            for s in stages
        ],
        "cameras": {k: v for k, v in cameras.done.items() if k != "finished_unix_s"},
        "training": {k: v for k, v in trained.done.items() if k != "finished_unix_s"},
    }


def _in_world_units(
    meshed: Stage, figures: dict[str, Any], world_from_scene: Similarity
) -> dict[str, Any]:
    from ...evaluation.report.region_section import sizes_in_world
    from ...mesh.surface_mesh import load_mesh

    mesh = load_mesh(meshed.folder / "mesh.npz")
    texels = figures.get("texture", {}).get("texels_used", 0)
    return sizes_in_world(mesh.vertices, mesh.faces, world_from_scene, texels)


def _training_pictures(trained: Stage, folder: Path) -> None:
    """Copy the training's pictures into ``folder``, replacing those of an earlier training."""
    from ...evaluation.report.pictures import write_learning_curve

    # Only these files: others may belong to a region with the name of this folder.
    folder.mkdir(exist_ok=True)
    for old in (*folder.glob("held-out-*.jpg"), folder / CURVE):
        old.unlink(missing_ok=True)
    for picture in trained.done.get("pictures", []):
        source = resolve_inside(trained.folder, picture["file"])
        if source is not None and source.is_file():
            shutil.copy2(source, folder / source.name)
    write_learning_curve(trained.done, folder / CURVE)


def _json_values(values: Any) -> Any:
    """Return the values as read back from JSON: lists for tuples, finite numbers only."""
    return json.loads(json.dumps(finite_json(values)))
