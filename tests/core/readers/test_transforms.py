# SPDX-License-Identifier: GPL-3.0-or-later
"""transforms.json: axes, intrinsics, start points, and what is refused."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import DatasetError, ParseError
from gaussian_wrapping_addon.core.readers.colmap import read_colmap
from gaussian_wrapping_addon.core.readers.transforms import read_transforms
from tests.core.readers.real_sets import real_set


def valid() -> dict[str, Any]:
    """Return three frames: cameras at (i, 0, 4), looking down -z as OpenGL cameras do."""
    frames = []
    for i in range(3):
        matrix = np.eye(4)
        matrix[:3, 3] = [i, 0.0, 4.0]
        frames.append({"file_path": f"images/{i}.png", "transform_matrix": matrix.tolist()})
    return {"fl_x": 60.0, "fl_y": 61.0, "cx": 30.0, "cy": 25.0, "w": 64, "h": 48, "frames": frames}


def write(folder: Path, values: Any) -> Path:
    path = folder / "transforms.json"
    path.write_text(values if isinstance(values, str) else json.dumps(values))
    return path


def test_known_point_projects_to_the_known_pixel(tmp_path: Path) -> None:
    photo = read_transforms(write(tmp_path, valid())).photos[0]
    # World (1, 0.5, 0) seen from (0, 0, 4) down -z: right 1, up 0.5, ahead 4.
    local = photo.cam_from_world @ np.array([1.0, 0.5, 0.0, 1.0])
    np.testing.assert_array_equal(local, [1.0, -0.5, 4.0])
    assert photo.lens.model == "PINHOLE"
    assert photo.lens.params == (60.0, 61.0, 30.0, 25.0)


def test_agrees_with_the_colmap_model_of_the_same_photos() -> None:
    fox = real_set("fox")
    colmap = {Path(p.name).name: p for p in read_colmap(fox).photos}
    frames = read_transforms(fox / "transforms.json").photos
    assert len(frames) == len(colmap) == 50
    distances, angles = [], []
    for frame in frames:
        a, b = frame.cam_from_world, colmap[Path(frame.name).name].cam_from_world
        gap = a[:, :3].T @ a[:, 3] - b[:, :3].T @ b[:, 3]
        distances.append(np.linalg.norm(gap))
        cosine = (np.trace(a[:, :3] @ b[:, :3].T) - 1) / 2
        angles.append(math.degrees(math.acos(min(1.0, cosine))))
    # The data set's README states medians of 0.0025 and 0.03 degrees.
    assert np.median(distances) < 0.003
    assert np.median(angles) < 0.05
    assert max(angles) < 0.5


@pytest.mark.parametrize(
    ("more", "model", "distortion"),
    [
        ({"k1": 0.1, "k2": 0.2, "p1": 0.3, "p2": 0.4}, "OPENCV", (0.1, 0.2, 0.3, 0.4)),
        ({"k1": 0.1, "p2": 0.4, "k3": 0.05}, "FULL_OPENCV", (0.1, 0, 0, 0.4, 0.05, 0, 0, 0)),
        ({"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k4": 0.4}, "OPENCV_FISHEYE",
         (0.1, 0.0, 0.0, 0.4)),
    ],
)  # fmt: skip
def test_distortion_and_lens_models(
    tmp_path: Path, more: dict[str, Any], model: str, distortion: tuple[float, ...]
) -> None:
    lens = read_transforms(write(tmp_path, valid() | more)).photos[0].lens
    assert (lens.model, lens.distortion) == (model, distortion)


def test_frames_override_globals(tmp_path: Path) -> None:
    values = valid()
    values["frames"][1] |= {"fl_x": 70.0, "k1": 0.1, "mask_path": "masks/1.png"}
    photos = read_transforms(write(tmp_path, values)).photos
    assert [p.lens.focal[0] for p in photos if p.lens] == [60.0, 70.0, 60.0]
    assert [p.lens.model for p in photos if p.lens] == ["PINHOLE", "OPENCV", "PINHOLE"]
    assert [p.mask_name for p in photos] == [None, "masks/1.png", None]


def test_angle_alone_with_and_without_size(tmp_path: Path) -> None:
    values = valid()
    for key in ("fl_x", "fl_y", "cx", "cy"):
        del values[key]
    values["camera_angle_x"] = 2 * math.atan(0.5)
    lens = read_transforms(write(tmp_path, values)).photos[0].lens
    np.testing.assert_allclose(lens.params, [64.0, 64.0, 32.0, 24.0])
    del values["w"], values["h"]
    photo = read_transforms(write(tmp_path, values)).photos[0]
    assert photo.lens is None
    assert photo.angle_x == values["camera_angle_x"]


def test_repairs_are_counted(tmp_path: Path) -> None:
    values = valid()
    matrix = np.array(values["frames"][0]["transform_matrix"])
    values["frames"][0]["transform_matrix"] = matrix[:3].tolist()  # 3 x 4
    matrix[:3, :3] *= 2.5
    values["frames"][1]["transform_matrix"] = matrix.tolist()
    values["frames"][2]["file_path"] = "./images\\0.png"  # the first again
    values["frames"].append({**values["frames"][0], "file_path": "../secret.png"})
    read = read_transforms(write(tmp_path, values))
    assert [p.name for p in read.photos] == ["images/0.png", "images/1.png"]
    np.testing.assert_allclose(read.photos[1].cam_from_world, read.photos[0].cam_from_world)
    text = " ".join(w.text for w in read.warnings)
    assert "1 frames repeat a photo" in text
    assert "1 matrices held a scale" in text
    assert "leads outside the folder: '../secret.png'" in text
    for frame in values["frames"]:
        frame["file_path"] = "/etc/passwd"
    with pytest.raises(DatasetError, match="None of the 4 frames"):
        read_transforms(write(tmp_path, values))


@pytest.mark.parametrize(
    ("change", "place"),
    [
        ({"frames": []}, "frames"),
        ({"frames": {}}, "frames"),
        ({"frames": [5]}, r"frames\[0\]"),
        ({"fl_x": None, "fl_y": None}, r"frames\[0\]: no focal length"),
        ({"fl_x": None, "fl_y": None, "camera_angle_x": 3.5}, "no focal length"),
        ({"fl_x": "60"}, r"frames\[0\]\.fl_x"),
        ({"fl_x": -60.0}, "focal length"),
        ({"w": 0}, "image size"),
        ({"w": 10**400}, r"frames\[0\]\.w: the number is not finite"),
        ({"camera_model": "OMNI"}, "OMNI is not supported.*EQUIRECTANGULAR"),
        ({"camera_model": "OPENCV", "k3": 0.1, "k4": 0.1}, "k4"),
    ],
)
def test_refused_with_the_place(tmp_path: Path, change: dict[str, Any], place: str) -> None:
    values = {k: v for k, v in (valid() | change).items() if v is not None}
    with pytest.raises(ParseError, match=place):
        read_transforms(write(tmp_path, values))


MIRROR = np.diag([1.0, 1.0, -1.0, 1.0]).tolist()
SHEAR = (np.eye(4) + np.eye(4, k=1) * [[0.5], [0], [0], [0]]).tolist()
LAST_ROW = (np.eye(4) + np.eye(4, k=-3)).tolist()


@pytest.mark.parametrize(
    "matrix",
    [
        *(None, "eye", [], [[1, 2], [3, 4]], [["a"] * 4] * 4, np.zeros((4, 4)).tolist()),
        *(np.eye(4)[:, :3].tolist(), MIRROR, SHEAR, LAST_ROW, [[1e400] * 4] * 3),
    ],
    ids=["none", "text", "empty", "2x2", "words", "zero", "4x3", "mirror", "shear", "row", "inf"],
)
def test_matrices_that_are_no_poses(tmp_path: Path, matrix: Any) -> None:
    values = valid()
    values["frames"][2]["transform_matrix"] = matrix
    text = json.dumps(values).replace("Infinity", "1e999")
    with pytest.raises(ParseError, match=r"frames\[2\]\.transform_matrix"):
        read_transforms(write(tmp_path, text))


@pytest.mark.parametrize(
    "text",
    ["", "no json", "[]", "3", '{"frames": NaN}', "[" * 100_000, '{"w": ' + "9" * 5000 + "}"],
    ids=["empty", "words", "list", "number", "nan", "deep", "long integer"],
)
def test_files_that_are_no_transforms(tmp_path: Path, text: str) -> None:
    with pytest.raises(ParseError):
        read_transforms(write(tmp_path, text))


def test_point_files_are_read_or_warned_of(tmp_path: Path) -> None:
    (tmp_path / "p.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
        "property float z\nend_header\n1 2 3.5\n"
    )
    model = read_transforms(write(tmp_path, valid() | {"ply_file_path": "p.ply"}))
    np.testing.assert_array_equal(model.points, [[1, 2, 3.5]])
    for name in ("gone.ply", "../p.ply", 5):
        model = read_transforms(write(tmp_path, valid() | {"ply_file_path": name}))
        assert len(model.points) == 0
        assert "ply_file_path" in model.warnings[0].text
