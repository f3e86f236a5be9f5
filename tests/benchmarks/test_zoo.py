# SPDX-License-Identifier: GPL-3.0-or-later
"""The zoo of scenes: drawn again the same, closed solids in their region, cameras that see them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from benchmarks.scenes.build import SparsePoints
from benchmarks.scenes.geometry import joined
from benchmarks.study import read_records, record_path, write_record
from benchmarks.tables import three
from benchmarks.zoo import __main__ as command
from benchmarks.zoo import shapes
from benchmarks.zoo.catalogue import (
    DEVELOPMENT,
    FAMILIES,
    FEW,
    SCENES,
    TEST,
    draw_content,
    draw_photography,
    zoo_scene,
)
from benchmarks.zoo.looks import SKY_NAME, Content
from benchmarks.zoo.scene import disturbed_poses, found_points, scene_folder
from benchmarks.zoo.study import (
    BASELINES,
    FIGURES,
    alpha_case,
    floaters,
    is_made,
    open_share,
    read_labels,
    run_case,
    write_document,
)
from gaussian_wrapping_addon.core.errors import ParseError, UsageError
from gaussian_wrapping_addon.core.mesh.depth_buffer import depth_buffer
from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.benchmarks.invented_records import invented

ONE_OF_EACH = [f"{family}-d1" for family in FAMILIES]


def _open_edges(faces: np.ndarray) -> int:
    """Return the number of edges that are not met as often in one direction as in the other."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    _, index = np.unique(np.sort(edges, 1), axis=0, return_inverse=True)
    sign = np.where(edges[:, 0] < edges[:, 1], 1.0, -1.0)
    return int((np.bincount(index.reshape(-1), sign) != 0).sum())


