# SPDX-License-Identifier: GPL-3.0-or-later
"""COLMAP models: conventions, truncation at every byte, and invalid content."""

from __future__ import annotations

import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import EXIT_BAD_DATA, DatasetError, ParseError
from gaussian_wrapping_addon.core.readers.colmap import read_colmap
from gaussian_wrapping_addon.core.readers.source_model import LENS_NAMES, LENS_PARAMETERS
from gaussian_wrapping_addon.core.scene.camera import (
    quaternion_from_rotation,
    rotation_from_quaternion,
)
from tests.core.readers.model_writers import (
    HEIGHT,
    WIDTH,
    Model,
    ring_model,
    write_binary,
    write_text,
)

WRITERS = {"binary": write_binary, "text": write_text}


@pytest.mark.parametrize("writer", WRITERS)
def test_known_point_projects_to_the_known_pixel(tmp_path: Path, writer: str) -> None:
    model = ring_model(3)
    # Camera at (0, 0, -2) without rotation: world x, y, z are camera x, y, z + 2.
    model.images[0].quaternion = np.array([2.0, 0.0, 0.0, 0.0])  # not normalised
    model.images[0].translation = np.array([0.0, 0.0, 2.0])
    WRITERS[writer](model, tmp_path / "sparse" / "0")
    photo = read_colmap(tmp_path).photos[0]
    local = photo.cam_from_world @ np.array([0.5, -0.25, 2.0, 1.0])
    np.testing.assert_array_equal(local, [0.5, -0.25, 4.0])
    assert photo.lens.focal == (60.0, 61.0)
    assert photo.lens.principal_point == (32.0, 24.0)


@pytest.mark.parametrize("writer", WRITERS)
def test_everything_written_is_read_back(tmp_path: Path, writer: str) -> None:
    model = ring_model(4)
    WRITERS[writer](model, tmp_path / "sparse")
    read = read_colmap(tmp_path)
    assert [p.name for p in read.photos] == [i.name for i in model.images]
    for photo, image in zip(read.photos, model.images, strict=True):
        quaternion = quaternion_from_rotation(photo.cam_from_world[:, :3])
        np.testing.assert_allclose(quaternion, image.quaternion, atol=1e-14)
        np.testing.assert_array_equal(photo.cam_from_world[:, 3], image.translation)
    np.testing.assert_array_equal(read.points, [p[0] for p in model.points])
    np.testing.assert_array_equal(read.point_colors, [p[1] for p in model.points])
    assert read.warnings == ()
    assert read.facts["mean_reprojection_error_px"] == 2.0


def test_quaternions_of_every_rotation() -> None:
    rng = np.random.default_rng(0)
    half_turns = np.eye(4)[1:]
    for quaternion in [*rng.normal(size=(200, 4)), *half_turns, np.full(4, 1e200)]:
        rotation = rotation_from_quaternion(quaternion)
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
        assert np.linalg.det(rotation) > 0
        again = rotation_from_quaternion(quaternion_from_rotation(rotation))
        np.testing.assert_allclose(again, rotation, atol=1e-14)
    assert rotation_from_quaternion(np.zeros(4)) is None
    assert rotation_from_quaternion(np.array([1, np.nan, 0, 0])) is None


@pytest.mark.parametrize("stem", ["cameras", "images", "points3D"])
def test_cut_at_every_byte_is_refused(tmp_path: Path, stem: str) -> None:
    folder = write_binary(ring_model(3), tmp_path)
    path = folder / f"{stem}.bin"
    whole = path.read_bytes()
    for size in range(len(whole)):
        path.write_bytes(whole[:size])
        with pytest.raises(ParseError, match="byte ") as caught:
            read_colmap(folder)
        assert caught.value.exit_code == EXIT_BAD_DATA
        assert path.name in str(caught.value)
    path.write_bytes(whole)
    assert len(read_colmap(folder).photos) == 3


