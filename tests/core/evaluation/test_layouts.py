# SPDX-License-Identifier: GPL-3.0-or-later
"""Scans in the layouts of DTU and of Tanks and Temples are read, aligned and scored."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from gaussian_wrapping_addon import batch
from gaussian_wrapping_addon.core.errors import DatasetError, ParseError, UsageError
from gaussian_wrapping_addon.core.evaluation.command import EvaluationRequest, evaluate_mesh
from gaussian_wrapping_addon.core.evaluation.dtu import (
    align_to_scan,
    read_dtu,
    read_observation_mask,
    read_plane,
    score_dtu,
)
from gaussian_wrapping_addon.core.evaluation.layouts import (
    PolygonVolume,
    align_to_log,
    photo_numbers,
    read_matrix,
    read_polygon_volume,
    read_tanks,
    read_trajectory,
    score_tanks,
)
from gaussian_wrapping_addon.core.evaluation.surface_scores import face_normals
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.scene.camera import Camera, Similarity
from tests.core.evaluation.surface_scenes import ball, exact_sphere, joined
from tests.core.evaluation.written_layouts import (
    JOB_FROM_TRUTH,
    Mesh,
    bumpy_sphere,
    ring_of_cameras,
    write_dtu,
    write_job,
    write_tanks,
)

SCAN = 24
MIDDLE = np.array([40.0, -20.0, 600.0])
RADIUS, OFFSET = 12.0, 0.5
NAMES = [f"rect_{i:03}_3_r5000.png" for i in range(1, 13)]
CAMERAS = ring_of_cameras(NAMES, 150.0, MIDDLE)


def sphere_points(count: int) -> np.ndarray:
    return MIDDLE + exact_sphere(count, RADIUS).points


def ball_at(radius: float, middle: np.ndarray = MIDDLE) -> Mesh:
    vertices, faces = ball(5, radius)
    return vertices + middle, faces


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("dtu") / "MVS"
    # True points are 0.09 mm apart: the nearest one to a point 0.5 above is at most 0.502 away.
    return write_dtu(root, SCAN, sphere_points(200_000), CAMERAS, middle=MIDDLE)


def test_a_shell_scores_its_offset(folder: Path, tmp_path: Path) -> None:
    # The debris lies where nothing was observed.
    mesh = joined(ball_at(RADIUS + OFFSET), ball_at(3.0, MIDDLE - [25.0, 0, 0]))
    job = write_job(tmp_path / "job", mesh, CAMERAS, JOB_FROM_TRUTH)
    out = tmp_path / "scores.json"
    arguments = ["evaluate", str(job), "--truth", str(folder), "--scan", str(SCAN)]
    assert batch.main([*arguments, "--out", str(out)]) == 0
    report = json.loads(out.read_text())
    assert (report["layout"], report["scan"]) == ("dtu", SCAN)
    aligned = report["alignment"]
    assert (aligned["cameras"], aligned["number_offset"]) == (12, 0)
    assert aligned["rmse_mm"] < 1e-6
    score = report["scores"]["dtu"]
    assert score["accuracy"] == pytest.approx(OFFSET, abs=0.005)
    # The prediction is thinned out to 0.2 mm: its nearest point is up to 0.2 aside.
    assert OFFSET < score["completeness"] < np.hypot(OFFSET, 0.2)
    assert score["overall"] == pytest.approx((score["accuracy"] + score["completeness"]) / 2)


def test_points_below_the_ground_are_not_asked_for(folder: Path) -> None:
    truth = read_dtu(folder, SCAN)
    above = truth.cloud[:, 2] > MIDDLE[2] - 10.0
    np.testing.assert_array_equal(truth.cloud @ truth.plane[:3] + truth.plane[3] > 0, above)
    vertices, faces = ball_at(RADIUS)
    kept = faces[vertices[faces].mean(1)[:, 2] > MIDDLE[2] - 10.2]
    score = score_dtu(vertices, kept, truth, Similarity())
    assert 0 < score.accuracy < 0.06
    assert score.completeness < 0.12
    assert score.completeness_count == above.sum()


def test_archived_cameras_count_from_zero(folder: Path, tmp_path: Path) -> None:
    root = write_dtu(tmp_path / "copy", SCAN, sphere_points(500), CAMERAS, middle=MIDDLE)
    matrices = {}
    for i, camera in enumerate(CAMERAS):
        k = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        matrices[f"world_mat_{i}"] = np.r_[k @ camera.cam_from_world, [[0, 0, 0, 1]]]
        matrices[f"scale_mat_{i}"] = np.diag([50.0, 50, 50, 1])
    (root / f"scan{SCAN}").mkdir()
    np.savez(root / f"scan{SCAN}" / "cameras.npz", **matrices)
    truth = read_dtu(root, SCAN)
    assert truth.camera_source == "cameras.npz"
    moved = [replace(c.moved(JOB_FROM_TRUTH), name=f"{i:06}.png") for i, c in enumerate(CAMERAS)]
    for source, wanted in ((truth, 0), (read_dtu(folder, SCAN), 1)):
        found = align_to_scan(moved, source)
        assert found.number_offset == wanted
        assert found.rmse_mm < 1e-6


def test_cameras_of_another_scene_are_refused(folder: Path, scene: Path) -> None:
    truth = read_dtu(folder, SCAN)
    mixed = [
        replace(c, name=n, cam_from_world=c.cam_from_world * [1, 1, 1, (-1) ** i])
        for i, (c, n) in enumerate(zip(CAMERAS, NAMES[5:] + NAMES[:5], strict=True))
    ]
    named = [replace(c, name=f"{i + 900}.png") for i, c in enumerate(CAMERAS)]
    for others, words in ((mixed, "are off those of Calibration/cal18 by"), (named, "0 of 12")):
        with pytest.raises(DatasetError, match=words):
            align_to_scan(others, truth)
    rng = np.random.default_rng(0)
    others = [
        Camera(n, 4, 4, 4.0, 4.0, 2.0, 2.0, np.c_[np.eye(3), rng.normal(size=3) * 9])
        for n in SCAN_NAMES
    ]
    with pytest.raises(DatasetError, match=r"match the trajectory|do not correspond"):
        align_to_log(others, read_tanks(scene), seed=0)


def test_wrong_files_are_refused_by_place(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "ObsMask24_10.mat"
    box = np.array([[0.0] * 3, [9.0] * 3])
    good = {"ObsMask": np.ones((2, 2, 2), np.uint8), "BB": box, "Res": 1}
    savemat(path, good)
    assert read_observation_mask(path).volume.all()
    for values, words in (
        ({**good, "Res": np.nan}, "Res:"),
        ({**good, "BB": np.zeros((2, 3))}, "BB:"),
        ({**good, "BB": np.zeros((3, 2))}, "BB:"),
        ({**good, "ObsMask": np.ones((2, 2))}, "ObsMask:"),
        ({"Mask": good["ObsMask"]}, "ObsMask: there is no such entry"),
    ):
        savemat(path, values)
        with pytest.raises(ParseError, match=words):
            read_observation_mask(path)
    savemat(path, {"P": np.zeros(3)})
    with pytest.raises(ParseError, match=r"P: \(3,\) is not"):
        read_plane(path)
    path.write_bytes(b"no matlab file")
    with pytest.raises(ParseError, match="cannot be read as a MATLAB file"):
        read_plane(path)
    with pytest.raises(DatasetError, match=r"holds no Points/stl/stl025_total\.ply"):
        read_dtu(folder, 25)


def test_a_scan_has_to_be_named(folder: Path) -> None:
    scan = EvaluationRequest(folder, scan=SCAN)
    for cameras, request, words in (
        (CAMERAS, EvaluationRequest(folder), "--scan 24"),
        (CAMERAS, replace(scan, protocols=("scan",)), "its own protocol"),
        ([], scan, "needs the cameras"),
    ):
        with pytest.raises(UsageError, match=words):
            evaluate_mesh(*ball_at(1.0), cameras, request, Progress())


SCAN_NAMES = [f"{i:06}.jpg" for i in range(1, 22)]
NOISE = 0.004
MESH = bumpy_sphere(0.5, 4)
SCAN_CAMERAS = ring_of_cameras(SCAN_NAMES, 2.0, np.zeros(3))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("tanks")
    return write_tanks(
        root / "Courthouse", "Courthouse", MESH, SCAN_CAMERAS, samples=40_000, noise=NOISE
    )


def placed(scene: Path, mesh: Mesh) -> dict[str, Any]:
    """Place a mesh as a job has it; return all that its scores need."""
    tanks = read_tanks(scene)
    cameras = [camera.moved(JOB_FROM_TRUTH) for camera in SCAN_CAMERAS]
    start = align_to_log(cameras, tanks, seed=0).transform
    moved = JOB_FROM_TRUTH.points(mesh[0]), mesh[1]
    return {"mesh": moved, "cameras": cameras, "scene": tanks, "start": start}


def test_the_true_mesh_of_a_job_scores_one(scene: Path, tmp_path: Path) -> None:
    job = write_job(tmp_path / "job", MESH, SCAN_CAMERAS, JOB_FROM_TRUTH)
    out = tmp_path / "scores.json"
    arguments = ["evaluate", str(job), "--truth", str(scene), "--out", str(out)]
    options = ["--samples", "40000", "--threads", "2", "--protocols", "uniform,legacy"]
    assert batch.main([*arguments, *options]) == 0
    report = json.loads(out.read_text())
    assert (report["layout"], report["scene"], report["distances"]) == (
        "tanks", "Courthouse", [0.025],
    )  # fmt: skip
    agreeing = report["alignment"]["cameras"]
    assert (agreeing["matched"], agreeing["agreeing"]) == (21, 18)
    assert set(report["scores"]) == {"uniform", "legacy"}
    uniform = report["scores"]["uniform"]
    assert uniform["score"]["f1"] >= 0.999
    assert len(uniform["refinement"]) == 3
    # The refinement takes out what the noise of the trajectory left.
    found = np.array(uniform["transform"]["rotation"]) * uniform["transform"]["scale"]
    truth_from_job = JOB_FROM_TRUTH.inverse().matrix()
    np.testing.assert_allclose(found * 3.7, truth_from_job[:3, :3] * 3.7, atol=5e-3)
    assert report["scores"]["legacy"]["score"]["f1"] >= 0.99
    assert report["machine"]["packages"]["libigl"]
    assert report["asked"]["seed"] == 0


def test_a_scan_of_the_true_mesh_scores_one(scene: Path) -> None:
    given = {**placed(scene, MESH), "refine": False, "protocols": ("scan",)}
    result = score_tanks(**given)["scan"]
    assert result["score"]["f1"] >= 0.99
    assert result["refinement"] is None
    with pytest.raises(UsageError, match="needs cameras"):
        score_tanks(**{**given, "cameras": []})


def test_a_mesh_that_is_wrong_in_one_half_loses_that_half(scene: Path) -> None:
    vertices, faces = MESH
    wrong = vertices[faces].mean(1)[:, 0] > 0
    areas = face_normals(vertices, faces)[1]
    good = float(areas[~wrong].sum() / areas.sum())
    assert 0.4 < good < 0.6
    both = np.concatenate([vertices, vertices + np.array([1.6, 0, 0])])
    moved = np.where(wrong[:, None], faces + len(vertices), faces)
    options = {"protocols": ("uniform",), "samples": 40_000}
    score = score_tanks(**placed(scene, (both, moved)), refine=False, **options)
    score = score["uniform"]["score"]
    # Within tau of the seam, true points of the other half are met too.
    assert score["precision"] == pytest.approx(good, abs=0.03)
    assert score["recall"] == pytest.approx(good, abs=0.06)
    # The half alone is refined to its place: it is precise, and complete by half.
    score = score_tanks(**placed(scene, (vertices, faces[~wrong])), refine=True, **options)
    score = score["uniform"]["score"]
    assert score["precision"] >= 0.995
    assert score["recall"] == pytest.approx(good, abs=0.06)


def test_the_same_seed_gives_the_same_figures(scene: Path) -> None:
    options = {"refine": True, "protocols": ("uniform",), "samples": 10_000, "seed": 3}
    first, second = (
        score_tanks(**placed(scene, MESH), **options, threads=threads) for threads in (1, 2)
    )
    assert first == second


def test_photos_are_entries_in_sorted_order_or_by_their_number() -> None:
    numbers = np.array([2, 0, 1])
    assert photo_numbers(["b.jpg", "a.jpg", "c.jpg"], numbers).tolist() == [2, 1, 0]
    assert photo_numbers(["x/000003.jpg", "000001.jpg"], numbers).tolist() == [0, 1]
    assert photo_numbers(["000009.jpg", "000002.jpg"], numbers).tolist() == [-1, 2]
    with pytest.raises(DatasetError, match=r"'a\.jpg' has no number"):
        photo_numbers(["a.jpg", "b.jpg"], numbers)


def test_few_photos_of_the_scene_align_as_well(scene: Path) -> None:
    tanks = read_tanks(scene)
    some = [camera.moved(JOB_FROM_TRUTH) for camera in SCAN_CAMERAS[::2]]
    found = align_to_log(some, tanks, seed=0)
    error = found.transform.points(JOB_FROM_TRUTH.points(MESH[0])) - MESH[0]
    assert np.linalg.norm(error, axis=1).max() < 4 * NOISE


def test_the_log_is_read_and_bad_lines_are_named(scene: Path, tmp_path: Path) -> None:
    lines = (scene / "Courthouse_COLMAP_SfM.log").read_text().splitlines()
    path = tmp_path / "a.log"
    path.write_text("\n".join(lines))
    numbers, poses = read_trajectory(path)
    assert numbers.tolist() == list(range(21))
    assert poses.shape == (21, 4, 4)
    for change, place in (
        (lines[:-1], "line 104.*cut off"),
        ([*lines[:7], "nan 0 0 0", *lines[8:]], "line 6.*not finite"),
        ([*lines[:7], "1 2 3", *lines[8:]], "line 6.*four rows"),
        ([*lines[:5], "x 1 0", *lines[6:]], "line 6.*whole numbers"),
        ([*lines[:9], "0 0 0 2", *lines[10:]], "line 6.*last row"),
    ):
        path.write_text("\n".join(change))
        with pytest.raises(ParseError, match=place):
            read_trajectory(path)


def test_bad_matrices_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "Barn_trans.txt"
    for text, words in (
        ("1 0 0\n0 1 0\n0 0 1\n", "4x4 matrix was expected"),
        ("1 0 0 0\n0 1 0 0\n0 0 -1 0\n0 0 0 1\n", "mirrors"),
        ("1 0 0 0\n0 1 0 0\n0 0 5 0\n0 0 0 1\n", "not a rotation"),
        ("1 0 0 nan\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "not finite"),
        ("1 0 0 x\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "could not convert"),
    ):
        path.write_text(text)
        with pytest.raises(ParseError, match=words):
            read_matrix(path)


def test_a_scene_that_lacks_something_is_refused(scene: Path, tmp_path: Path) -> None:
    copied = Path(shutil.copytree(scene, tmp_path / "Courthouse"))
    cloud = copied / "Courthouse.ply"
    whole = cloud.read_bytes()
    cloud.write_bytes(whole[:-100])
    with pytest.raises(ParseError, match=r"Courthouse\.ply, byte .*cut off"):
        read_tanks(copied)
    cloud.write_bytes(whole)
    folder = copied.rename(tmp_path / "Shed")
    for path in list(folder.iterdir()):
        path.rename(folder / path.name.replace("Courthouse", "Shed"))
    with pytest.raises(UsageError, match="--distances"):
        read_tanks(folder)
    assert read_tanks(folder, 0.5).threshold == 0.5
    (folder / "Shed.json").unlink()
    with pytest.raises(DatasetError, match=r"holds no Shed\.json") as caught:
        read_tanks(folder, 0.5)
    assert caught.value.exit_code == 3


# The letter U, 3 wide and 3 high, with a gap of 1 from above.
LETTER = np.array([[0, 0], [3, 0], [3, 3], [2, 3], [2, 1], [1, 1], [1, 3], [0, 3]], float)
PLANES = {"X": (1, 2, 0), "Y": (0, 2, 1), "Z": (0, 1, 2)}


def stored(axis: str) -> dict:
    u, v, _ = PLANES[axis]
    corners = np.full((len(LETTER), 3), 7.0)  # not used along the axis
    corners[:, u], corners[:, v] = LETTER[:, 0], LETTER[:, 1]
    return {
        "class_name": "SelectionPolygonVolume", "version_major": 1, "version_minor": 0,
        "axis_max": 2.0, "axis_min": -1.0, "orthogonal_axis": axis,
        "bounding_polygon": corners.tolist(),
    }  # fmt: skip


@pytest.mark.parametrize("axis", "XYZ")
def test_a_concave_polygon_along_every_axis(axis: str, tmp_path: Path) -> None:
    path = tmp_path / "crop.json"
    path.write_text(json.dumps(stored(axis)))
    crop = read_polygon_volume(path)
    u, v, w = PLANES[axis]
    points = np.random.default_rng(0).uniform(-2, 4, (20_000, 3))
    x, y, height = points[:, u], points[:, v], points[:, w]
    letter = (x > 0) & (x < 3) & (y > 0) & (y < 3) & ~((x > 1) & (x < 2) & (y > 1))
    np.testing.assert_array_equal(crop.inside(points), letter & (height > -1) & (height < 2))
    low, high = crop.bounds()
    assert (low[u], high[v], low[w], high[w]) == (0, 3, -1, 2)


def test_borders_belong_to_one_side() -> None:
    left = PolygonVolume(np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float), "Z", 0, 1)
    right = PolygonVolume(left.polygon + np.array([1, 0, 0]), "Z", 0, 1)
    edge = np.array([[1.0, y, 0.5] for y in np.linspace(0, 0.99, 12)])
    assert not left.inside(edge).any()
    assert right.inside(edge).all()
    assert left.inside(np.array([[0.0, 0, 0], [0.5, 0.5, 1.0]])).all()
    assert not left.inside(np.array([[0.5, 0.5, 1.0 + 1e-9], [np.nan, 0.5, 0.5]])).any()


def test_bad_files_are_refused_by_place(tmp_path: Path) -> None:
    path = tmp_path / "crop.json"
    with pytest.raises(ParseError, match=r"crop\.json"):
        read_polygon_volume(path)
    for change, place in (
        ({"orthogonal_axis": "W"}, "orthogonal_axis"),
        ({"axis_min": 5.0}, "axis_min"),
        ({"axis_max": None}, "axis_max"),
        ({"bounding_polygon": [[0, 0, 0]]}, "bounding_polygon"),
        ({"bounding_polygon": [[0, 0, 0], [1, 0], [1, 1, 0]]}, r"bounding_polygon\[1\]"),
        ({"version_major": 2}, "version_major"),
        ({"class_name": "Other"}, "class_name"),
    ):
        path.write_text(json.dumps({**stored("Z"), **change}))
        with pytest.raises(ParseError, match=place):
            read_polygon_volume(path)
