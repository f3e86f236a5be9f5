# SPDX-License-Identifier: GPL-3.0-or-later
"""The command ``bake`` through the real worker, on a finished job far from the world's origin."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from gaussian_wrapping_addon.core.jobs.client import JobClient
from gaussian_wrapping_addon.core.jobs.store.job_file import BakeRequest, make_bake_job, read_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.jobs.store.rollback import finished_job
from gaussian_wrapping_addon.core.scene.camera import Similarity
from gaussian_wrapping_addon.core.scene.scene import load_saved_scene, save_poses, save_scene
from tests.core.jobs.finished_sphere import write_finished_sphere
from tests.core.training.small_scene import surface_color
from tests.proofs import first_then_proofs

BATCH = Path(__file__).resolve().parents[4] / "gaussian_wrapping_addon" / "batch.py"
WORLD_FROM_SCENE = Similarity(
    2.0, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([500.0, -300.0, 40.0])
)
BALL = trimesh.creation.icosphere(subdivisions=3)


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> JobFolder:
    """A finished training of a ball around the scene's origin, without a result yet."""
    folder = write_finished_sphere(tmp_path_factory.mktemp("ball"))
    (cameras,) = folder.stages.glob("cameras-*")
    scene = load_saved_scene(cameras)
    save_scene(replace(scene, world_from_scene=WORLD_FROM_SCENE), cameras)
    return folder


def bake(job: JobFolder, mesh: Path, *options: str) -> tuple[int, str]:
    done = subprocess.run(
        [sys.executable, str(BATCH), "bake", "--out", str(job.root), "--mesh", str(mesh),
         "--threads", "1", "--texture-size", "128", *options],
        capture_output=True, text=True, check=False, timeout=200,
    )  # fmt: skip
    return done.returncode, done.stdout + done.stderr


def write_world(path: Path, up: str = "z") -> Path:
    """Write the ball in world coordinates, as another program would."""
    vertices = WORLD_FROM_SCENE.points(BALL.vertices)
    if up == "y":
        vertices = np.stack([vertices[:, 0], vertices[:, 2], -vertices[:, 1]], axis=1)
    trimesh.Trimesh(vertices, BALL.faces, process=False).export(path)
    return path


def psnr_of_colors(job: JobFolder, name: str) -> float:
    """Return the PSNR of the vertices' colours against the ball's own."""
    mesh = trimesh.load(job.baked / name / "mesh.ply", process=False)
    scene = WORLD_FROM_SCENE.inverse().points(mesh.vertices)
    assert np.abs(np.linalg.norm(scene, axis=1) - 1.0).max() < 1e-4
    wanted = 255.0 * surface_color(scene)
    squared = (np.asarray(mesh.visual.vertex_colors)[:, :3] - wanted) ** 2
    return float(10.0 * np.log10(255.0**2 / squared.mean()))


@pytest.mark.parametrize(
    ("name", "up"),
    first_then_proofs([("ball.ply", "z"), ("ball.obj", "y"), ("ball.glb", "y")], names=2),
)
def test_a_file_in_world_coordinates_is_baked_in_its_place(
    name: str, up: str, job: JobFolder, tmp_path: Path
) -> None:
    called = f"from {name}"
    code, said = bake(
        job, write_world(tmp_path / name, up), "--name", called, "--export", "glb,obj"
    )
    assert code == 0, said
    assert "1280 faces, new UVs, 1 x 128 px" in said
    folder = f"from_{name}"
    assert {p.name for p in (job.baked / folder).iterdir()} == {
        "albedo.png", "bake.json", "mesh.glb", "mesh.mtl", "mesh.npz", "mesh.obj", "mesh.ply",
        "transform.json", *(f"comparison-{n}.jpg" for n in (1, 2, 3)),
    }  # fmt: skip
    assert json.loads((job.baked / folder / "bake.json").read_text())["texture"]["coverage"] > 0.95
    assert psnr_of_colors(job, folder) > 20.0
    assert job.read_status().state == "DONE"
    assert not (job.root / "result").exists()