def _volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def _shown(content: Content, camera: Camera) -> np.ndarray:
    """Return (h, w) int: 1 where a small photo shows the subject, 2 around it, 0 nothing."""
    parts = (*content.subject.parts, *content.around)
    small = camera.resized(camera.width // 4, camera.height // 4)
    face = depth_buffer(*joined(parts), small).face
    owner = np.repeat(
        [1] * len(content.subject.parts) + [2] * len(content.around), [len(p.faces) for p in parts]
    )
    return np.where(face >= 0, owner[np.maximum(face, 0)], 0)


def test_both_parts_have_every_family_and_enough_scenes() -> None:
    for part, least in ((DEVELOPMENT, 24), (TEST, 12)):
        mine = [scene for scene in SCENES.values() if scene.part == part]
        assert len(mine) >= least
        assert {scene.family for scene in mine} == set(FAMILIES)
    assert len({scene.seed for scene in SCENES.values()}) == len(SCENES)
    assert any(draw_photography(scene).photos == FEW for scene in SCENES.values())
    for scene in SCENES.values():
        shot = draw_photography(scene)
        assert 400 <= max(shot.width, shot.height) <= 800
        assert shot.photos == FEW if scene.few else 24 <= shot.photos <= 48


@pytest.mark.parametrize("name", ONE_OF_EACH)
def test_a_seed_draws_the_same_scene_again(name: str) -> None:
    one, other = draw_content(zoo_scene(name)), draw_content(zoo_scene(name))
    assert one.photography == other.photography
    assert one.light == other.light
    assert one.looks == other.looks
    for a, b in zip(one.subject.parts, other.subject.parts, strict=True):
        np.testing.assert_array_equal(a.vertices, b.vertices)
        np.testing.assert_array_equal(a.faces, b.faces)
    for c, d in zip(one.cameras, other.cameras, strict=True):
        np.testing.assert_array_equal(c.cam_from_world, d.cam_from_world)


def test_two_scenes_of_a_family_differ() -> None:
    one, other = (draw_content(zoo_scene(name)) for name in ("smooth-d1", "smooth-t1"))
    assert one.photography != other.photography
    assert one.subject.looks != other.subject.looks


@pytest.mark.parametrize("name", SCENES)
def test_solids_are_closed_and_lie_in_the_region(name: str) -> None:
    content = draw_content(zoo_scene(name))
    for part in content.subject.parts:
        assert _open_edges(part.faces) == 0, part.name
        assert _volume(part.vertices, part.faces) > 0, part.name
        assert content.region.contains(part.vertices).all()
    assert {p.material for p in (*content.subject.parts, *content.around)} <= set(content.looks)
    if not content.subject.place:
        assert content.region.contains(content.crop.vertices).all()
        # Only the thing is in its region.
        sheets = [p for p in content.around if p.name != SKY_NAME]
        assert not content.region.contains(joined(sheets)[0]).any()


@pytest.mark.parametrize("name", SCENES)
def test_cameras_see_the_subject(name: str) -> None:
    content = draw_content(zoo_scene(name))
    least = 0.35 if content.subject.place else 0.004
    for camera in (*content.cameras[::8], *content.test_cameras[::4]):
        assert (_shown(content, camera) == 1).mean() > least


@pytest.mark.parametrize("name", SCENES)
def test_nothing_is_unseen_behind_a_photo(name: str) -> None:
    """Every photo is filled: by the subject, by what is around it, or by the sky."""
    content = draw_content(zoo_scene(name))
    for camera in content.cameras[::6]:
        assert (_shown(content, camera) > 0).mean() > 0.995


def test_a_leaf_and_a_perforated_plate_have_their_thickness_and_holes() -> None:
    vertices, faces = shapes.perforated(3, 2, 0.2, 0.12, 0.02)
    assert _open_edges(faces) == 0
    # Plate less six polygons of 16 corners.
    polygon = 8 * 0.06**2 * np.sin(np.pi / 8)
    assert _volume(vertices, faces) == pytest.approx(0.02 * (6 * 0.04 - 6 * polygon), rel=1e-3)
    vertices, faces = shapes.leaf(1.0, 0.4, 0.0, 0.01)
    assert _volume(vertices, faces) == pytest.approx(0.01 * 0.27, rel=0.15)


def test_wrong_poses_shift_pixels_by_the_noise() -> None:
    content = draw_content(zoo_scene("smooth-d1"))
    cameras = list(content.cameras)
    assert all(
        np.allclose(a.cam_from_world, b.cam_from_world)
        for a, b in zip(disturbed_poses(cameras, 0.0, 3.0, 1), cameras, strict=True)
    )
    shifts = []
    for moved, camera in zip(disturbed_poses(cameras, 0.5, 3.0, 1), cameras, strict=True):
        point = camera.center + 3.0 * camera.forward
        shifts.append(moved.project(point[None])[0][0] - camera.project(point[None])[0][0])
    assert 0.3 < np.std(shifts) < 0.75


class _Plane:
    """A wall at y = 0 that everything sees; both sides stop rays."""

    normals = np.array([[0.0, -1.0, 0.0]])

    def first_hits(
        self, origins: np.ndarray, directions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        distance = -origins[:, 1] / directions[:, 1]
        return np.where(distance > 0, distance, np.inf), np.where(distance > 0, 0, -1)

    def sees(self, camera: Camera, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        pixels, depth = camera.project(points)
        return (depth > 0) & ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(1)


def _wall_points(*, noise: float = 0.0, outliers: float = 0.0) -> tuple[SparsePoints, list[Camera]]:
    """Return sparse points of a wall that has texture in the left half of each photo only."""
    content = draw_content(zoo_scene("holed-d2"))  # photographed from one side
    cameras = list(content.cameras[:8])
    shot = dataclasses.replace(
        content.photography, point_noise=noise, outliers=outliers, weak_texture=5.0
    )
    random = np.random.default_rng(0)
    photos = []
    for camera in cameras:
        photo = np.full((camera.height, camera.width, 3), 120, np.uint8)
        half = camera.width // 2
        photo[:, :half] = random.integers(0, 255, (camera.height, half, 1))
        photos.append(photo)
    return found_points(_Plane(), cameras, photos, shot, 3), cameras  # type: ignore[arg-type]


def test_sparse_points_leave_out_what_has_no_texture() -> None:
    sparse, cameras = _wall_points()
    assert len(sparse.points) > 100
    for index, camera in enumerate(cameras):
        assert (sparse.pixels[sparse.camera_ids == index, 0] < camera.width / 2 + 6).all()
    assert (np.diff(sparse.point_ids) >= 0).all()
    assert np.bincount(sparse.point_ids).min() >= 3


def test_sparse_points_have_noise_and_outliers_as_asked() -> None:
    exact, noisy, wrong = (
        np.abs(_wall_points(noise=n, outliers=o)[0].points[:, 1])
        for n, o in ((0.0, 0.0), (3.0, 0.0), (0.0, 0.2))
    )
    assert np.median(exact) < 0.02
    assert np.median(noisy) > 1.5 * np.median(exact)
    assert (exact > 0.3).mean() < 0.02
    assert 0.1 < (wrong > 0.3).mean() < 0.25


def test_openings_that_a_mesh_closes_are_counted() -> None:
    pose = np.eye(3, 4)
    pose[2, 3] = 3.0
    camera = Camera("a", 80, 60, 80.0, 80.0, 40.0, 30.0, pose)
    vertices, faces = shapes.perforated(1, 1, 2.0, 1.2, 0.05)
    upright = vertices[:, [0, 2, 1]]
    assert open_share((upright, faces), (upright, faces), [camera], 1) == 1.0
    cover = np.array([[-1.0, -1, 0.3], [0, -1, 0.3], [0, 1, 0.3], [-1, 1, 0.3]])
    half = (cover, np.array([[0, 1, 2], [0, 2, 3]]))
    found = open_share(half, (upright, faces), [camera], 1)
    assert found is not None
    assert 0.4 < found < 0.6
    assert open_share(half, half, [camera], 1) is None


def test_a_page_is_written_from_records_alone(tmp_path: Path) -> None:
    records = [
        invented(run_case("thin-d1", "draft", "draft", ())),
        invented(run_case("thin-d2", "draft", "draft", ()), 0.5),
        invented(run_case("thin-t1", "draft", "draft", ()), 0.3),
        invented(run_case("thin-d1", "more", "draft", ("--iterations", "9"))),
        invented(alpha_case("thin-d1"), 0.2),
    ]
    for record in records[:2] + records[4:]:  # the others are of an earlier version of the scene
        record.scores[FIGURES] = {"scene": scene_folder(record.case.scene).name}
    records[0].scores["depths"] = {
        stage: {"within": [share, share + 0.1, share + 0.2]}
        for stage, share in (("start", 0.1), ("trained", 0.4), ("mesh", 0.7))
    }
    for record in records:
        write_record(record, tmp_path)
    found = read_labels(tmp_path)
    assert {label: list(mine) for label, mine in found.items()} == {
        "draft": ["thin-d1", "thin-d2", "thin-t1"],
        "more": ["thin-d1"],
        BASELINES: ["thin-d1"],
    }
    assert found["draft"]["thin-d2"] == records[1]
    path = write_document(tmp_path, tmp_path)
    assert path is not None
    text = path.read_text()
    assert "python -m benchmarks.zoo --preset draft --label more --clean -- --iterations 9" in text
    (row,) = [
        line
        for line in text.split("## more")[0].splitlines()
        if line.startswith("| thin ") and "| 2 " in line
    ]
    seen = [record.f1(1, "scan") for record in records[:2]]
    assert f"{np.mean(seen):.3f} ({min(seen):.3f})" in row
    assert f"{floaters(records[1]):.3f}" in row
    assert "| thin-t1 * |" in text
    assert "| thin-d2 |" in text.replace("  ", "")
    depths = text.split("## more")[0].split("### Depths")[1].splitlines()
    (row,) = [line for line in depths if line.startswith("| thin-")]
    cells = [cell.strip() for cell in row.strip("| ").split("|")]
    assert cells == ["thin-d1", *(f"{k / 10:.3f}" for k in range(1, 10))]
    alpha = next(line for line in text.splitlines() if line.startswith("| thin-d1 |"))
    assert three(records[4].f1(1, "scan")) in alpha
    assert write_document(tmp_path, tmp_path / "nothing") is None


def test_further_arguments_need_a_label_and_scenes_a_known_name() -> None:
    assert command.main(["--only", "thin-d1", "--", "--iterations", "9"]) != 0
    with pytest.raises(UsageError, match="thin-d9"):
        zoo_scene("thin-d9")


def test_records_of_other_arguments_are_refused(tmp_path: Path) -> None:
    write_record(invented(run_case("thin-d1", "x", "draft", ())), tmp_path)
    with pytest.raises(ParseError, match="other settings"):
        read_records([run_case("thin-d1", "x", "draft", ("--iterations", "9"))], tmp_path)


def test_a_run_on_an_earlier_version_of_its_scene_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    case = run_case("thin-d1", "x", "draft", ())
    monkeypatch.setattr(
        "benchmarks.zoo.study.record_path", lambda case: record_path(case, tmp_path)
    )
    assert not is_made(case)
    for scene, made in (("zoo-thin-d1-before", False), (scene_folder("thin-d1").name, True)):
        record = invented(case)
        record.scores[FIGURES] = {"scene": scene}
        write_record(record, tmp_path)
        assert is_made(case) is made


def test_folders_of_scenes_are_told_apart_by_name_and_sources(tmp_path: Path) -> None:
    names = {scene_folder(name, tmp_path).name for name in SCENES}
    assert len(names) == len(SCENES)
    assert scene_folder("thin-d1", tmp_path).name.startswith("zoo-thin-d1-")
