# SPDX-License-Identifier: GPL-3.0-or-later
"""Control points: their files, triangulation, and the frame that they give."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gaussian_wrapping_addon.core.errors import DatasetError, ParseError
from gaussian_wrapping_addon.core.scene.camera import Camera, Similarity
from gaussian_wrapping_addon.core.units.control_points import (
    MAX_FILE_BYTES,
    ControlFile,
    ControlFit,
    CoordinateSystem,
    Observations,
    TriangulatedPoint,
    fit_control_points,
    parse_control_file,
    read_control_file,
    triangulate,
)
from gaussian_wrapping_addon.core.units.georeference import geographic_from_enu, utm_from_geographic
from tests.poses import look_at_pose

FILE = Path("gcp.txt")
GOOD = """\
# marks on the wall
LOCAL

1.0 2.0 3.0 10.5 20.5 a.jpg corner
1 2 3 30 40 sub/b.jpg corner
4 5 6 1 2 a.jpg
4 5 6 3 4 sub\\b.jpg
"""


def test_points_are_gathered_by_name_or_place() -> None:
    found = parse_control_file(GOOD, FILE)
    assert found.system == CoordinateSystem("local")
    corner, unnamed = found.points
    assert (corner.name, corner.photos, corner.lines) == ("corner", ("a.jpg", "sub/b.jpg"), (4, 5))
    np.testing.assert_array_equal(corner.pixels, [[10.5, 20.5], [30, 40]])
    np.testing.assert_array_equal(corner.position, [1, 2, 3])
    assert (unnamed.name, unnamed.photos) == ("4 5 6", ("a.jpg", "sub/b.jpg"))


def test_tabs_allow_spaces_in_names() -> None:
    (point,) = parse_control_file("local\n1\t2\t3\t4\t5\tmy photo.jpg\tthe corner\n", FILE).points
    assert (point.name, point.photos) == ("the corner", ("my photo.jpg",))


@pytest.mark.parametrize(
    ("head", "wanted"),
    [
        ("EPSG:4326", CoordinateSystem("EPSG:4326")),
        ("epsg: 4979", CoordinateSystem("EPSG:4979")),
        ("+proj=longlat +datum=WGS84 +no_defs", CoordinateSystem("EPSG:4326")),
        ("EPSG:32633", CoordinateSystem("EPSG:32633", 33, True)),
        ("EPSG:32756", CoordinateSystem("EPSG:32756", 56, False)),
        ("WGS84 UTM 17N", CoordinateSystem("EPSG:32617", 17, True)),
        ("+proj=utm +zone=10 +ellps=WGS84 +south", CoordinateSystem("EPSG:32710", 10, False)),
    ],
)
def test_systems(head: str, wanted: CoordinateSystem) -> None:
    assert parse_control_file(f"{head}\n", FILE).system == wanted


def test_geographic_and_utm_become_the_same_metres() -> None:
    places = np.array([[46.8401, -91.99, 200.0], [46.8412, -91.991, 210.0], [46.839, -91.98, 190]])
    by_degrees, origin = CoordinateSystem("EPSG:4326").to_metric(places[:, [1, 0, 2]])
    utm = utm_from_geographic(places, 15, True)
    by_utm, same = CoordinateSystem("EPSG:32615", 15, True).to_metric(utm)
    assert origin is not None
    assert same is not None
    np.testing.assert_allclose(by_utm, by_degrees, atol=1e-6)
    np.testing.assert_allclose(geographic_from_enu(by_utm, same), places, atol=1e-8)
    local, nowhere = CoordinateSystem("local").to_metric(places)
    assert nowhere is None
    assert local is places


@pytest.mark.parametrize(
    ("text", "where", "words"),
    [
        ("", "whole file", "empty"),
        ("1 2 3 4 5 a.jpg\n", "line 1", "no known system"),
        ("EPSG:2056\n", "line 1", "EPSG:2056 is not known here"),
        ("+proj=utm +zone=61\n", "line 1", "no known system"),
        ("LOCAL\n1 2 3 4 5\n", "line 2", "5 entries, 6 are needed"),
        ("LOCAL\n\n1 2 x 4 5 a.jpg\n", "line 3", "'x' is not a coordinate"),
        ("LOCAL\n1 2 nan 4 5 a.jpg\n", "line 2", "'nan' is not a coordinate"),
        ("LOCAL\n1 2 1e300 4 5 a.jpg\n", "line 2", "'1e300' is not"),
        ("LOCAL\n1 2 3 4 5 a.jpg p\n1 2 4 4 5 b.jpg p\n", "line 3", "than in line 2"),
        ("LOCAL\n1 2 3 4 5 a.jpg p\n1 2 3 4 6 a.jpg p\n", "line 3", "already, in line 2"),
    ],
)
def test_the_wrong_line_is_named(text: str, where: str, words: str) -> None:
    with pytest.raises(ParseError, match=words) as caught:
        parse_control_file(text, FILE)
    assert caught.value.location == where
    assert "gcp.txt" in caught.value.message


def test_files(tmp_path: Path) -> None:
    path = tmp_path / "gcp.txt"
    with pytest.raises(DatasetError, match="cannot be read"):
        read_control_file(path)
    path.write_bytes(b"\xef\xbb\xbf" + GOOD.replace("\n", "\r\n").encode())
    assert len(read_control_file(path).points) == 2
    path.write_bytes(b"LOCAL\n\xff\xfe")
    with pytest.raises(ParseError, match="not UTF-8"):
        read_control_file(path)
    with path.open("wb") as stream:
        stream.truncate(MAX_FILE_BYTES + 1)
    with pytest.raises(DatasetError, match="larger than 16 MiB"):
        read_control_file(path)


def ring(count: int, spread_deg: float = 120.0) -> list[Camera]:
    out = []
    for i in range(count):
        angle = np.radians(spread_deg) * i / max(count - 1, 1)
        eye = [4 * np.cos(angle), 4 * np.sin(angle), 1.0 + 0.3 * (i % 3)]
        out.append(Camera(str(i), 640, 480, 600, 610, 322, 236, look_at_pose(eye)))
    return out


POINT = np.array([0.2, -0.3, 0.4])
WRONG = {1: (40.0, 3.0), 4: (-60.0, 20.0), 7: (0.0, 90.0)}


def pixels_of(cameras: list[Camera]) -> np.ndarray:
    return np.array([c.project(POINT[None])[0][0] for c in cameras])


def point_of(
    cameras: list[Camera], pixels: np.ndarray, reach: float = 3.0
) -> TriangulatedPoint | None:
    return triangulate(cameras, pixels, threshold_px=reach, noise_px=0.1)


@pytest.mark.parametrize("wrong", [{}, WRONG])
def test_exact_observations_give_the_exact_point_and_wrong_ones_are_left_out(
    wrong: dict[int, tuple[float, float]],
) -> None:
    cameras = ring(10)
    pixels = pixels_of(cameras)
    for number, error in wrong.items():
        pixels[number] += error
    found = point_of(cameras, pixels)
    assert found is not None
    np.testing.assert_allclose(found.position, POINT, atol=1e-12)
    assert list(np.flatnonzero(~found.used)) == list(wrong)
    for number, error in wrong.items():
        assert found.residuals_px[number] == pytest.approx(np.hypot(*error))


def test_the_covariance_is_that_of_repeated_clicks() -> None:
    cameras, rng = ring(7), np.random.default_rng(0)
    exact = pixels_of(cameras)
    found = [
        triangulate(cameras, exact + rng.normal(0, 0.5, exact.shape), threshold_px=5, noise_px=0.5)
        for _ in range(300)
    ]
    scatter = np.cov(np.array([f.position for f in found if f is not None]).T)
    stated = np.mean([f.covariance for f in found if f is not None], axis=0)
    np.testing.assert_allclose(np.linalg.eigvalsh(scatter), np.linalg.eigvalsh(stated), rtol=0.4)


def test_what_cannot_be_triangulated() -> None:
    near = ring(4, spread_deg=0.5)[::3]  # at the same height
    for cameras in (near, near[:1]):
        assert point_of(cameras, pixels_of(cameras)) is None
    assert point_of([], np.zeros((0, 2))) is None
    apart = ring(3)
    wild = pixels_of(apart) + np.array([[0, 200.0], [0, -150.0], [0, 30.0]])
    assert point_of(apart, wild) is None
    # The rays diverge: they meet behind both cameras.
    pixels = np.array([[0.0, 240.0], [640.0, 240.0]])
    assert point_of(ring(2, spread_deg=20), pixels, 1e4) is None


LOCAL = ControlFile(CoordinateSystem("local"), ())
MARKS = np.array([[0.0, 0, 0], [1, 0, 0.1], [0.2, 0.9, -0.2], [-0.8, 0.3, 0.5], [0.5, -0.6, 0.4]])
TURN = Rotation.random(random_state=1).as_matrix()
TRUTH = Similarity(12.5, TURN, np.array([500.0, -20.0, 3.0]))


def seen(marks: np.ndarray, places: np.ndarray) -> list[Observations]:
    """Return what :func:`ring` of five cameras sees of marks that are said to be at places."""
    found = []
    for i, (mark, place) in enumerate(zip(marks, places, strict=True)):
        pixels = np.array([camera.project(mark[None])[0][0] for camera in ring(5)])
        found.append(Observations(f"m{i}", place, tuple(range(5)), pixels))
    return found


def fitted(observations: list[Observations]) -> ControlFit:
    return fit_control_points(LOCAL, ring(5), observations)


@pytest.mark.parametrize("count", [3, 5])
def test_exact_points_give_the_exact_frame(count: int) -> None:
    marks = MARKS[:count]
    found = fitted(seen(marks, TRUTH.points(marks)))
    np.testing.assert_allclose(
        found.fit.target_from_source.matrix(), TRUTH.matrix(), rtol=1e-9, atol=1e-9
    )
    assert found.origin is None
    assert found.details["control_points"]["used"] == count


def test_a_wrong_point_is_named_with_its_error() -> None:
    places = TRUTH.points(MARKS)
    places[2] += [0.0, 1.5, 0.0]
    found = fitted(seen(MARKS, places))
    np.testing.assert_allclose(found.fit.target_from_source.matrix(), TRUTH.matrix(), atol=1e-6)
    details = found.details["control_points"]
    assert details["left_out"] == ["m2"]
    wrong = details["points"][2]
    assert (wrong["name"], wrong["residual_m"], wrong["used"]) == ("m2", 1.5, False)
    assert details["points"][0]["residual_m"] < 1e-6


def test_points_seen_once_are_listed() -> None:
    points = seen(MARKS, TRUTH.points(MARKS))
    points[1] = Observations("m1", points[1].position, (0,), points[1].pixels[:1])
    points[4] = Observations("m4", points[4].position, (), np.zeros((0, 2)))
    found = fitted(points)
    assert found.details["control_points"]["not_seen"] == ["m1", "m4"]
    assert found.details["control_points"]["used"] == 3


def test_too_few_or_on_a_line() -> None:
    with pytest.raises(DatasetError, match="2 control points are seen in two placed photos"):
        fitted(seen(MARKS[:2], TRUTH.points(MARKS[:2])))
    line = np.array([[0.0, 0, 0], [0.5, 0.1, 0], [-0.5, -0.1, 0], [0.25, 0.05, 0]])
    for count in (3, 4):
        with pytest.raises(DatasetError, match="one line"):
            fitted(seen(line[:count], TRUTH.points(line[:count])))
    nearly = line + np.array([[0, 0, 0], [0, 0, 1.5e-3], [0, 0, 0], [0, 0, -1.5e-3]])
    with pytest.raises(DatasetError, match="almost on one line"):
        fitted(seen(nearly, TRUTH.points(nearly)))


def test_points_that_do_not_belong_together() -> None:
    places = np.random.default_rng(3).normal(size=MARKS.shape) * 50
    with pytest.raises(DatasetError, match="agree"):
        fitted(seen(MARKS, places))
