# SPDX-License-Identifier: GPL-3.0-or-later
"""Judge one run against the ground truth.

``python -m benchmarks.score SCENE OUT.json [--mesh FOLDER --job FOLDER [--stages]]``;
without a mesh, the true surface itself is judged, which shows what each protocol can reach.

Everything is judged in world coordinates with the known poses: no alignment. The test views of the
scene were never given to the job.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from gaussian_wrapping_addon.core.evaluation.command import read_cameras
from gaussian_wrapping_addon.core.evaluation.mesh_rendering import render_views
from gaussian_wrapping_addon.core.evaluation.surface_scores import (
    Truth,
    read_truth,
    score_protocols,
)
from gaussian_wrapping_addon.core.field.vacancy import VacancyField
from gaussian_wrapping_addon.core.files import finite_json, read_json, write_json
from gaussian_wrapping_addon.core.gaussians.files import load_gaussians
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians, without_blur
from gaussian_wrapping_addon.core.image_metrics import lpips_if_ready, score_images
from gaussian_wrapping_addon.core.jobs.stages.meshing import field_views
from gaussian_wrapping_addon.core.jobs.store.job_file import read_job
from gaussian_wrapping_addon.core.mesh.depth_buffer import depth_buffer
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.mesh.textured_mesh import AtlasMaps, TexturedMesh
from gaussian_wrapping_addon.core.photos.store import PhotoStore
from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.scene.camera import Camera, Similarity
from gaussian_wrapping_addon.core.scene.scene import Scene, evenly_spaced, load_saved_scene
from gaussian_wrapping_addon.core.stereo.depth_maps import FILE_NAME as PRIORS_FILE
from gaussian_wrapping_addon.core.texture.file_checks import atlas_file

from .field_errors import depth_errors, mesh_depths, rendered_depths, vacancy_errors
from .runs import THRESHOLD_SHARES

SURFACE_SAMPLES = 200_000
VACANCY_SAMPLES = 4000
DEPTH_VIEWS = 8
"""Training photos whose depths are judged."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the scores."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--mesh", type=Path, help="folder with mesh.npz and albedo.png")
    parser.add_argument("--job", type=Path, help="folder of the job that made it")
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--stages", action="store_true", help="also what lies before the mesh")
    options = parser.parse_args(arguments)
    begun_s = time.monotonic()
    if options.mesh is None:
        scores = judge_truth(options.scene, options.threads)
    else:
        scores = judge(options.mesh, options.scene, options.job, options.threads, options.stages)
    scores["seconds_scoring"] = time.monotonic() - begun_s
    write_json(options.out, scores)


def judge_truth(scene_folder: Path, threads: int) -> dict[str, Any]:
    """Return the surface scores of the true surface itself."""
    truth = read_truth(scene_folder)
    diagonal = _diagonal(scene_folder)
    thresholds = [share * diagonal for share in THRESHOLD_SHARES]
    cameras = read_cameras(scene_folder)
    surfaces = score_protocols(
        truth.vertices, truth.faces, truth, cameras, thresholds, count=SURFACE_SAMPLES, seed=0,
        threads=threads,
    )  # fmt: skip
    return {
        "diagonal": diagonal,
        "surface": {name: score.to_json() for name, score in surfaces.items()},
    }