def test_every_flipped_byte_ends_quickly(tmp_path: Path) -> None:
    folder = write_binary(ring_model(3), tmp_path)
    rng = np.random.default_rng(0)
    begun = time.process_time()
    for stem in ("cameras", "images", "points3D"):
        path = folder / f"{stem}.bin"
        whole = path.read_bytes()
        for at in range(len(whole)):
            broken = bytearray(whole)
            broken[at] ^= int(rng.integers(1, 256))
            path.write_bytes(bytes(broken))
            try:
                model = read_colmap(folder)
            except DatasetError:
                continue
            assert np.isfinite(model.points).all()
            assert all(np.isfinite(p.cam_from_world).all() for p in model.photos)
            assert all(p.lens is not None and not p.lens.problem() for p in model.photos)
        path.write_bytes(whole)
    assert time.process_time() - begun < 10


def test_file_cut_inside_a_name_ends_with_the_offset(tmp_path: Path) -> None:
    """The native reader loops for ever on this file; ours runs under a deadline in a child."""
    model = ring_model(3)
    folder = write_binary(model, tmp_path)
    whole = (folder / "images.bin").read_bytes()
    cut = whole.index(b"p02.png") + 3
    (folder / "images.bin").write_bytes(whole[:cut])
    code = (
        "import sys; from pathlib import Path\n"
        "from gaussian_wrapping_addon.core.readers.colmap import read_colmap\n"
        "from gaussian_wrapping_addon.core.errors import WrapError\n"
        "try: read_colmap(Path(sys.argv[1]))\n"
        "except WrapError as error: sys.stderr.write(str(error)); sys.exit(error.exit_code)\n"
    )
    ended = subprocess.run(
        [sys.executable, "-c", code, str(folder)], capture_output=True, text=True, timeout=20
    )
    assert ended.returncode == EXIT_BAD_DATA
    assert f"byte {cut - 3}" in ended.stderr


@pytest.mark.parametrize("count", [2**64 - 1, 2**63, 2**31, 1000])
@pytest.mark.parametrize("where", ["cameras", "images", "points3D", "points2D", "track"])
def test_counts_are_bounded_by_the_file(tmp_path: Path, where: str, count: int) -> None:
    model = ring_model(3)
    folder = write_binary(model, tmp_path)
    stem = {"points2D": "images", "track": "points3D"}.get(where, where)
    data = bytearray((folder / f"{stem}.bin").read_bytes())
    at = {"points2D": 8 + 64 + len("p00.png") + 1, "track": 8 + 43}.get(where, 0)
    data[at : at + 8] = struct.pack("<Q", count)
    (folder / f"{stem}.bin").write_bytes(bytes(data))
    with pytest.raises(ParseError, match=f"byte {at}: {count} "):
        read_colmap(folder)


def _with_camera(params: list[float], kind: str | int = "PINHOLE", size=(WIDTH, HEIGHT)) -> Model:
    return Model([(1, kind, *size, params)], ring_model(3).images, [])


GOOD = [60.0, 60.0, 32.0, 24.0]


@pytest.mark.parametrize(
    ("model", "words"),
    [
        (_with_camera(GOOD, 99), "camera model number 99"),
        (_with_camera(GOOD, -1), "camera model number -1"),
        (_with_camera([1.0, 2.0, 3.0], 17), "EQUIRECTANGULAR"),
        (_with_camera([0.0, 60, 32, 24]), "focal length"),
        (_with_camera([-60.0, 60, 32, 24]), "focal length"),
        (_with_camera([60.0, float("nan"), 32, 24]), "finite"),
        (_with_camera([1e300, 60, 32, 24]), "focal length"),
        (_with_camera(GOOD, size=(0, 48)), "image size"),
        (_with_camera(GOOD, size=(10**7, 48)), "image size"),
        (_with_camera(GOOD, size=(2**63, 2**63)), "image size"),
        (_with_camera([60.0, 60, 1e9, 24]), "principal point"),
        (_with_camera([60.0, 60, 32, 24, 1e30, 0, 0, 0], "OPENCV"), "distortion"),
    ],
)
def test_unusable_cameras_are_refused_by_name(tmp_path: Path, model: Model, words: str) -> None:
    folder = write_binary(model, tmp_path)
    with pytest.raises(ParseError, match=words):
        read_colmap(folder)


