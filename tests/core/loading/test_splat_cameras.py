# SPDX-License-Identifier: GPL-3.0-or-later
"""Virtual cameras around a splat, and the check of a splat as an input."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import DatasetError
from gaussian_wrapping_addon.core.jobs.store.stage_folder import source_fingerprint
from gaussian_wrapping_addon.core.limits import SCENE_RADIUS
from gaussian_wrapping_addon.core.loading.check import check_input
from gaussian_wrapping_addon.core.loading.load import load_scene
from gaussian_wrapping_addon.core.loading.other_inputs import (
    cameras_on_spheres,
    fibonacci_directions,
    scene_frame,
    splat_extent,
)
from gaussian_wrapping_addon.core.progress import Progress
from tests.core.gaussians.splat_files import permuted, splat_columns, write_ply
from tests.core.training.splat_shells import shell_of_discs

OFFSET = np.array([5e5, -4e6, 30.0])


def test_the_far_cameras_hold_the_whole_and_look_at_its_middle() -> None:
    points = OFFSET + 7.0 * fibonacci_directions(500)
    extent = splat_extent(points, np.ones(500))
    assert np.linalg.norm(extent.center - OFFSET) < 0.1
    assert extent.radius == pytest.approx(7.0, rel=0.02)
    assert not extent.has_surroundings
    cameras = cameras_on_spheres(extent)
    assert len(cameras) == len({camera.name for camera in cameras}) == 48
    for index, camera in enumerate(cameras):
        np.testing.assert_allclose(camera.rotation @ camera.rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(camera.rotation) == pytest.approx(1.0)
        pixels, depth = camera.project(points)
        assert (depth > 0).all()
        inside = (pixels > 0).all(1) & (pixels < camera.width).all(1)
        assert inside.all() == (index < 28)
        middle, _ = camera.project(extent.center[None])
        np.testing.assert_allclose(middle[0], camera.cx, atol=1e-3)
        assert camera.rotation[1, 2] < 0  # up in the file is up in the photo


def test_the_scene_frame_keeps_the_axes_and_fits_the_radius() -> None:
    cameras = cameras_on_spheres(splat_extent(OFFSET + fibonacci_directions(200), np.ones(200)))
    frame = scene_frame(cameras)
    assert np.array_equal(frame.rotation, np.eye(3))
    centers = frame.points(np.stack([camera.center for camera in cameras]))
    np.testing.assert_allclose(centers.mean(0), 0.0, atol=1e-6)
    reach = np.linalg.norm(centers, axis=1).max()
    assert 1.1 * reach == pytest.approx(SCENE_RADIUS, rel=1e-6)


def test_surroundings_do_not_push_the_cameras_out() -> None:
    far = 60.0 * fibonacci_directions(150)
    points = np.concatenate([fibonacci_directions(500), far, 1e4 * np.ones((400, 3))])
    opacities = np.concatenate([np.full(650, 0.9), np.full(400, 0.01)])
    extent = splat_extent(points, opacities)
    assert extent.has_surroundings
    assert np.linalg.norm(extent.center) < 0.5
    assert extent.radius < 5.0


@pytest.mark.parametrize("where", [1e30, -3e38, 1e300])
@pytest.mark.parametrize("row", [0, 499])
def test_one_gaussian_as_far_away_as_numbers_go_changes_nothing(row: int, where: float) -> None:
    points = fibonacci_directions(500) + np.array([1000.0, 20.0, 0.0])
    opacities = np.full(500, 0.9)
    alone = splat_extent(np.delete(points, row, 0), opacities[1:])
    points[row] = where
    extent = splat_extent(points, opacities)
    assert extent.center == pytest.approx(alone.center, abs=0.02)
    assert extent.radius == pytest.approx(alone.radius, rel=0.01)


def test_scattered_transparent_and_collapsed_splats_are_refused() -> None:
    directions, ones = fibonacci_directions(50), np.ones(50)
    for points, opacities, words in (
        (1e200 * directions, ones, "scattered too far"),
        (directions, np.zeros(50), "transparent"),
        (np.ones((50, 3)), ones, "coincide"),
    ):
        with pytest.raises(DatasetError, match=words):
            splat_extent(points, opacities)


def test_the_check_tells_what_a_splat_holds_and_what_it_lacks(tmp_path: Path) -> None:
    columns = splat_columns(shell_of_discs(40, sh_degree=3)[0])
    path = write_ply(tmp_path / "a.ply", columns, order=permuted(columns), encoding=">")
    findings = check_input(path)
    assert [f.severity for f in findings] == ["fact", "fact", "warning"]
    assert "40 Gaussians" in findings[1].message
    assert "degree 3" in findings[1].message
    assert "photos" in findings[2].hint


def test_the_check_finds_files_that_are_cut_off_or_no_splats(tmp_path: Path) -> None:
    path = write_ply(tmp_path / "a.ply", splat_columns(shell_of_discs(40, sh_degree=3)[0]))
    with pytest.raises(DatasetError, match="no cameras"):
        load_scene(path, tmp_path / "work", Progress())
    path.write_bytes(path.read_bytes()[:-1])
    assert "again" in check_input(path)[-1].hint
    cloud = write_ply(tmp_path / "b.ply", {axis: np.arange(9.0) for axis in "xyz"})
    cases = [(path, "cut off"), (cloud, "opacity")]
    for suffix in (".spz", ".splat"):
        (tmp_path / f"a{suffix}").write_bytes(b"x")
        cases.append((tmp_path / f"a{suffix}", "not supported"))
    for path, words in cases:
        finding = check_input(path)[-1]
        assert finding.severity == "error"
        assert words in finding.message


def test_only_the_splat_itself_decides_its_fingerprint(tmp_path: Path) -> None:
    path = write_ply(tmp_path / "a.ply", splat_columns(shell_of_discs(40)[0]))
    before = source_fingerprint(path)
    (tmp_path / "other.ply").write_bytes(b"ply")
    assert source_fingerprint(path) == before
    path.write_bytes(path.read_bytes() + b"\n")
    assert source_fingerprint(path) != before
