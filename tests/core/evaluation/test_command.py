# SPDX-License-Identifier: GPL-3.0-or-later
"""``evaluate`` against meshes, clouds and ground-truth scenes, and its errors."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from gaussian_wrapping_addon import batch
from gaussian_wrapping_addon.command_line.parser import build_parser
from gaussian_wrapping_addon.core.errors import DatasetError, ParseError, UsageError
from gaussian_wrapping_addon.core.evaluation.command import (
    FRAME_MISMATCH_SHARE,
    EvaluationRequest,
    evaluate_mesh,
    find_layout,
    table,
)
from gaussian_wrapping_addon.core.evaluation.layouts import is_cloud, read_cloud, read_mesh
from gaussian_wrapping_addon.core.evaluation.surface_scores import sample_uniformly
from gaussian_wrapping_addon.core.jobs.client import PYTHON_VARIABLE
from gaussian_wrapping_addon.core.jobs.commands.evaluate_command import job_cameras, job_mesh
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.regions.scene_regions import write_region
from gaussian_wrapping_addon.core.regions.shapes import Region
from gaussian_wrapping_addon.core.scene.camera import Similarity
from gaussian_wrapping_addon.core.worker.spawn import process_alive
from tests.core.evaluation.written_layouts import (
    JOB_FROM_TRUTH,
    bumpy_sphere,
    ring_of_cameras,
    rotation_about,
    write_cloud,
    write_job,
)

MESH = bumpy_sphere(1.0, 4)
NAMES = [f"{i}.png" for i in range(8)]
CAMERAS = ring_of_cameras(NAMES, 4.0, np.zeros(3))


def write_ply(path: Path, mesh: tuple[np.ndarray, np.ndarray]) -> Path:
    path.write_bytes(trimesh.Trimesh(*mesh, process=False).export(file_type="ply"))
    return path


def write_scene(folder: Path) -> Path:
    """Write a ground-truth scene folder."""
    (folder / "sparse" / "0").mkdir(parents=True)
    samples = sample_uniformly(*MESH, 20_000, seed=1)
    np.savez(
        folder / "truth.npz", vertices=MESH[0], faces=MESH[1], points=samples.points,
        normals=samples.normals, thin=np.zeros(20_000, bool), seen=np.full(20_000, 5, np.int32),
    )  # fmt: skip
    write_region(folder / "crop.json", Region.box("crop", [-2] * 3, [2] * 3))
    diagonal = float(np.linalg.norm([4, 4, 4]))
    (folder / "scene.json").write_text(json.dumps({"version": 1, "diagonal": diagonal}))
    cameras, images = [], []
    for i, camera in enumerate(CAMERAS, 1):
        numbers = (camera.fx, camera.fy, camera.cx, camera.cy)
        cameras.append(f"{i} PINHOLE 96 96 " + " ".join(map(repr, numbers)))
        q = np.roll(Rotation.from_matrix(camera.rotation).as_quat(), 1)  # w x y z
        pose = [*q, *camera.cam_from_world[:, 3]]
        images.append(f"{i} {' '.join(f'{v:.17g}' for v in pose)} {i} {camera.name}\n")
    model = folder / "sparse" / "0"
    (model / "cameras.txt").write_text("\n".join(cameras) + "\n")
    (model / "images.txt").write_text("\n".join(images) + "\n")
    (model / "points3D.txt").write_text("1 0 0 0 9 9 9 0.1\n")
    return folder


def evaluate(mesh: tuple, truth: Path, cameras: list = [], **options: object) -> dict:  # noqa: B006
    request = EvaluationRequest(truth, **options)  # type: ignore[arg-type]
    return evaluate_mesh(*mesh, cameras, request, Progress())


def test_a_job_against_a_scene_by_its_cameras(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene")
    job = write_job(tmp_path / "job", MESH, CAMERAS, JOB_FROM_TRUTH)
    out = tmp_path / "scores.json"
    arguments = ["evaluate", str(job), "--truth", str(scene), "--align", "cameras"]
    options = ["--protocols", "uniform,legacy", "--samples", "20000", "--out", str(out)]
    assert batch.main([*arguments, *options]) == 0
    report = json.loads(out.read_text())
    assert report["layout"] == "scene"
    np.testing.assert_allclose(
        report["distances"], np.array([0.0025, 0.005, 0.01]) * 48**0.5, rtol=1e-12
    )
    uniform = report["scores"]["uniform"]
    assert uniform["f1"] == [1.0, 1.0, 1.0]
    assert uniform["chamfer_mean"] < 1e-6
    assert uniform["normal_consistency"] > 0.999
    assert report["scores"]["legacy"]["f1"][0] < 1.0
    poses = report["pose_errors"]
    assert poses["cameras"] == 8
    assert poses["rotation_degrees_max"] < 1e-5
    assert report["mesh"]["faces"] == len(MESH[1])
    assert report["seconds"] > 0


def test_nearest_points_undo_a_nudge_that_is_not_told(tmp_path: Path) -> None:
    truth = write_ply(tmp_path / "truth.ply", MESH)
    nudge = Similarity(1.01, rotation_about([1, 0, 1], 1.5), np.array([0.02, 0.01, -0.01]))
    moved = nudge.points(MESH[0]), MESH[1]
    left = evaluate(moved, truth, samples=20_000)
    found = evaluate(moved, truth, samples=20_000, align="icp")
    assert left["scores"]["uniform"]["f1"][0] < 0.9
    assert found["scores"]["uniform"]["f1"][0] > 0.999
    assert "scan" not in found["scores"]  # no camera is known
    assert any(line.startswith("uniform") and "1.0000" in line for line in table(found))


def test_clouds_are_judged_against_as_well(tmp_path: Path) -> None:
    cloud = tmp_path / "cloud.ply"
    points = sample_uniformly(*MESH, 30_000, seed=5).points
    write_cloud(cloud, points)
    assert is_cloud(cloud)
    np.testing.assert_array_equal(read_cloud(cloud), points)
    options = {"distances": (0.2, 0.04), "protocols": ("uniform",), "samples": 20_000}
    # A tenth of the radius away everywhere: within 0.2 of the truth, nowhere within 0.04.
    for scale, scores in ((1.1, [1.0, 0.0]), (1.0, [1.0, 1.0])):
        result = evaluate((scale * MESH[0], MESH[1]), cloud, **options)
        assert list(result["scores"]["uniform"]["f1"]) == scores
        assert result["shares_of_diagonal"] is None


def test_cameras_in_another_frame_are_told_unless_aligned(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene")
    options = {"protocols": ("uniform",), "samples": 2_000}
    moved = JOB_FROM_TRUTH.points(MESH[0]), MESH[1]
    cameras = [camera.moved(JOB_FROM_TRUTH) for camera in CAMERAS]
    result = evaluate(moved, scene, cameras, **options)
    assert result["scores"]["uniform"]["f1"][-1] < 0.1
    assert result["pose_errors"]["center_share_median"] < 1e-9
    assert result["pose_errors"]["given_share_median"] > 1.0
    (line,) = [line for line in table(result) if "in another frame" in line]
    apart = [JOB_FROM_TRUTH.points(c.center[None])[0] - c.center for c in CAMERAS]
    shift = float(np.median(np.linalg.norm(apart, axis=1)))
    for words in (f"scale {1 / JOB_FROM_TRUTH.scale:.4g}", f"shift {shift:.4g}", "--align cameras"):
        assert words in line
    for result in (
        evaluate(moved, scene, cameras, align="cameras", **options),
        evaluate(MESH, scene, CAMERAS, **options),
    ):
        text = "\n".join(table(result))
        assert "in another frame" not in text
        assert "after their own best alignment" in text
        assert "Chamfer" in text
    # Noise of the cameras is not taken for another frame.
    rng = np.random.default_rng(3)
    noisy = [c.moved(Similarity(1.0, np.eye(3), rng.normal(0.0, 0.2, 3))) for c in CAMERAS]
    result = evaluate(MESH, scene, noisy, **options)
    assert result["pose_errors"]["given_share_median"] > FRAME_MISMATCH_SHARE
    assert "in another frame" not in "\n".join(table(result))


def test_poses_that_nobody_asked_for_never_end_it(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene")
    strangers = ring_of_cameras([f"other-{i}.png" for i in range(8)], 4.0, np.zeros(3))
    options = {"protocols": ("uniform",), "samples": 2_000}
    result = evaluate(MESH, scene, strangers, **options)
    assert result["scores"]["uniform"]["f1"] == [1.0, 1.0, 1.0]
    assert result["pose_errors"] is None
    assert "0 of 8 true cameras" in result["pose_note"]
    assert table(result)[-1] == f"poses     not compared: {result['pose_note']}"
    for align in ("cameras", "icp"):
        with pytest.raises(DatasetError, match="0 of 8 true cameras"):
            evaluate(MESH, scene, strangers, align=align, **options)


def test_thin_parts_are_told_where_there_are_such(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene")
    result = evaluate(MESH, scene, protocols=("uniform",), samples=2_000)
    entry = result["scores"]["uniform"]
    entry["thin_recall"] = [0.1, 0.2, 0.3]
    for count, told in ((199, False), (200, True)):
        entry["thin_count"] = count
        assert entry["truth_count"] == 20_000
        assert any("0.1000 0.2000 0.3000" in line for line in table(result)) == told


@pytest.mark.skipif(sys.platform == "win32", reason="the launcher is a shell script")
def test_a_launcher_between_caller_and_child_does_not_end_it(tmp_path: Path) -> None:
    """In a virtual environment on Windows, the child's parent is not its caller."""
    mesh = write_ply(tmp_path / "mesh.ply", MESH)
    launcher = tmp_path / "python"
    launcher.write_text(f'#!/bin/sh\n"{sys.executable}" "$@"\nexit $?\n')
    launcher.chmod(0o755)
    out = tmp_path / "scores.json"
    options = build_parser().parse_args(
        ["evaluate", str(mesh), "--truth", str(mesh), "--samples", "1000", "--out", str(out)]
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(PYTHON_VARIABLE, str(launcher))
        assert options.run(options) == 0
    assert json.loads(out.read_text())["scores"]["uniform"]["f1"][0] == 1.0


def test_what_contradicts_itself_is_refused(tmp_path: Path) -> None:
    truth = write_ply(tmp_path / "truth.ply", MESH)
    for options, words in (
        ({"align": "cameras"}, "no cameras to align by"),
        ({"shares": (0.1,), "distances": (1.0,)}, "both given"),
        ({"distances": (-1.0,)}, "needs positive numbers"),
        ({"protocols": ("scan",)}, "needs cameras"),
        ({"protocols": ("best",)}, "is unknown"),
        ({"protocols": ()}, "is empty"),
        ({"samples": 0}, "too few"),
    ):
        with pytest.raises(UsageError, match=words):
            evaluate(MESH, truth, **options)
    for place, words in ((tmp_path, "not a known ground truth"), (tmp_path / "a", "not exist")):
        with pytest.raises(DatasetError, match=words):
            find_layout(EvaluationRequest(place))
    for text in ("a", "1,b", "nan", "1,inf"):
        with pytest.raises(UsageError, match="give numbers separated by commas"):
            build_parser().parse_args(["evaluate", "m", "--truth", "t", "--thresholds", text])


def test_broken_meshes_and_clouds_are_named(tmp_path: Path) -> None:
    mesh = write_ply(tmp_path / "mesh.ply", MESH)
    vertices, faces = read_mesh(mesh)
    np.testing.assert_allclose(vertices[faces], MESH[0][MESH[1]], atol=1e-6)
    whole = mesh.read_bytes()
    no_faces = whole.replace(b"element face 5120", b"element face 0   ")
    for bad in (whole[:-40], no_faces, b"ply\nformat"):
        mesh.write_bytes(bad)
        with pytest.raises(ParseError, match=r"mesh\.ply, (whole file|faces)"):
            read_mesh(mesh)
    broken = MESH[0].copy()
    broken[7, 1] = np.nan
    for bad, words in (
        ((broken, MESH[1]), "vertex 7: is not finite"),
        ((MESH[0], MESH[1] + 9), "refers to a vertex that does not exist"),
    ):
        with pytest.raises(ParseError, match=words):
            read_mesh(write_ply(mesh, bad))
    with pytest.raises(ParseError, match="not a known mesh format"):
        read_mesh(tmp_path / "mesh.fbx")
    for points, words in (
        (np.zeros((0, 3)), "the cloud is empty"),
        (np.array([[0, 0, 0], [np.inf, 0, 0]]), "1 of 2 are not finite"),
    ):
        write_cloud(mesh, points)
        with pytest.raises(ParseError, match=words):
            read_cloud(mesh)


def test_a_job_tells_its_region_and_world_cameras(tmp_path: Path) -> None:
    job = write_job(tmp_path / "job", MESH, CAMERAS, JOB_FROM_TRUTH)
    assert job_mesh(job, None) == job / "result" / "auto" / "mesh.ply"
    for camera, true in zip(job_cameras(job), CAMERAS, strict=True):
        np.testing.assert_allclose(camera.center, JOB_FROM_TRUTH.points(true.center[None])[0])
        assert camera.name == true.name
    other = job / "result" / "head" / "mesh.ply"
    other.parent.mkdir()
    other.write_bytes(b"")
    for folder, name, words in (
        (job, "hand", "no region hand"), (job, None, "auto, head"),
        (tmp_path, None, "not a job folder"),
    ):  # fmt: skip
        with pytest.raises(UsageError, match=words):
            job_mesh(folder, name)


def test_the_exit_code_tells_bad_data(tmp_path: Path) -> None:
    mesh = write_ply(tmp_path / "mesh.ply", MESH)
    mesh.write_bytes(mesh.read_bytes()[:-9])
    assert batch.main(["evaluate", str(mesh), "--truth", str(mesh)]) == 3


@pytest.mark.skipif(sys.platform == "win32", reason="Windows sends no SIGINT to one process")
def test_an_interrupt_ends_it_and_its_child(tmp_path: Path) -> None:
    mesh = write_ply(tmp_path / "mesh.ply", MESH)
    out = tmp_path / "scores.json"
    entry = Path(batch.__file__)
    process = subprocess.Popen(
        [
            sys.executable, str(entry), "evaluate", str(mesh), "--truth", str(mesh),
            "--samples", "30000000", "--out", str(out),
        ],
        stdout=subprocess.PIPE,
        # Where the tests run in a shell's background, interrupts arrive ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    assert process.stdout is not None
    assert b"%]" in process.stdout.readline()  # the child has begun
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    child = int(children.read_text().split()[0]) if children.exists() else 0
    process.send_signal(signal.SIGINT)
    assert process.wait(60) == 5
    assert not out.exists()
    deadline_s = time.monotonic() + 20
    while child and process_alive(child, 0):
        assert time.monotonic() < deadline_s
        time.sleep(0.1)