@pytest.mark.proof
def test_own_uvs_and_tiles_come_back_with_udim_names(job: JobFolder, tmp_path: Path) -> None:
    """The first bake's OBJ: its UVs are split over two tiles, and baked onto again."""
    code, said = bake(job, write_world(tmp_path / "ball.ply"), "--name", "first", "--export", "obj")
    assert code == 0, said
    lines = (job.baked / "first" / "mesh.obj").read_text().splitlines()
    uvs = np.array([line.split()[1:] for line in lines if line.startswith("vt ")], float)
    faces = [line for line in lines if line.startswith("f ")]
    moved = [f"vt {u + 1} {v}" for u, v in uvs]
    far = [
        " ".join(["f", *(f"{a}/{int(b) + len(uvs)}/{c}" for a, b, c in
                         (word.split("/") for word in face.split()[1:]))])
        for face in faces[::2]
    ]  # fmt: skip
    kept = [line for line in lines if not line.startswith("f ")]
    # Far from the origin, so that transform.json has an offset.
    shutil.copy(job.baked / "first" / "transform.json", tmp_path)
    path = tmp_path / "mesh.obj"
    path.write_text("\n".join([*kept, *moved, *far, *faces[1::2]]))
    code, said = bake(job, path, "--name", "tiles", "--export", "obj,glb", "--uvs", "own")
    assert code == 0, said
    assert "1280 faces, its own UVs, 2 x 128 px" in said
    baked = job.baked / "tiles"
    assert {p.name for p in baked.glob("albedo*")} == {"albedo.1001.png", "albedo.1002.png"}
    assert json.loads((baked / "bake.json").read_text())["udims"] == [1001, 1002]
    again = (baked / "mesh.obj").read_text()
    assert "map_Kd albedo.1002.png" in (baked / "mesh.mtl").read_text()
    assert max(float(line.split()[1]) for line in again.splitlines() if line[:3] == "vt ") > 1.0
    with np.load(baked / "mesh.npz", allow_pickle=False) as arrays:
        assert arrays["udims"].tolist() == [1001, 1002]
        assert arrays["corner_uvs"].max() <= 1.0
        assert np.bincount(arrays["face_atlas"]).tolist() == [640, 640]
    # Texels have the colours that they have in the one texture.
    first = np.asarray(Image.open(job.baked / "first" / "albedo.png"), int)
    both = [np.asarray(Image.open(baked / f"albedo.{n}.png"), int) for n in (1001, 1002)]
    nearer = np.minimum(*(np.abs(one - first).max(axis=2) for one in both))
    assert np.percentile(nearer, 90) <= 8
    assert psnr_of_colors(job, "tiles") > psnr_of_colors(job, "first") - 0.5


def test_a_finished_bake_is_used_again_and_the_job_stays_what_it_was(
    job: JobFolder, tmp_path: Path
) -> None:
    mesh = write_world(tmp_path / "again.ply")
    assert bake(job, mesh)[0] == 0
    stages = sorted(path.name for path in job.stages.iterdir())
    assert bake(job, mesh)[0] == 0
    assert sorted(path.name for path in job.stages.iterdir()) == stages
    described = read_job(job.job_path)
    assert (described.command, described.settings.texture.size_px) == ("bake", 128)
    assert finished_job(job).settings.export == ("ply",)
    code = subprocess.run(
        [sys.executable, str(BATCH), "resume", str(job.root)], capture_output=True, text=True,
        check=False, timeout=120,
    )  # fmt: skip
    assert code.returncode == 0, code.stdout
    assert "results:" in code.stdout
    # Another texture of the same mesh is another bake.
    assert bake(job, mesh, "--uvs", "new", "--set", "ambient_occlusion=on")[0] == 0
    assert (job.baked / "again" / "occlusion.png").is_file()
    assert len(list(job.stages.glob("bake-again-*"))) == 2