@pytest.mark.parametrize("kind", sorted(LENS_NAMES))
def test_every_lens_model_is_known(tmp_path: Path, kind: str) -> None:
    names = LENS_PARAMETERS[kind]
    values = {"f": 60.0, "fx": 60.0, "fy": 61.0, "cx": 32.0, "cy": 24.0}
    model = _with_camera([values.get(name, 0.01) for name in names], kind)
    lens = read_colmap(write_binary(model, tmp_path)).photos[0].lens
    assert (lens.model, lens.principal_point) == (kind, (32.0, 24.0))
    assert lens.focal == (60.0, 61.0 if "fy" in names else 60.0)


def test_unsafe_names_are_left_out(tmp_path: Path) -> None:
    for name in (
        "../../../etc/passwd", "/etc/passwd", "C:\\x.png", "\\\\srv\\x", "CON.png", ".", "",
        "a/../../b.png", "n" * 4000,
    ):  # fmt: skip
        model = ring_model(4)
        model.images[1].name = name
        read = read_colmap(write_binary(model, tmp_path))
        assert [p.name for p in read.photos] == ["p00.png", "p02.png", "p03.png"], name
        assert "1 images were left out for an unsafe name" in read.warnings[0].text


@pytest.mark.parametrize("writer", WRITERS)
def test_odd_names_are_kept(tmp_path: Path, writer: str) -> None:
    names = ["a b'c\"%20.png", "sub/dir/ü😀.png", "back\\slash.png"]
    model = ring_model(3)
    for image, name in zip(model.images, names, strict=True):
        image.name = name
    read = read_colmap(WRITERS[writer](model, tmp_path))
    assert [p.name for p in read.photos] == [*names[:2], "back/slash.png"]
    model.images[0].name = b"\xff\xfe.png"
    assert len(read_colmap(write_binary(model, tmp_path)).photos) == 3


def test_bad_poses_points_and_references_are_left_out(tmp_path: Path) -> None:
    model = ring_model(9)
    model.images[0].quaternion = np.zeros(4)
    model.images[1].quaternion = np.array([1.0, np.nan, 0.0, 0.0])
    model.images[2].translation = np.array([np.inf, 0.0, 0.0])
    model.images[3].camera_id = 7
    model.images[4].image_id = model.images[5].image_id = 60
    model.points[0] = ([np.nan, 0.0, 0.0], [1, 2, 3], 0.1, [])
    folder = write_binary(model, tmp_path)
    with (folder / "images.bin").open("ab") as stream:
        stream.write(b"garbage")
    read = read_colmap(folder)
    assert [p.name for p in read.photos] == ["p04.png", "p06.png", "p07.png", "p08.png"]
    assert len(read.points) == 3
    text = " ".join(w.text for w in read.warnings)
    assert "7 bytes after" in text
    assert "3 images were left out for a pose that is not finite" in text
    assert "1 images were left out for a camera that is not in the model" in text
    assert "1 images were left out for a number or name that was used before" in text
    assert "1 points that are not finite" in text
    (folder / "points3D.bin").unlink()
    read = read_colmap(folder)
    assert read.points.shape == (0, 3)
    assert any("points3D.bin is missing" in w.text for w in read.warnings)


def test_no_usable_image_and_a_camera_defined_twice_are_refused(tmp_path: Path) -> None:
    model = ring_model(3)
    for image in model.images:
        image.quaternion = np.zeros(4)
    with pytest.raises(DatasetError, match="None of the 3 images"):
        read_colmap(write_binary(model, tmp_path))
    model.cameras.append((1, "PINHOLE", WIDTH, HEIGHT, [70.0, 60.0, 32.0, 24.0]))
    with pytest.raises(ParseError, match="defined twice"):
        read_colmap(write_binary(model, tmp_path))


