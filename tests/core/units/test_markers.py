# SPDX-License-Identifier: GPL-3.0-or-later
"""Markers: corners to hundredths of a pixel, and the scale of a rendered scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import DatasetError
from gaussian_wrapping_addon.core.loading import load
from gaussian_wrapping_addon.core.loading.real_world import UnitsRequest
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.settings.job import MarkerSpec
from gaussian_wrapping_addon.core.units.markers import (
    SeenMarker,
    find_markers,
    refined_corners,
    scale_from_markers,
)
from tests.core.units.marker_scene import (
    DICTIONARY,
    SIDE_M,
    UNITS_PER_METRE,
    photograph,
    ring_cameras,
    table_scene,
    write_photos,
)

cv2 = pytest.importorskip("cv2")
SPEC = MarkerSpec(DICTIONARY, SIDE_M)


def true_corners(number: int) -> np.ndarray:
    """Return the (4, 3) corners of a marker of the table, in the detector's order."""
    quad = table_scene()[1 + 3 * 5 + number]
    share = 1.0 / 6.0  # of the paper, which is one side and a quarter on either end
    places = [(share, share), (1 - share, share), (1 - share, 1 - share), (share, 1 - share)]
    return np.array([quad.corner + s * quad.right + t * quad.down for s, t in places])


@pytest.fixture(scope="module")
def photo() -> tuple[np.ndarray, Camera]:
    camera = ring_cameras(10, 480, 360)[0]
    return photograph(table_scene(), camera), camera


def test_corners_of_a_rendered_marker(photo: tuple[np.ndarray, Camera]) -> None:
    grey, camera = photo
    errors = []
    for number in range(8):
        exact, depth = camera.project(true_corners(number))
        inside = (exact > 6).all() and (exact < [camera.width - 6, camera.height - 6]).all()
        sides = np.linalg.norm(np.roll(exact, -1, 0) - exact, axis=1)
        if not inside or depth.min() <= 0 or sides.min() < 24:
            continue
        rough = exact + np.random.default_rng(number).normal(0, 0.4, (4, 2))
        found = refined_corners(grey, rough, 6)
        if found is not None:
            errors.append(np.linalg.norm(found - exact, axis=1))
    assert len(errors) >= 2
    assert np.median(errors) < 0.08
    assert np.max(errors) < 0.3


def test_no_edges_no_corners(photo: tuple[np.ndarray, Camera]) -> None:
    grey, _ = photo
    square = np.array([[0.0, 0], [40, 0], [40, 40], [0, 40]])
    assert refined_corners(np.full((100, 100), 90, np.uint8), square + 30, 6) is None
    assert refined_corners(grey, square / 8 + 50, 6) is None, "too small"
    assert refined_corners(grey, square + np.array([460, 340]), 6) is None, "beyond the border"


@pytest.mark.proof
def test_scale_of_a_rendered_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Photos of a lens with distortion and exact cameras: within 0.3 % (acceptance)."""
    # Points are no part of it, and take long to find.
    none = (np.zeros((0, 3)), np.zeros((0, 3), np.uint8), "none")
    monkeypatch.setattr(load, "make_start_points", lambda *_args, **_more: none)
    write_photos(tmp_path / "set", 6, 480, 360, k1=-0.08)
    scene = load.load_scene(
        tmp_path / "set", tmp_path / "work", Progress(),
        threads=1, units=UnitsRequest(markers=f"{DICTIONARY}:{SIDE_M}"),
    )  # fmt: skip
    record = scene.facts["georeference"]
    assert record["sources"] == ["markers"]
    assert record["applied"] is True
    assert scene.facts["photos_undistorted"] == 6
    error = record["world_from_input"]["scale"] * UNITS_PER_METRE - 1.0
    assert abs(error) < 3e-3
    assert abs(error) < 5 * record["scale_error"] < 0.02
    assert record["markers"]["used"] >= 3
    # The scene's world is in metres, with the axes of the input.
    first = ring_cameras(6, 480, 360)[0]
    found = scene.world_from_scene.points(scene.cameras[0].center[None])[0]
    np.testing.assert_allclose(found, first.center / UNITS_PER_METRE, rtol=3e-3, atol=1e-3)
    assert not (tmp_path / "work" / "markers").exists()


def test_another_dictionary_finds_nothing(tmp_path: Path) -> None:
    from PIL import Image

    Image.new("RGB", (64, 64), (120, 90, 60)).save(tmp_path / "a.png")
    spec = MarkerSpec("apriltag_36h11", 0.1)
    seen = find_markers(spec, [tmp_path / "a.png"], tmp_path, Progress(), threads=1)
    assert seen == {}
    with pytest.raises(DatasetError, match=r"No apriltag_36h11 marker .* Check the dictionary"):
        scale_from_markers(spec, [], seen)


def exact_markers(side_units: dict[int, float]) -> tuple[list[Camera], dict[int, list[SeenMarker]]]:
    """Return cameras and the exact corners of flat squares of given sides."""
    cameras = ring_cameras(6, 640, 480)
    seen: dict[int, list[SeenMarker]] = {}
    for number, side in side_units.items():
        middle = np.array([0.4 * number, 0.3 * number - 0.5, 0.0])
        square = side * np.array([[-0.5, 0.5, 0], [0.5, 0.5, 0], [0.5, -0.5, 0], [-0.5, -0.5, 0]])
        seen[number] = [
            SeenMarker(i, camera.project(square + middle)[0]) for i, camera in enumerate(cameras)
        ]
    return cameras, seen


def test_exact_corners_give_the_exact_scale() -> None:
    cameras, seen = exact_markers({0: 0.5, 1: 0.5, 2: 0.5})
    found = scale_from_markers(MarkerSpec("4x4_50", 0.05), cameras, seen)
    assert found.metres_per_unit == pytest.approx(0.1, rel=1e-9)
    assert found.details["markers"]["used"] == 3
    assert 0 < found.error < 1e-3


def test_a_marker_of_another_size_is_left_out() -> None:
    cameras, seen = exact_markers({0: 0.5, 1: 0.5, 2: 0.56, 3: 0.5})
    found = scale_from_markers(MarkerSpec("4x4_50", 0.05), cameras, seen)
    assert found.metres_per_unit == pytest.approx(0.1, rel=1e-9)
    assert found.details["markers"]["left_out"] == ["2"]
    cameras, seen = exact_markers({0: 0.5, 1: 0.7})
    with pytest.raises(DatasetError, match="differ in size by 33 %"):
        scale_from_markers(MarkerSpec("4x4_50", 0.05), cameras, seen)


def test_what_no_two_photos_agree_about() -> None:
    cameras, seen = exact_markers({0: 0.5, 1: 0.5})
    once = {0: seen[0][:1]}
    with pytest.raises(DatasetError, match="no two photos agree"):
        scale_from_markers(SPEC, cameras, once)
    # The same number at two places: half of the photos show the one, half the other.
    twice = {0: [seen[i % 2][i] for i in range(6)], 1: seen[1]}
    found = scale_from_markers(SPEC, cameras, {**twice, 7: seen[1][:1]})
    assert found.details["markers"]["not_measured"] == ["0", "7"]
    assert found.metres_per_unit == pytest.approx(SIDE_M / 0.5, rel=1e-9)
