# SPDX-License-Identifier: GPL-3.0-or-later
"""Texture stage: bake a region's textures, write its files, and compare it with the photos."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ...array_file import is_whole
from ...export_formats import RESULT_FORMATS
from ...progress import Progress
from ...settings import to_json
from ..store.job_file import JobFile
from ..store.job_folder import JobFolder
from ..store.stage_folder import STAGE_VERSIONS, Stage, run_stage, stage_key
from .mesh_stage import DENSE_MESH

OCCLUSION_VERSION = 2
"""Raise it where ambient occlusion alone is computed otherwise: other textures stay valid."""


def run_texture(
    folder: JobFolder,
    job: JobFile,
    name: str,
    cameras: Stage,
    trained: Stage,
    meshed: Stage,
    progress: Progress,
    *,
    threads: int,
) -> Stage:
    """Texture the mesh of a region and write its files, or re-use the finished stage.

    Raises
    ------
    ResourceError
        Memory or disk space is not sufficient.
    """
    texture = job.settings.texture
    occlusion = [OCCLUSION_VERSION] if texture.ambient_occlusion == "on" else []
    key = stage_key(STAGE_VERSIONS["texture"], meshed.key, to_json(texture), *occlusion)

    def work(stage_folder: Path, progress: Progress) -> dict[str, Any]:
        from ...dataset.photo_source import PhotoSource
        from ...dataset.photos.photo_store import PhotoStore
        from ...dataset.refined_scene import load_refined_scene
        from ...evaluation.views.photo_comparison import compare_with_photos
        from ...evaluation.views.preview import write_preview
        from ...files import read_json
        from ...limits import MAX_IMAGE_SIDE_PX
        from ...mesh.mesh_file import load_mesh
        from ...regions.region import parse_region
        from ...regions.scene_region import region_in_scene
        from ...texture.detail.levels_of_detail import levels_of_detail
        from ...texture.files.textured_files import file_offset, write_textured
        from ...texture.texture_mesh import texture_mesh
        from .region_meshing import free_bytes

        scene = load_refined_scene(cameras.folder, trained.folder)
        photos = PhotoStore(scene, MAX_IMAGE_SIDE_PX)
        mesh = load_mesh(meshed.folder / "mesh.npz")
        dense_path = meshed.folder / DENSE_MESH
        dense = load_mesh(dense_path) if dense_path.is_file() else None
        source: PhotoSource = photos
        if texture.source == "gaussians":
            from ...gaussians.gaussian_file import load_gaussians
            from ...texture.bake.gaussian_photos import GaussianPhotos

            trained_file = trained.folder / "gaussians.npz"
            source = GaussianPhotos(load_gaussians(trained_file), photos, threads=threads)
        coarse_from = 0.7 if texture.lods else 0.9
        textured = texture_mesh(
            mesh, scene, source, texture, stage_folder, progress.span(0.0, coarse_from),
            threads=threads, dense=dense, free_bytes=free_bytes(stage_folder, threads),
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
        )  # fmt: skip
        progress.update(0.97, "rendering the preview")
        write_preview(textured, scene, photos, stage_folder / "preview.png", threads=threads)
        return {"texture": textured.statistics, "mesh_rendering": rendering}

    formats = json.dumps(sorted(job.settings.export))
    return run_stage(
        folder.stages, f"texture-{name}", stage_key(key, formats), progress, work,
        whole=lambda stage_folder: is_whole(stage_folder / "files" / "mesh.npz"),
    )  # fmt: skip