def judge(mesh: Path, scene_folder: Path, job: Path, threads: int, stages: bool) -> dict[str, Any]:
    """Return all scores as plain JSON values.

    Parameters
    ----------
    mesh : Path
        Folder with ``mesh.npz`` and ``albedo.png``.
    scene_folder : Path
        Ground truth (docs/file-formats.md).
    job : Path
        The job folder, for the scene frame, cameras and Gaussians.
    stages : bool
        Also judge Gaussians, depth and vacancy.
    """
    scene = load_saved_scene(stage_folder(job, "cameras"))
    truth = read_truth(scene_folder)
    diagonal = _diagonal(scene_folder)
    thresholds = [share * diagonal for share in THRESHOLD_SHARES]
    textured = read_textured(mesh)
    world = scene.world_from_scene
    views = test_views(scene_folder, world.inverse())
    cameras = [camera.moved(world) for camera in scene.cameras]
    vertices = world.points(textured.mesh.vertices)
    surfaces = score_protocols(
        vertices, textured.mesh.faces, truth, cameras, thresholds, count=SURFACE_SAMPLES, seed=0,
        threads=threads,
    )  # fmt: skip
    true_vertices = world.inverse().points(truth.vertices)
    masks = [true_mask(true_vertices, truth.faces, camera, threads) for camera, _ in views]
    rendered = render_views(
        textured, [c for c, _ in views], [i for _, i in views], masks=masks,
        lpips=lpips_if_ready()[0], threads=threads,
    )  # fmt: skip
    scores: dict[str, Any] = {
        "diagonal": diagonal,
        "thresholds": thresholds,
        "vertices": len(vertices),
        "faces": len(textured.mesh.faces),
        "texture_side_px": int(textured.albedo.shape[0]),
        "surface": {name: score.to_json() for name, score in surfaces.items()},
        "texture": rendered.to_json(),
    }
    if stages:
        gaussians = load_gaussians(stage_folder(job, "train") / "gaussians.npz")
        seen = mesh_scene(job, scene)
        settings = read_job(job / "job.json").settings
        sharp = without_blur(
            gaussians, settings.meshing.blur_variance, settings.training.filter_variance
        )
        scores |= judge_stages(gaussians, sharp, seen, truth, views, masks, thresholds, threads)
        scores["depths"] = judge_depths(
            job, scene, gaussians, textured.mesh, truth, thresholds, threads
        )
    return scores


