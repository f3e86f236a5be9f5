# SPDX-License-Identifier: GPL-3.0-or-later
"""All stages on a tiny scene with exact ground truth, through the command line."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from gaussian_wrapping_addon.core.evaluation.report.figures import figure_rows
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.regions.scene_regions import write_region
from gaussian_wrapping_addon.core.regions.shapes import Region
from gaussian_wrapping_addon.core.scene.camera import Similarity
from tests.synthetic import BALL_RADIUS, BallScene, write_ball_scene

BATCH = Path(__file__).resolve().parents[3] / "gaussian_wrapping_addon" / "batch.py"
OFFSET, SCALE = (5e5, 4e6, 100.0), 20.0
Wrapped = tuple[BallScene, Path, str]


def batch(*arguments: str, timeout_s: float = 240) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, str(BATCH), *arguments],
        capture_output=True, text=True, check=False, timeout=timeout_s,
    )  # fmt: skip


def write_box(
    path: Path, scene: BallScene, half: float, center: tuple[float, float, float]
) -> Path:
    """Write a region file: an axis-aligned box in world coordinates, given in ball units."""
    low, high = (scene.scale * (np.array(center) + s) + scene.offset for s in (-half, half))
    write_region(path, Region.box(path.stem, low, high))
    return path


def wrap_words(root: Path, out: Path) -> list[str]:
    return [
        "wrap", str(root / "input"), "--out", str(out), "--preset", "draft", "--iterations", "500",
        "--max-gaussians", "6000", "--region", str(root / "ball.json"), "--points", "4000",
        "--texture-size", "512", "--export", "glb,obj,ply", "--no-blend",
    ]  # fmt: skip


@pytest.fixture(scope="module")
def wrapped(tmp_path_factory: pytest.TempPathFactory) -> Wrapped:
    """Train the ball scene once (far from the origin, scaled) and mesh a box around the ball."""
    root = tmp_path_factory.mktemp("ball")
    scene = write_ball_scene(root / "input", offset=OFFSET, scale=SCALE)
    write_box(root / "ball.json", scene, 1.3, (0, 0, 0.35))
    done = batch(*wrap_words(root, root / "out"))
    assert done.returncode == 0, done.stdout + done.stderr
    return scene, root, done.stdout


def world_mesh(root: Path, region: str) -> trimesh.Trimesh:
    result = root / "out" / "result"
    with np.load(result / region / "mesh.npz", allow_pickle=False) as arrays:
        vertices, faces = arrays["vertices"], arrays["faces"]
    frame = json.loads((result / "scene.json").read_text())["world_from_scene"]
    world = Similarity.from_json(frame).points(vertices)
    return trimesh.Trimesh(world, faces, process=False)


def test_the_mesh_is_closed_and_lies_on_the_ball(wrapped: Wrapped) -> None:
    scene, root, _ = wrapped
    mesh = world_mesh(root, "ball")
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0
    local = (mesh.triangles_center - scene.offset) / scene.scale  # ball units
    # Judge the part that photos see and that belongs to the ball: well above the floor.
    upper = local[:, 2] > -0.2
    assert upper.sum() > 1000
    distance = np.abs(np.linalg.norm(local[upper], axis=1) - BALL_RADIUS)
    assert np.median(distance) < 0.02
    assert np.percentile(distance, 95) < 0.08
    # The ball is covered from all sides, not only met by what there is of the mesh.
    generator = np.random.default_rng(0)
    truth = generator.normal(size=(2000, 3))
    truth /= np.linalg.norm(truth, axis=1, keepdims=True)
    truth = truth[truth[:, 2] > 0.0]
    _, gap, _ = trimesh.proximity.closest_point(mesh, scene.scale * truth + scene.offset)
    assert np.percentile(gap / scene.scale, 95) < 0.08


def test_result_files_are_there_and_agree(wrapped: Wrapped) -> None:
    _, root, output = wrapped
    result = root / "out" / "result"
    for name in ("gaussians.ply", "report.json", "report.md", "preview.png", "scene.json"):
        assert (result / name).stat().st_size > 0, name
    for name in ("mesh.ply", "mesh.glb", "mesh.obj", "albedo.png", "mesh.npz", "region.json"):
        assert (result / "ball" / name).stat().st_size > 0, name
    report = json.loads((result / "report.json").read_text())
    number = re.compile(r"[\d,]+(\.\d+)?(e[+-]\d+)?")
    assert [row for row in figure_rows(report) if number.fullmatch(row[1]) and not row[2]] == []
    figures = report["regions"]["ball"]
    assert figures["statistics"]["closed"] is True
    assert report["training"]["held_out_psnr"] > 22.0
    assert {s["name"] for s in report["stages"]} == {
        "cameras", "train", "mesh-ball", "texture-ball",
    }  # fmt: skip
    assert figures["texture"]["coverage"] > 0.6
    world = figures["world"]
    mesh = world_mesh(root, "ball")
    np.testing.assert_allclose(world["size"], np.ptp(mesh.vertices, axis=0), rtol=1e-6)
    assert world["area"] == pytest.approx(mesh.area, rel=1e-6)
    provenance = figures["provenance"]
    residuals = [provenance[f"level_error_{k}"] for k in ("median", "p95", "p99", "max")]
    assert residuals == sorted(residuals)
    ply = trimesh.load(result / "ball" / "mesh.ply", process=False)
    assert np.abs(ply.vertices - mesh.vertices).max() < 1e-6 * SCALE
    assert "PSNR" in output
    assert "warning (" in output or not report["warnings"]
    text = (result / "report.md").read_text(encoding="utf-8")
    links = re.findall(r"!\[[^\n]*?\]\(([^)\s]+)\)", text)
    pictures = [f"report/{picture['file']}" for picture in report["training"]["pictures"]]
    comparisons = [f"ball/{name}" for name in figures["mesh_rendering"]["pictures"]]
    assert pictures
    assert comparisons
    wanted = ["preview.png", "report/learning-curve.svg", "ball/preview.png"]
    assert sorted(set(links)) == sorted([*wanted, *pictures, *comparisons])
    for link in links:
        assert (result / link).stat().st_size > 0, link
    for picture in pictures:
        with Image.open(result / picture) as image:
            assert image.width <= 1500


def test_another_region_and_resolution_needs_no_training(wrapped: Wrapped) -> None:
    scene, root, _ = wrapped
    box = write_box(root / "cap.json", scene, 0.6, (0, 0, 1.0))
    before = {p: p.stat().st_mtime_ns for p in (root / "out" / "stages").glob("train-*/*")}
    blend = root / "out" / "result" / "scene.blend"
    blend.write_bytes(b"shows the ball alone")
    done = batch(
        "mesh", "--out", str(root / "out"), "--region", str(box),
        "--edge-length", str(0.04 * SCALE), "--texture-size", "256", "--no-blend",
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    report = json.loads((root / "out" / "result" / "report.json").read_text())
    assert not blend.exists(), "a file that shows another result"
    assert "scene.blend showed the previous result" in done.stdout
    reused = {s["name"]: s["reused"] for s in report["stages"]}
    assert reused["cameras"]
    assert reused["train"]
    assert {p: p.stat().st_mtime_ns for p in before} == before
    assert set(report["regions"]) == {"ball", "cap"}
    mesh = world_mesh(root, "cap")
    assert mesh.is_watertight
    local = (mesh.vertices - scene.offset) / scene.scale
    assert np.abs(local[:, :2]).max() < 0.6 + 1e-5  # regions lie on the grid of the scene
    edges = mesh.edges_unique_length / scene.scale
    assert 0.02 < np.median(edges) < 0.08


def test_a_region_without_surface_leaves_the_finished_job_as_it_was(wrapped: Wrapped) -> None:
    scene, root, _ = wrapped
    folder = JobFolder(root / "out")
    box = write_box(root / "nothing.json", scene, 0.2, (0, 0, 3.0))
    before = folder.job_path.read_bytes(), sorted(folder.stages.iterdir())
    shown = {p: p.read_bytes() for p in folder.result.rglob("*") if p.is_file()}
    done = batch("mesh", "--out", str(folder.root), "--region", str(box), "--no-blend")
    assert done.returncode == 3, done.stdout + done.stderr
    assert "nothing" in done.stdout
    assert "the job and its result are unchanged" in done.stdout
    assert (folder.job_path.read_bytes(), sorted(folder.stages.iterdir())) == before
    assert folder.read_status().state == "DONE"
    assert {p: p.read_bytes() for p in folder.result.rglob("*") if p.is_file()} == shown
    again = batch("resume", str(folder.root), "--no-blend")
    assert again.returncode == 0, again.stdout + again.stderr


@pytest.mark.proof
def test_a_mesh_of_pivots_open_at_its_region(wrapped: Wrapped) -> None:
    scene, root, _ = wrapped
    box = write_box(root / "open.json", scene, 0.6, (0, 0, 1.0))
    estimate = batch(
        "estimate-mesh", "--out", str(root / "out"), "--region", str(box), "--set", "method=pivots",
        "--set", "pivots=3",
    )  # fmt: skip
    assert estimate.returncode == 0, estimate.stdout + estimate.stderr
    ranges = {
        name: tuple(int(word.replace(" ", "")) for word in (low, high))
        for name, low, high in re.findall(
            r"(t\w+es|t\w+dra): ([\d ]+) to ([\d ]+)", estimate.stdout
        )
    }
    done = batch(
        "mesh", "--out", str(root / "out"), "--region", str(box), "--set", "method=pivots",
        "--set", "pivots=3", "--set", "boundary=open", "--texture-size", "256", "--no-blend",
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    report = json.loads((root / "out" / "result" / "report.json").read_text())
    figures = report["regions"]["open"]
    tetrahedra = figures["provenance"]["tetrahedra"]
    assert ranges["tetrahedra"][0] < tetrahedra < ranges["tetrahedra"][1]
    assert ranges["triangles"][0] < figures["statistics"]["faces"] < ranges["triangles"][1]
    assert figures["estimate"]["tetrahedra_low"] < tetrahedra
    assert figures["estimate"]["tetrahedra_high"] > tetrahedra
    assert figures["check"]["good"], figures["check"]["defects"]
    assert figures["check"]["open_at_region"] == figures["statistics"]["boundary_edges"] > 10
    assert figures["provenance"]["field_evaluations"] > figures["provenance"]["unseen_evaluations"]
    assert "open by request" in (root / "out" / "result" / "report.md").read_text(encoding="utf-8")
    local = (world_mesh(root, "open").vertices - scene.offset) / scene.scale
    assert np.abs(local[:, :2]).max() < 0.6 + 1e-5  # regions lie on the grid of the scene
    distance = np.abs(np.linalg.norm(local, axis=1) - BALL_RADIUS)
    assert np.median(distance) < 0.03


@pytest.mark.proof
def test_fewer_faces_get_a_normal_map_occlusion_and_levels(wrapped: Wrapped) -> None:
    scene, root, _ = wrapped
    box = write_box(root / "light.json", scene, 1.3, (0, 0, 0.35))
    done = batch(
        "mesh", "--out", str(root / "out"), "--region", str(box), "--points", "4000",
        "--faces", "1600", "--set", "lods=2", "--set", "ambient_occlusion=on",
        "--texture-size", "512", "--export", "glb", "--no-blend",
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    (stage,) = (root / "out" / "stages").glob("mesh-light-*")
    with np.load(stage / "dense.npz", allow_pickle=False) as arrays:
        dense_faces = len(arrays["faces"])
    assert dense_faces > 4000
    assert not list((root / "out" / "stages").glob("mesh-ball-*/dense.npz"))
    result = root / "out" / "result"
    report = json.loads((result / "report.json").read_text())
    number = re.compile(r"[\d,]+(\.\d+)?(e[+-]\d+)?")
    assert [row for row in figure_rows(report) if number.fullmatch(row[1]) and not row[2]] == []
    figures = report["regions"]["light"]["texture"]
    assert figures["normal_map"]["dense_faces"] == dense_faces
    assert figures["normal_map"]["by_ray_share"] > 0.95
    assert figures["ambient_occlusion"]["open_share"] > 0.5
    assert [level["faces"] for level in figures["lods"]] == [400, 100]
    assert not (result / "ball" / "normal.png").exists()
    for folder, side in (("", 512), ("lod1", 256), ("lod2", 128)):
        here = result / "light" / folder
        assert Image.open(here / "albedo.png").size == (side, side)
        assert Image.open(here / "normal.png").size == (side, side)
        assert Image.open(here / "occlusion.png").mode == "L"
        mesh = trimesh.load(here / "mesh.glb", force="mesh", process=False)
        assert mesh.visual.material.normalTexture is not None
        closed = trimesh.load(here / "mesh.ply", process=False)
        assert closed.is_watertight
        away = np.abs(np.linalg.norm((closed.vertices - scene.offset) / scene.scale, axis=1))
        assert away.max() < 3.0
    offsets = {
        json.dumps(json.loads(path.read_text())["offset"])
        for path in (result / "light").rglob("transform.json")
    }
    assert len(offsets) == 1


@pytest.mark.proof
def test_a_region_is_estimated_and_meshed_in_tiles_by_two_processes(wrapped: Wrapped) -> None:
    scene, root, _ = wrapped
    box = write_box(root / "tiled.json", scene, 1.3, (0, 0, 0.35))
    asked = (
        "--out", str(root / "out"), "--region", str(box), "--points", "3000", "--set", "tiles=3",
    )  # fmt: skip
    estimate = batch("estimate-mesh", *asked)
    assert estimate.returncode == 0, estimate.stdout + estimate.stderr
    low, high = re.search(r"triangles: ([\d ]+) to ([\d ]+)\n", estimate.stdout).groups()
    assert "it would be meshed in tiles" in estimate.stdout
    done = batch(
        "mesh", *asked, "--texture-size", "256", "--no-blend", "--computers", "local",
        timeout_s=400,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    region = json.loads((root / "out" / "result" / "report.json").read_text())["regions"]["tiled"]
    assert region["provenance"]["tiles"] == 3
    assert region["provenance"]["tile_processes"] == 7  # one for each part
    text = (root / "out" / "result" / "report.md").read_text(encoding="utf-8")
    assert "3 tiles, by 7 processes" in text
    assert region["check"]["defects"] == []
    assert region["estimate"]["tiled"] is True
    mesh = world_mesh(root, "tiled")
    assert mesh.is_watertight
    assert int(low.replace(" ", "")) < len(mesh.faces) < int(high.replace(" ", ""))
    assert region["provenance"]["dense_vertices"] > 4 * len(mesh.vertices)
    assert not list((root / "out" / "stages").glob("mesh-tiled-*/tiles*"))


@pytest.mark.proof
def test_a_killed_training_resumes_to_the_same_gaussians(wrapped: Wrapped, tmp_path: Path) -> None:
    _, root, _ = wrapped
    process = subprocess.Popen(
        [sys.executable, str(BATCH), *wrap_words(root, tmp_path / "out")],
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    folder = JobFolder(tmp_path / "out")
    deadline_s = time.monotonic() + 200
    while time.monotonic() < deadline_s:
        status = folder.read_status()
        if status.stage == "train" and "iteration 2" in status.message:
            break
        assert process.poll() is None, "the job ended before it could be stopped"
        time.sleep(0.02)
    # First a polite stop, which keeps a checkpoint; then the real thing: SIGKILL.
    folder.cancel_path.touch()
    assert process.wait(60) == 5
    resumed = subprocess.Popen(
        [sys.executable, str(BATCH), "resume", str(tmp_path / "out"), "--no-blend"],
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    while time.monotonic() < deadline_s:
        status = folder.read_status()
        if status.state == "RUNNING" and status.stage == "train" and "iteration" in status.message:
            os.kill(status.pid, signal.SIGKILL)
            break
        assert resumed.poll() is None, "the job ended before it could be killed"
        time.sleep(0.02)
    assert resumed.wait(60) not in (0, None)
    done = batch("resume", str(tmp_path / "out"), "--no-blend")
    assert done.returncode == 0, done.stdout + done.stderr
    (first,) = (root / "out" / "stages").glob("train-*/gaussians.npz")
    (second,) = (tmp_path / "out" / "stages").glob("train-*/gaussians.npz")
    with np.load(first, allow_pickle=False) as a, np.load(second, allow_pickle=False) as b:
        for name in a.files:
            assert np.array_equal(a[name], b[name]), name
