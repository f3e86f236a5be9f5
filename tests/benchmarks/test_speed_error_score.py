# SPDX-License-Identifier: GPL-3.0-or-later
"""Scores of a run whose every part is known: the true ball as mesh, Gaussians on its surface."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from benchmarks.score import judge, judge_truth
from benchmarks.speed_vs_error import write_comparison
from gaussian_wrapping_addon.core.evaluation.surface_scores import read_truth
from gaussian_wrapping_addon.core.files import write_json
from gaussian_wrapping_addon.core.gaussians.files import save_gaussians
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.jobs.store.job_file import make_job, write_job
from gaussian_wrapping_addon.core.loading.load import load_scene
from gaussian_wrapping_addon.core.mesh.depth_buffer import depth_buffer
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.regions.scene_regions import write_region
from gaussian_wrapping_addon.core.regions.shapes import Region
from gaussian_wrapping_addon.core.scene.scene import load_saved_scene, save_scene
from gaussian_wrapping_addon.core.settings import JobSettings
from tests.core.field.field_scenes import unit_sphere
from tests.synthetic import write_ball_scene

OFFSET, SCALE = (5e5, 4e6, 100.0), 20.0
SIDE = 1.1
"""Half of the crop's edge, in radii of the ball."""
THICKNESS = 0.01
"""Standard deviation of the Gaussians along the normal, radii."""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Write a ground-truth scene and the folder of a run that hit it exactly."""
    root = tmp_path_factory.mktemp("score")
    scene_folder, folder = root / "scene", root / "run"
    ball = write_ball_scene(scene_folder, photos=12, offset=OFFSET, scale=SCALE)
    mesh = trimesh.creation.icosphere(5, 1.0)
    vertices = SCALE * mesh.vertices + ball.offset
    points = unit_sphere(5000)
    np.savez(
        scene_folder / "truth.npz",
        vertices=vertices, faces=mesh.faces,
        points=vertices[mesh.faces[::5]].mean(1), normals=mesh.face_normals[::5],
        thin=np.zeros(len(mesh.faces[::5]), bool), seen=np.full(len(mesh.faces[::5]), 5, np.int32),
    )  # fmt: skip
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    region = Region("crop", SCALE * SIDE * corners + ball.offset)
    write_region(scene_folder / "crop.json", region)
    write_json(scene_folder / "scene.json", {"diagonal": region.diagonal})
    (scene_folder / "test" / "images").mkdir(parents=True)
    for camera in ball.cameras[:2]:
        source = scene_folder / "images" / camera.name
        (scene_folder / "test" / "images" / camera.name).write_bytes(source.read_bytes())
    cameras = [camera.to_json() for camera in ball.cameras[:2]]
    write_json(scene_folder / "test" / "cameras.json", {"cameras": cameras})

    job = folder / "out" / "stages"
    job.mkdir(parents=True)
    write_job(folder / "out" / "job.json", make_job("wrap", scene_folder, JobSettings()))
    for name in ("cameras-0", "train-0"):
        (job / name).mkdir(parents=True)
        write_json(job / name / "done.json", {})
    scene = load_scene(scene_folder, job / "cameras-0", Progress(), seed=0, threads=1)
    save_scene(scene, job / "cameras-0")
    into = scene.world_from_scene.inverse()
    radius = into.scale * SCALE
    gaussians = on_ball(into.points(SCALE * points + ball.offset), into.directions(points), radius)
    save_gaussians(job / "train-0" / "gaussians.npz", gaussians)
    (folder / "mesh").mkdir()
    uvs = np.tile(
        np.array([[0.2, 0.2], [0.8, 0.2], [0.2, 0.8]], np.float32), (len(mesh.faces), 1, 1)
    )
    np.savez(
        folder / "mesh" / "mesh.npz", vertices=into.points(vertices), faces=mesh.faces,
        corner_uvs=uvs,
    )  # fmt: skip
    Image.new("RGB", (64, 64), (134, 134, 134)).save(folder / "mesh" / "albedo.png")
    return scene_folder, folder


def on_ball(means: np.ndarray, normals: np.ndarray, radius: float) -> OrientedGaussians:
    """Return opaque discs on a sphere; their spacing is a tenth of their width."""
    count = len(means)
    wide, thin = 0.04 * radius, THICKNESS * radius
    # The quaternion that turns z into the normal: half way between them.
    half = np.add(normals, [0.0, 0.0, 1.0])
    half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-12)
    quats = np.column_stack([half[:, 2], -half[:, 1], half[:, 0], np.zeros(count)])
    tensors = {
        "means": means,
        "log_scales": np.tile(np.log([wide, wide, thin]), (count, 1)),
        "quats": quats,
        "opacity_logits": np.full(count, math.log(0.9 / 0.1)),
        "sh": np.zeros((count, 1, 3)),
        "orientation": np.column_stack([normals, np.full(count, 2.0)]),
        "filter_3d": np.zeros(count),
    }
    return OrientedGaussians(
        **{k: torch.tensor(v, dtype=torch.float32) for k, v in tensors.items()}
    )


def test_the_true_mesh_has_the_best_scores(run: tuple[Path, Path]) -> None:
    scene, folder = run
    scores = judge(folder / "mesh", scene, folder / "out", 1, stages=True)
    uniform = scores["surface"]["uniform"]
    assert uniform["f1"] == [1.0, 1.0, 1.0]
    assert uniform["chamfer_mean"] < 1e-7 * scores["diagonal"]
    assert scores["surface"]["scan"]["precision"] == [1.0, 1.0, 1.0]
    # A grey ball against the patterned one: far from right, not absurd.
    assert 8.0 < scores["texture"]["psnr"] < 25.0
    covered = [view["covered"] for view in scores["texture"]["views"]]
    assert covered == pytest.approx([1.0, 1.0], abs=0.1)  # outlines are covered in part


def test_stages_are_judged_in_shares_of_the_diagonal(run: tuple[Path, Path]) -> None:
    """The isosurface of such discs stands about two of their thicknesses outside.

    See docs/method.md, section 10.3.
    """
    scene, folder = run
    scores = judge(folder / "mesh", scene, folder / "out", 1, stages=True)
    outside = 2.0 * THICKNESS / (2.0 * SIDE * math.sqrt(3.0))
    assert scores["vacancy"]["found"] > 0.95
    assert scores["vacancy"]["median_offset"] == pytest.approx(outside, rel=0.35)
    assert scores["vacancy"]["median"] == pytest.approx(scores["vacancy"]["median_offset"], rel=0.1)
    assert scores["depth"]["found"] > 0.9
    assert outside / 2 < scores["depth"]["median"] < 4 * outside
    assert scores["gaussians"]["count"] == 5000
    assert scores["gaussians"]["object_psnr"] > scores["gaussians"]["psnr"] - 10.0


def test_depths_of_start_training_and_mesh_stand_side_by_side(run: tuple[Path, Path]) -> None:
    """The start is the true depth of one photo, and 0.7 % of the diagonal behind it in another."""
    scene_folder, folder = run
    job = folder / "out"
    scene = load_saved_scene(job / "stages" / "cameras-0")
    ball = trimesh.creation.icosphere(5, 1.0)
    world = scene.world_from_scene
    truth = read_truth(scene_folder)
    layers, shown = {}, []
    for view, behind in ((0, 0.0), (7, 0.007)):
        depth = depth_buffer(
            world.inverse().points(truth.vertices), ball.faces.astype(np.int32),
            scene.cameras[view], threads=1,
        ).depth  # fmt: skip
        shown.append(np.isfinite(depth).sum())
        stretch = np.linalg.norm(scene.cameras[view].rays(), axis=2)
        diagonal = 2.0 * SIDE * SCALE * math.sqrt(3.0) / world.scale
        far = depth + behind * diagonal / stretch
        layers[f"known.{view}"] = np.where(np.isfinite(depth), far, 0.0).astype(np.float32)
    priors = job / "stages" / "train-0" / "depth_priors.npz"
    assert judge(folder / "mesh", scene_folder, job, 1, stages=True)["depths"] == {}
    np.savez(priors, **layers)
    try:
        scores = judge(folder / "mesh", scene_folder, job, 1, stages=True)
        depths = scores["depths"]
    finally:
        priors.unlink()
    assert depths["start"]["found"] == depths["mesh"]["found"] == 1.0
    exact = shown[0] / sum(shown)
    assert depths["start"]["within"] == pytest.approx([exact, exact, 1.0], abs=1e-9)
    assert depths["start"]["median"] < 0.0071
    assert depths["mesh"]["within"] == [1.0, 1.0, 1.0]
    assert depths["mesh"]["median"] < 1e-6
    assert depths["trained"]["median"] == pytest.approx(scores["depth"]["median"], rel=0.1)


def test_the_truth_judged_by_itself(run: tuple[Path, Path]) -> None:
    scores = judge_truth(run[0], 1)
    assert scores["surface"]["uniform"]["f1"] == [1.0, 1.0, 1.0]
    assert scores["diagonal"] == pytest.approx(2 * SIDE * SCALE * math.sqrt(3.0))


def test_the_picture_of_an_exact_mesh_shows_no_error(
    run: tuple[Path, Path], tmp_path: Path
) -> None:
    scene, folder = run
    write_comparison(scene, [("draft", folder)], tmp_path / "p.jpg")
    with Image.open(tmp_path / "p.jpg") as picture:
        pixels = np.asarray(picture).astype(int)
    height, width = pixels.shape[0] // 2, pixels.shape[1] // 2
    errors = pixels[height + 20 :, width:]  # below the words
    blue = (errors[..., 2] > errors[..., 0] + 40) & (errors[..., 2] > errors[..., 1] + 20)
    red = (errors[..., 0] > errors[..., 1] + 60) & (errors[..., 0] > errors[..., 2] + 60)
    assert blue.mean() > 0.1
    assert not red.any()