def test_text_with_empty_second_lines_bom_crlf_tabs_and_comments(tmp_path: Path) -> None:
    model = ring_model(3)
    model.images[1].points2d = []
    folder = write_text(model, tmp_path, end="\r\n")
    images = folder / "images.txt"
    lines = images.read_bytes().decode().split("\r\n")
    lines.insert(3, "# a comment in the middle")
    lines[1] = lines[1].replace(" ", "\t", 3)
    images.write_bytes(b"\xef\xbb\xbf" + "\r\n".join(lines).encode())
    read = read_colmap(folder)
    assert [p.name for p in read.photos] == ["p00.png", "p01.png", "p02.png"]
    assert read.warnings == ()
    for i, image in enumerate(model.images):
        image.name = f"{i:04d}"  # even a name that is a number
    read = read_colmap(write_text(model, tmp_path, second_lines=False))
    assert [p.name for p in read.photos] == ["0000", "0001", "0002"]
    assert "lacks the line of 2D points of 2 images" in read.warnings[0].text


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("PINHOLE 64", "PINHOLE sixty", "line 2: 'sixty' is not a number"),
        (" 32.0 24.0", " 24.0", "line 2: PINHOLE has 4 parameters, not 3"),
        ("PINHOLE", "MAGIC_LENS", "line 2: camera model MAGIC_LENS"),
        ("60.0", "60,0", "Write decimals with a point"),
        ("PINHOLE 64", "PINHOLE 64.5", "not a whole number"),
        ("60.0", "-nan(ind)", "not a finite number"),
        ("1 PINHOLE", "1e5 PINHOLE", "camera that is not in the model"),
    ],
)
def test_wrong_numbers_in_text_name_the_line(
    tmp_path: Path, old: str, new: str, words: str
) -> None:
    folder = write_text(ring_model(3), tmp_path)
    path = folder / "cameras.txt"
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(DatasetError) as caught:
        read_colmap(folder)
    assert words in str(caught.value)


def test_largest_of_several_models_wins_and_is_named(tmp_path: Path) -> None:
    folder = write_binary(ring_model(3), tmp_path / "sparse" / "0")
    write_text(ring_model(6), tmp_path / "sparse" / "1")
    (tmp_path / "sparse" / "2").mkdir()
    read = read_colmap(tmp_path)
    assert len(read.photos) == 6
    assert read.facts["model"] == "sparse/1"
    assert "sparse/0 (3), sparse/1 (6); sparse/1 was used" in read.warnings[0].text
    (tmp_path / "sparse" / "1" / "images.txt").write_text("broken")
    read = read_colmap(tmp_path)
    assert len(read.photos) == 3
    assert "Model 1 was left out" in read.warnings[0].text
    # Binary files win over text, and those of rigs are ignored.
    write_text(ring_model(5), folder)
    (folder / "rigs.bin").write_bytes(b"\xff" * 9)
    (folder / "frames.bin").write_bytes(b"")
    read = read_colmap(folder)
    assert len(read.photos) == 3
    assert "text files were also present" in read.facts["model_files"]


def test_agrees_with_the_native_reader(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    model = ring_model(3, "OPENCV", [60.0, 61.0, 32.0, 24.0, 0.1, -0.05, 0.01, -0.02])
    for image in model.images:
        image.points2d = []
    model.points = [(p, c, e, []) for p, c, e, _ in model.points]
    folder = write_binary(model, tmp_path)
    native = pycolmap.Reconstruction(str(folder))
    for photo in read_colmap(folder).photos:
        image = next(i for i in native.images.values() if i.name == photo.name)
        pose = image.cam_from_world().matrix()
        np.testing.assert_allclose(photo.cam_from_world, pose, atol=1e-14)
        assert list(native.cameras[1].params) == list(photo.lens.params)