def judge_depths(
    job: Path, scene: Scene, gaussians: OrientedGaussians, mesh: SurfaceMesh, truth: Truth,
    thresholds: Sequence[float], threads: int,
) -> dict[str, Any]:  # fmt: skip
    """Return the errors of depths in training photos, to see where accuracy is won or lost.

    ``start``: what matching the photos knew; ``trained``: of the Gaussians, with the opacities that
    they were trained with; ``mesh``. All of the same pixels, those of up to :data:`DEPTH_VIEWS`
    photos. Empty where a training kept no confirmed depths.
    """
    path = stage_folder(job, "train") / PRIORS_FILE
    if not path.is_file():
        return {}
    photos = PhotoStore(scene, read_job(job / "job.json").settings.training.max_image_px)
    start = []
    with np.load(path, allow_pickle=False) as arrays:
        views = [int(name.partition(".")[2]) for name in arrays.files if name.startswith("known.")]
        for view in evenly_spaced(sorted(views), DEPTH_VIEWS):
            depth = arrays[f"known.{view}"]
            start.append((photos.camera(view, photos.camera(view).width // depth.shape[1]), depth))
    cameras = [camera for camera, _ in start]
    inverse = scene.world_from_scene.inverse()
    true = inverse.points(truth.vertices)
    limits = [inverse.scale * limit for limit in thresholds]
    stages = {
        "start": start,
        "trained": rendered_depths(gaussians, cameras, threads),
        "mesh": mesh_depths(mesh.vertices, mesh.faces, cameras, threads or 1),
    }
    found = {
        name: depth_errors(depths, true, truth.faces, limits, threads=threads)
        for name, depths in stages.items()
    }
    share = THRESHOLD_SHARES[-1] / limits[-1]  # of the diagonal, per scene unit
    return {
        name: {
            "found": errors.found,
            "median": finite_json(errors.median * share),
            "within": list(errors.within),
        }
        for name, errors in found.items()
    }


def judge_stages(
    gaussians: OrientedGaussians,
    sharp: OrientedGaussians,
    scene: Scene,
    truth: Truth,
    views: Sequence[tuple[Camera, np.ndarray]],
    masks: Sequence[np.ndarray],
    thresholds: Sequence[float],
    threads: int,
) -> dict[str, Any]:
    """Return the errors of images and depth of the Gaussians, and of the vacancy of sharp ones.

    Lengths are shares of the crop volume's diagonal, as thresholds are.
    """
    inverse = scene.world_from_scene.inverse()
    limits = [inverse.scale * limit for limit in thresholds]
    shares = 1.0 / (limits[-1] / THRESHOLD_SHARES[-1])  # of the diagonal, per scene unit
    whole, inside, similar = [], [], []
    for (camera, photo), mask in zip(views, masks, strict=True):
        options = RenderOptions(depth=False, threads=threads)
        image = render(gaussians, camera, options).color.numpy()
        figures = score_images(image, photo, threads=threads)
        whole.append(figures.psnr)
        similar.append(figures.ssim)
        if mask.any():
            inside.append(score_images(image, photo, mask, threads=threads).psnr)
    cameras = [camera for camera, _ in views]
    depth = depth_errors(
        rendered_depths(gaussians, cameras, threads), inverse.points(truth.vertices), truth.faces,
        limits, threads=threads,
    ).to_json()  # fmt: skip
    seen = np.flatnonzero(truth.visible())
    chosen = np.random.default_rng(0).choice(seen, min(VACANCY_SAMPLES, len(seen)), replace=False)
    field = VacancyField(sharp.arrays(), scene.cameras, threads=threads)
    vacancy = vacancy_errors(
        field, inverse.points(truth.samples.points[chosen]),
        inverse.directions(truth.samples.normals[chosen]), limits,
    ).to_json()  # fmt: skip
    for values, names in (
        (depth, ("median", "percentile_95")),
        (vacancy, ("median", "median_offset")),
    ):
        for name in names:
            values[name] = finite_json(values[name] * shares)
    return {
        "gaussians": {
            "count": len(gaussians),
            "psnr": float(np.mean(whole)),
            "ssim": float(np.mean(similar)),
            "object_psnr": float(np.mean(inside)) if inside else None,
        },
        "depth": depth,
        "vacancy": vacancy,
    }


def _diagonal(scene_folder: Path) -> float:
    return float(read_json(scene_folder / "scene.json")["diagonal"])


def true_mask(vertices: np.ndarray, faces: np.ndarray, camera: Camera, threads: int) -> np.ndarray:
    """Return (h, w) bool: pixels whose centre's ray meets the true surface."""
    faces = np.ascontiguousarray(faces, np.int32)
    return depth_buffer(vertices, faces, camera, threads=threads or 1).face >= 0


def test_views(folder: Path, scene_from_world: Similarity) -> list[tuple[Camera, np.ndarray]]:
    """Return the test cameras in the scene frame with their (h, w, 3) uint8 photos."""
    values = read_json(folder / "test" / "cameras.json")["cameras"]
    views = []
    for entry in values:
        camera = Camera.from_json(entry)
        with Image.open(folder / "test" / "images" / camera.name) as photo:
            views.append((camera.moved(scene_from_world), np.asarray(photo.convert("RGB"))))
    return views


def read_textured(folder: Path) -> TexturedMesh:
    """Read the textured mesh that a job exported (scene frame)."""
    with np.load(folder / "mesh.npz", allow_pickle=False) as arrays:
        mesh = SurfaceMesh(arrays["vertices"], arrays["faces"])
        uvs = arrays["corner_uvs"]
        owner = arrays["face_atlas"] if "face_atlas" in arrays.files else None
    maps = []
    for number in range(1 if owner is None else int(owner.max()) + 1):
        with Image.open(folder / atlas_file("albedo", number)) as image:
            maps.append(AtlasMaps(np.asarray(image.convert("RGB"))))
    return TexturedMesh.of(mesh, uvs, owner, maps, {})


def mesh_scene(job: Path, scene: Scene) -> Scene:
    """Return the scene with the views only whose cameras the job's meshes are made from."""
    settings = read_job(job / "job.json").settings
    photos = PhotoStore(scene, settings.training.max_image_px)
    views = field_views(scene, photos, settings.training.holdout_every, settings.meshing.cameras)
    return dataclasses.replace(scene, views=tuple(scene.views[index] for index in views))


def stage_folder(job: Path, name: str) -> Path:
    """Return the folder of the only finished stage of a name."""
    (folder,) = [path.parent for path in (job / "stages").glob(f"{name}-*/done.json")]
    return folder


if __name__ == "__main__":
    main()