@pytest.mark.parametrize(
    ("content", "options", "code", "words"),
    [(b"v 0 0 0\nv 1 0 0\nv nan 1 0\nf 1 2 3\n", (), 3, "bad.obj, vertex 2: is not finite"),
     (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", (), 3, "No photo sees the mesh"),
     (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", ("--uvs", "own"), 3, "The mesh has no UVs"),
     (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 5 0\nvt 0 5\nf 1/1 2/2 3/3\n", (), 3,
      "Face 0 of the mesh has UVs"),
     (b"", ("--export", "usd"), 2, "cannot be written"),
     (b"", ("--faces", "9", "--uvs", "own"), 2, "cannot keep its UVs"),
     (b"", ("--sidecar", "none.json"), 3, "none.json does not exist"),
     (b"", ("--texture-size", "7"), 2, "--texture-size is out of range")],
)  # fmt: skip
def test_what_cannot_be_baked_is_refused_soon_and_leaves_nothing(
    content: bytes, options: tuple[str, ...], code: int, words: str, job: JobFolder, tmp_path: Path
) -> None:
    path = tmp_path / "bad.obj"
    path.write_bytes(content)
    before = job.job_path.read_bytes(), sorted(job.stages.iterdir()), sorted(job.baked.glob("*"))
    found, said = bake(job, path, *options)
    assert (found, words in said) == (code, True), said
    assert "Traceback" not in said
    after = job.job_path.read_bytes(), sorted(job.stages.iterdir()), sorted(job.baked.glob("*"))
    assert after == before
    assert job.read_status().state == "DONE"


def test_refined_poses_are_used_where_the_training_has_them(tmp_path: Path) -> None:
    """With poses that look a quarter turn away, the ball has the colours of its other side."""
    folder = write_finished_sphere(tmp_path / "job")
    (cameras,), (trained,) = (list(folder.stages.glob(f"{n}-*")) for n in ("cameras", "train"))
    scene = load_saved_scene(cameras)
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    poses = np.stack([view.camera.cam_from_world for view in scene.views])
    poses[:, :, :3] = poses[:, :, :3] @ turn.T
    save_poses(trained, poses)
    mesh = tmp_path / "ball.ply"
    BALL.export(mesh)
    code, said = bake(folder, mesh, "--set", "texture_source=photos")
    assert code == 0, said
    loaded = trimesh.load(folder.baked / "ball" / "mesh.ply", process=False)
    colors = np.asarray(loaded.visual.vertex_colors)[:, :3].astype(float)
    turned = ((colors - 255.0 * surface_color(loaded.vertices @ turn)) ** 2).mean()
    straight = ((colors - 255.0 * surface_color(loaded.vertices)) ** 2).mean()
    assert turned < 0.2 * straight
    shutil.rmtree(trained)
    code, said = bake(folder, mesh)
    assert (code, "training" in said) == (3, True), said


@pytest.mark.proof
def test_a_cancelled_bake_leaves_no_files_and_is_resumed(job: JobFolder, tmp_path: Path) -> None:
    mesh = write_world(tmp_path / "large.ply")
    request = BakeRequest(str(mesh), "cancelled")
    client = JobClient.start(
        job.root, make_bake_job(finished_job(job), request), python=sys.executable
    )
    end_s = time.monotonic() + 60.0
    while client.poll().stage != "bake" and time.monotonic() < end_s:
        time.sleep(0.05)
    assert client.poll().stage == "bake"
    client.cancel()
    assert client.wait(60.0).state == "CANCELLED"
    assert not (job.baked / "cancelled").exists()
    resumed = JobClient.resume(job.root, python=sys.executable)
    assert resumed.wait(120.0).state == "DONE"
    assert (job.baked / "cancelled").is_dir()
