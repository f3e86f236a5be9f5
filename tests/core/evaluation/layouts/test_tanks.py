# SPDX-License-Identifier: GPL-3.0-or-later
"""A synthetic scene in the layout of Tanks and Temples is read, aligned and scored."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon import batch
from gaussian_wrapping_addon.core.errors import DatasetError, ParseError, UsageError
from gaussian_wrapping_addon.core.evaluation.layouts import (
    THRESHOLDS,
    align_to_log,
    photo_numbers,
    read_matrix,
    read_tanks,
    read_trajectory,
    score_tanks,
)
from gaussian_wrapping_addon.core.evaluation.surface_scores import face_normals
from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.core.evaluation.layouts.written_layouts import (
    JOB_FROM_TRUTH,
    Mesh,
    bumpy_sphere,
    ring_of_cameras,
    write_job,
    write_tanks,
)

NAMES = [f"{i:06}.jpg" for i in range(1, 22)]
NOISE = 0.004
MESH = bumpy_sphere(0.5, 4)
CAMERAS = ring_of_cameras(NAMES, 2.0, np.zeros(3))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("tanks")
    return write_tanks(
        root / "Courthouse", "Courthouse", MESH, CAMERAS, samples=40_000, noise=NOISE
    )


def half_wrong() -> tuple[Mesh, float]:
    """The mesh with every face at x > 0 moved by 1.6, and the area share of the rest."""
    vertices, faces = MESH
    wrong = vertices[faces].mean(1)[:, 0] > 0
    _, areas = face_normals(vertices, faces)
    both = np.concatenate([vertices, vertices + np.array([1.6, 0, 0])])
    moved = np.where(wrong[:, None], faces + len(vertices), faces)
    return (both, moved), float(areas[~wrong].sum() / areas.sum())


def test_the_true_mesh_of_a_job_scores_one(scene: Path, tmp_path: Path) -> None:
    job = write_job(tmp_path / "job", MESH, CAMERAS, JOB_FROM_TRUTH)
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
    tanks = read_tanks(scene)
    cameras = [camera.moved(JOB_FROM_TRUTH) for camera in CAMERAS]
    start = align_to_log(cameras, tanks, seed=0).transform
    placed = JOB_FROM_TRUTH.points(MESH[0])
    result = score_tanks(
        placed, MESH[1], cameras[::2], tanks, start, refine=False, protocols=("scan",)
    )["scan"]
    assert result["score"]["f1"] >= 0.99
    assert result["refinement"] is None
    with pytest.raises(UsageError, match="needs cameras"):
        score_tanks(placed, MESH[1], [], tanks, start, refine=False, protocols=("scan",))


def test_a_mesh_that_is_wrong_in_one_half_loses_that_half(scene: Path) -> None:
    (vertices, faces), good = half_wrong()
    tanks = read_tanks(scene)
    cameras = [camera.moved(JOB_FROM_TRUTH) for camera in CAMERAS]
    start = align_to_log(cameras, tanks, seed=0).transform
    placed = JOB_FROM_TRUTH.points(vertices)
    score = score_tanks(
        placed, faces, cameras, tanks, start,
        refine=False, protocols=("uniform",), samples=40_000,
    )["uniform"]["score"]  # fmt: skip
    # Within tau of the seam, true points of the other half are met too.
    assert score["precision"] == pytest.approx(good, abs=0.03)
    assert score["recall"] == pytest.approx(good, abs=0.06)
    # The half alone is refined to its place: it is precise, and complete by half.
    half = faces[faces.max(1) < len(MESH[0])]
    score = score_tanks(
        placed, half, cameras, tanks, start,
        refine=True, protocols=("uniform",), samples=20_000,
    )["uniform"]["score"]  # fmt: skip
    assert score["precision"] >= 0.995
    assert score["recall"] == pytest.approx(good, abs=0.06)
    assert 0.4 < good < 0.6


def test_the_same_seed_gives_the_same_figures(scene: Path) -> None:
    tanks = read_tanks(scene, 0.05)
    cameras = [camera.moved(JOB_FROM_TRUTH) for camera in CAMERAS]
    start = align_to_log(cameras, tanks, seed=3).transform
    placed = JOB_FROM_TRUTH.points(MESH[0])
    first, second = (
        score_tanks(
            placed,
            MESH[1],
            [],
            tanks,
            start,
            refine=True,
            protocols=("uniform",),
            samples=10_000,
            seed=3,
            threads=threads,
        )
        for threads in (1, 2)
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
    some = [camera.moved(JOB_FROM_TRUTH) for camera in CAMERAS[::2]]
    found = align_to_log(some, tanks, seed=0)
    error = found.transform.points(JOB_FROM_TRUTH.points(MESH[0])) - MESH[0]
    assert np.linalg.norm(error, axis=1).max() < 4 * NOISE


def test_cameras_that_are_of_another_scene_are_refused(scene: Path) -> None:
    rng = np.random.default_rng(0)
    others = [
        Camera(n, 4, 4, 4.0, 4.0, 2.0, 2.0, np.c_[np.eye(3), rng.normal(size=3) * 9]) for n in NAMES
    ]
    with pytest.raises(DatasetError, match=r"match the trajectory|do not correspond"):
        align_to_log(others, read_tanks(scene), seed=0)


def test_thresholds_are_those_of_the_benchmark() -> None:
    assert THRESHOLDS == {
        "barn": 0.01, "caterpillar": 0.005, "courthouse": 0.025,
        "ignatius": 0.003, "meetingroom": 0.01, "truck": 0.005,
    }  # fmt: skip


@pytest.fixture
def copied(scene: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(scene, tmp_path / "Courthouse"))


def test_a_scene_without_threshold_needs_one(copied: Path) -> None:
    folder = copied.rename(copied.with_name("Shed"))
    for path in list(folder.iterdir()):
        path.rename(folder / path.name.replace("Courthouse", "Shed"))
    with pytest.raises(UsageError, match="--distances"):
        read_tanks(folder)
    assert read_tanks(folder, 0.5).threshold == 0.5


def test_a_missing_crop_is_named(copied: Path) -> None:
    (copied / "Courthouse.json").unlink()
    with pytest.raises(DatasetError, match=r"holds no Courthouse\.json") as caught:
        read_tanks(copied)
    assert caught.value.exit_code == 3


def test_the_log_is_read_and_bad_lines_are_named(copied: Path) -> None:
    path = copied / "Courthouse_COLMAP_SfM.log"
    numbers, poses = read_trajectory(path)
    assert numbers.tolist() == list(range(21))
    assert poses.shape == (21, 4, 4)
    lines = path.read_text().splitlines()
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


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1 0 0\n0 1 0\n0 0 1\n", "4x4 matrix was expected"),
        ("1 0 0 0\n0 1 0 0\n0 0 -1 0\n0 0 0 1\n", "mirrors"),
        ("1 0 0 0\n0 1 0 0\n0 0 5 0\n0 0 0 1\n", "not a rotation"),
        ("1 0 0 nan\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "not finite"),
        ("1 0 0 x\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "could not convert"),
    ],
)
def test_bad_matrices_are_refused(text: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "Barn_trans.txt"
    path.write_text(text)
    with pytest.raises(ParseError, match=words):
        read_matrix(path)


def test_a_cut_cloud_is_refused(copied: Path) -> None:
    path = copied / "Courthouse.ply"
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ParseError, match=r"Courthouse\.ply, byte .*cut off"):
        read_tanks(copied)
