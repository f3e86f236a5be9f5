# SPDX-License-Identifier: GPL-3.0-or-later
"""A synthetic scan in the layout of DTU is read, aligned and scored in millimetres."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
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
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.scene.camera import Similarity
from tests.core.evaluation.layouts.written_layouts import (
    JOB_FROM_TRUTH,
    Mesh,
    ring_of_cameras,
    write_dtu,
    write_job,
)

SCAN = 24
MIDDLE = np.array([40.0, -20.0, 600.0])
RADIUS, OFFSET = 12.0, 0.5
NAMES = [f"rect_{i:03}_3_r5000.png" for i in range(1, 13)]
CAMERAS = ring_of_cameras(NAMES, 150.0, MIDDLE)


def ball(radius: float, middle: np.ndarray, subdivisions: int) -> Mesh:
    mesh = trimesh.creation.icosphere(subdivisions)
    return np.asarray(mesh.vertices) * radius + middle, np.asarray(mesh.faces, np.int64)


def sphere_points(count: int) -> np.ndarray:
    i = np.arange(count) + 0.5
    z = 1 - 2 * i / count
    angle = np.pi * (1 + 5**0.5) * i
    r = np.sqrt(1 - z * z)
    return MIDDLE + RADIUS * np.stack([r * np.cos(angle), r * np.sin(angle), z], 1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("dtu") / "MVS"
    # True points are 0.09 mm apart: the nearest one to a point 0.5 above is at most 0.502 away.
    return write_dtu(root, SCAN, sphere_points(200_000), CAMERAS, middle=MIDDLE)


def shell_with_debris() -> Mesh:
    """A shell OFFSET outside of the truth, and a ball where nothing was observed."""
    shell, debris = ball(RADIUS + OFFSET, MIDDLE, 5), ball(3.0, MIDDLE - [25.0, 0, 0], 2)
    vertices = np.concatenate([shell[0], debris[0]])
    return vertices, np.concatenate([shell[1], debris[1] + len(shell[0])])


def test_a_shell_scores_its_offset(folder: Path, tmp_path: Path) -> None:
    job = write_job(tmp_path / "job", shell_with_debris(), CAMERAS, JOB_FROM_TRUTH)
    out = tmp_path / "scores.json"
    arguments = ["evaluate", str(job), "--truth", str(folder), "--scan", str(SCAN)]
    assert batch.main([*arguments, "--out", str(out)]) == 0
    report = json.loads(out.read_text())
    assert (report["layout"], report["scan"]) == ("dtu", SCAN)
    assert report["alignment"]["cameras"] == 12
    assert report["alignment"]["number_offset"] == 0
    assert report["alignment"]["rmse_mm"] < 1e-6
    score = report["scores"]["dtu"]
    assert score["accuracy"] == pytest.approx(OFFSET, abs=0.005)
    # The prediction is thinned out to 0.2 mm: its nearest point is up to 0.2 aside.
    assert OFFSET < score["completeness"] < np.hypot(OFFSET, 0.2)
    assert score["overall"] == pytest.approx((score["accuracy"] + score["completeness"]) / 2)


def test_the_truth_itself_scores_nearly_nothing(folder: Path) -> None:
    truth = read_dtu(folder, SCAN)
    mesh = ball(RADIUS, MIDDLE, 5)
    moved = JOB_FROM_TRUTH.points(mesh[0])
    found = align_to_scan([c.moved(JOB_FROM_TRUTH) for c in CAMERAS], truth)
    score = score_dtu(moved, mesh[1], truth, found.transform)
    assert 0 < score.accuracy < 0.06
    assert 0 < score.completeness < 0.12


def test_points_below_the_ground_are_not_asked_for(folder: Path) -> None:
    truth = read_dtu(folder, SCAN)
    points = truth.cloud
    above = points[:, 2] > MIDDLE[2] - 10.0
    np.testing.assert_array_equal(points @ truth.plane[:3] + truth.plane[3] > 0, above)
    vertices, faces = ball(RADIUS, MIDDLE, 5)
    kept = faces[vertices[faces].mean(1)[:, 2] > MIDDLE[2] - 10.2]
    score = score_dtu(vertices, kept, truth, Similarity())
    assert score.completeness < 0.12
    assert score.completeness_count == above.sum()


def test_archived_cameras_count_from_zero(folder: Path, tmp_path: Path) -> None:
    root = tmp_path / "copy"
    write_dtu(root, SCAN, sphere_points(500), CAMERAS, middle=MIDDLE)
    matrices = {}
    for i, camera in enumerate(CAMERAS):
        k = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        matrices[f"world_mat_{i}"] = np.r_[k @ camera.cam_from_world, [[0, 0, 0, 1]]]
        matrices[f"scale_mat_{i}"] = np.diag([50.0, 50, 50, 1])
    (root / f"scan{SCAN}").mkdir()
    np.savez(root / f"scan{SCAN}" / "cameras.npz", **matrices)
    truth = read_dtu(root, SCAN)
    assert truth.camera_source == "cameras.npz"
    names = [f"{i:06}.png" for i in range(12)]
    for source, wanted in ((truth, 0), (read_dtu(folder, SCAN), 1)):
        moved = [
            replace(c.moved(JOB_FROM_TRUTH), name=n) for c, n in zip(CAMERAS, names, strict=True)
        ]
        found = align_to_scan(moved, source)
        assert found.number_offset == wanted
        assert found.rmse_mm < 1e-6


def test_cameras_of_another_scene_are_refused(folder: Path) -> None:
    truth = read_dtu(folder, SCAN)
    mixed = [replace(c, name=n) for c, n in zip(CAMERAS, NAMES[5:] + NAMES[:5], strict=True)]
    other = [
        replace(c, cam_from_world=c.cam_from_world * [1, 1, 1, (-1) ** i])
        for i, c in enumerate(mixed)
    ]
    with pytest.raises(DatasetError, match=r"are off those of Calibration/cal18 by"):
        align_to_scan(other, truth)
    named = [replace(c, name=f"{i + 900}.png") for i, c in enumerate(CAMERAS)]
    with pytest.raises(DatasetError, match="0 of 12 photos"):
        align_to_scan(named, truth)


def test_wrong_files_are_refused_by_place(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "ObsMask24_10.mat"
    good = {"ObsMask": np.ones((2, 2, 2), np.uint8), "BB": np.eye(3)[:2] * 0 + [[0], [9]], "Res": 1}
    savemat(path, good)
    assert read_observation_mask(path).volume.all()
    for change, place in (
        ({"Res": np.nan}, "Res"),
        ({"Res": -1.0}, "Res"),
        ({"BB": np.zeros((2, 3))}, "BB"),
        ({"BB": np.zeros((3, 2))}, "BB"),
        ({"ObsMask": np.ones((2, 2))}, "ObsMask"),
    ):
        savemat(path, {**good, **change})
        with pytest.raises(ParseError, match=f"{place}:"):
            read_observation_mask(path)
    savemat(path, {"Mask": good["ObsMask"]})
    with pytest.raises(ParseError, match="ObsMask: there is no such entry"):
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
    mesh = ball(1.0, MIDDLE, 1)
    with pytest.raises(UsageError, match="--scan 24"):
        evaluate_mesh(*mesh, CAMERAS, EvaluationRequest(folder), Progress())
    request = EvaluationRequest(folder, scan=SCAN, protocols=("scan",))
    with pytest.raises(UsageError, match="its own protocol"):
        evaluate_mesh(*mesh, CAMERAS, request, Progress())
    with pytest.raises(UsageError, match="needs the cameras"):
        evaluate_mesh(*mesh, [], EvaluationRequest(folder, scan=SCAN), Progress())
