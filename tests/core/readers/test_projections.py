# SPDX-License-Identifier: GPL-3.0-or-later
"""Known points seen by the cameras of each program's file: our pixels against its own formulas.

The references here read the same files anew and follow the programs' published formulas, word by
word; nothing of the package is used for them.
"""

from __future__ import annotations

import csv
import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from tests.core.readers import writers
from tests.core.readers.known_scene import (
    HEIGHT,
    WIDTH,
    known_points,
    our_pixels,
    read,
    shots,
    write_photos,
)

EXACT_PX = 1e-6
SIDE = max(WIDTH, HEIGHT)
Pixels = dict[str, np.ndarray]


def brown(xy: np.ndarray, k: tuple[float, ...], x_term: float, y_term: float) -> np.ndarray:
    """Bend slopes; ``x_term`` multiplies ``r^2 + 2 x^2`` in x, ``y_term`` ``r^2 + 2 y^2`` in y."""
    x, y = xy.T
    r2 = x**2 + y**2
    radial = 1 + sum(value * r2 ** (i + 1) for i, value in enumerate(k))
    return np.stack([
        x * radial + x_term * (r2 + 2 * x**2) + 2 * y_term * x * y,
        y * radial + y_term * (r2 + 2 * y**2) + 2 * x_term * x * y,
    ], 1)  # fmt: skip


def slopes(rotation: np.ndarray, shift: np.ndarray, points: np.ndarray) -> np.ndarray:
    local = points @ rotation.T + shift
    assert (local[:, 2] > 0).all()
    return local[:, :2] / local[:, 2:]


def realityscan_csv(path: Path, points: np.ndarray) -> Pixels:
    found = {}
    for row in csv.DictReader(path.read_text().splitlines()):
        v = {key: float(value) for key, value in row.items() if key != "#name"}
        h, p, r = (math.radians(v[key]) for key in ("heading", "pitch", "roll"))
        # Columns: where the photo's right, its top and the back of the camera point in the world.
        right = np.array([
            math.cos(h) * math.cos(r) + math.sin(h) * math.sin(p) * math.sin(r),
            -math.sin(h) * math.cos(r) + math.cos(h) * math.sin(p) * math.sin(r),
            -math.cos(p) * math.sin(r),
        ])  # fmt: skip
        top = np.array([math.sin(h) * math.cos(p), math.cos(h) * math.cos(p), math.sin(p)])
        back = np.cross(right, top)
        offset = points - np.array([v["x"], v["y"], v["alt"]])
        xy = np.stack([offset @ right, -(offset @ top)], 1) / -(offset @ back)[:, None]
        bent = brown(xy, (v["k1"], v["k2"], v["k3"], v["k4"]), v["t1"], v["t2"])
        scaled = v["f"] / 36.0 * bent + [v["px"], v["py"]]
        found[Path(row["#name"]).stem] = scaled * SIDE + [WIDTH / 2, HEIGHT / 2]
    return found


def realityscan_xmp(folder: Path, points: np.ndarray) -> Pixels:
    found = {}
    for path in sorted(folder.glob("*.xmp")):
        text = path.read_text()

        def value(name: str, text: str = text) -> list[float]:
            match = re.search(rf'xcr:{name}(?:="|>)([^"<]*)', text)
            assert match
            return [float(word) for word in match.group(1).split()]

        rotation = np.reshape(value("Rotation"), (3, 3))
        xy = slopes(rotation, -rotation @ value("Position"), points)
        *k, t1, t2 = value("DistortionCoeficients")
        offset = [*value("PrincipalPointU"), *value("PrincipalPointV")]
        scaled = value("FocalLength35mm")[0] / 36.0 * brown(xy, tuple(k), t1, t2) + offset
        found[path.stem] = scaled * SIDE + [WIDTH / 2, HEIGHT / 2]
    return found


def metashape(path: Path, points: np.ndarray) -> Pixels:
    root = ElementTree.parse(path).getroot()
    transform = root.find("chunk/transform")
    assert transform is not None
    values = {child.tag: [float(v) for v in (child.text or "").split()] for child in transform}
    chunk = np.eye(4)
    chunk[:3, :3] = values["scale"][0] * np.reshape(values["rotation"], (3, 3))
    chunk[:3, 3] = values["translation"]
    calibration = root.find("chunk/sensors/sensor/calibration")
    assert calibration is not None
    c = {child.tag: float(child.text) for child in calibration if child.text and child.text.strip()}
    c = {
        key: c.get(key, 0.0)
        for key in ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2")
    }
    found = {}
    for camera in root.iter("camera"):
        pose = np.reshape([float(v) for v in (camera.findtext("transform") or "").split()], (4, 4))
        homogeneous = np.concatenate([points, np.ones((len(points), 1))], 1)
        local = homogeneous @ np.linalg.inv(chunk @ pose).T
        x, y = (local[:, :2] / local[:, 2:3]).T
        if calibration.get("type") == "fisheye":
            r0 = np.hypot(x, y)
            x, y = x * np.arctan(r0) / r0, y * np.arctan(r0) / r0
        r2 = x**2 + y**2
        radial = 1 + c["k1"] * r2 + c["k2"] * r2**2 + c["k3"] * r2**3 + c["k4"] * r2**4
        xd = x * radial + c["p1"] * (r2 + 2 * x**2) + 2 * c["p2"] * x * y
        yd = y * radial + c["p2"] * (r2 + 2 * y**2) + 2 * c["p1"] * x * y
        u = WIDTH / 2 + c["cx"] + xd * c["f"] + xd * c["b1"] + yd * c["b2"]
        v = HEIGHT / 2 + c["cy"] + yd * c["f"]
        found[str(camera.get("label"))] = np.stack([u, v], 1)
    return found


def meshroom(path: Path, points: np.ndarray) -> Pixels:
    values = json.loads(path.read_text())
    entry = values["intrinsics"][0]
    poses = {pose["poseId"]: pose["pose"]["transform"] for pose in values["poses"]}
    focal = float(entry["focalLength"]) / float(entry["sensorWidth"]) * WIDTH
    middle = [
        float(p) + side / 2
        for p, side in zip(entry["principalPoint"], (WIDTH, HEIGHT), strict=True)
    ]
    k = [float(value) for value in entry["distortionParams"] or []]
    found = {}
    for view in values["views"]:
        transform = poses[view["poseId"]]
        # Eigen stores matrices column by column.
        rotation = np.reshape([float(value) for value in transform["rotation"]], (3, 3), order="F")
        center = np.array([float(value) for value in transform["center"]])
        xy = slopes(rotation, -rotation @ center, points)
        kind = entry["distortionType"]
        if kind == "fisheye4":
            r = np.hypot(*xy.T)
            theta = np.arctan(r)
            bent = theta * (1 + sum(value * theta ** (2 * i + 2) for i, value in enumerate(k)))
            xy = xy * (bent / r)[:, None]
        elif kind == "brown":
            xy = brown(xy, tuple(k[:3]), k[4], k[3])
        else:
            xy = brown(xy, tuple(k), 0.0, 0.0)
        # AliceVision's first pixel has its centre at 0, ours at 0.5.
        found[Path(view["path"]).stem] = focal * xy + middle + 0.5
    return found


def rodrigues(vector: list[float]) -> np.ndarray:
    """Turn the axes of the frame about a vector, one after the other."""
    angle = float(np.linalg.norm(vector))
    axis = np.array(vector) / angle
    columns = [
        math.cos(angle) * e
        + math.sin(angle) * np.cross(axis, e)
        + (1 - math.cos(angle)) * (axis @ e) * axis
        for e in np.eye(3)
    ]  # fmt: skip
    return np.stack(columns, 1)


def opensfm_pixels(camera: dict[str, float], xy: np.ndarray) -> np.ndarray:
    c = {"k1": 0.0, "k2": 0.0, "k3": 0.0, "k4": 0.0, **camera}
    kind = camera["projection_type"]
    if str(kind).startswith("fisheye"):
        r = np.hypot(*xy.T)
        theta = np.arctan(r)
        power = c["k1"] * theta**2 + c["k2"] * theta**4 + c["k3"] * theta**6 + c["k4"] * theta**8
        xy = xy * (theta * (1 + power) / r)[:, None]
    elif kind == "brown":
        # OpenSfM: x + 2 p1 x y + p2 (r^2 + 2 x^2).
        xy = brown(xy, (c["k1"], c["k2"], c["k3"]), c["p2"], c["p1"])
    else:
        xy = brown(xy, (c["k1"], c["k2"]), 0.0, 0.0)
    focal = [c["focal"]] * 2 if "focal" in c else [c["focal_x"], c["focal_y"]]
    normalised = xy * focal + [c.get("c_x", 0.0), c.get("c_y", 0.0)]
    # Pixel numbers are x * size - 0.5 + w / 2, from the first one's centre, which we call 0.5.
    return normalised * SIDE - 0.5 + [WIDTH / 2, HEIGHT / 2] + 0.5


def opensfm(path: Path, points: np.ndarray) -> Pixels:
    (entry,) = json.loads(path.read_text())
    (camera,) = entry["cameras"].values()
    return {
        Path(name).stem: opensfm_pixels(
            camera, slopes(rodrigues(shot["rotation"]), np.array(shot["translation"]), points)
        )
        for name, shot in entry["shots"].items()
    }


def opendrone(path: Path, points: np.ndarray) -> Pixels:
    (camera,) = json.loads((path.parent.parent / "cameras.json").read_text()).values()
    found = {}
    for feature in json.loads(path.read_text())["features"]:
        shot = feature["properties"]
        rotation = rodrigues(shot["rotation"])
        xy = slopes(rotation, -rotation @ shot["translation"], points)
        found[Path(shot["filename"]).stem] = opensfm_pixels(camera, xy)
    return found


def polycam(folder: Path, points: np.ndarray) -> Pixels:
    found = {}
    for path in (folder / "keyframes" / "corrected_cameras").glob("*.json"):
        v = json.loads(path.read_text())
        matrix = np.array([[v[f"t_{row}{column}"] for column in range(4)] for row in range(3)])
        local = (points - matrix[:, 3]) @ matrix[:, :3]  # x right, y up, z back
        u = v["cx"] + v["fx"] * local[:, 0] / -local[:, 2]
        found[path.stem] = np.stack([u, v["cy"] - v["fy"] * local[:, 1] / -local[:, 2]], 1)
    return found


TURN = rodrigues([0.4, -1.1, 0.7])
RS = {
    "f": 31.0, "px": 0.011, "py": -0.007,
    "k1": -0.09, "k2": 0.03, "k3": -0.011, "t1": 0.004, "t2": -0.003,
}  # fmt: skip
MS = {
    "f": 88.0, "cx": 1.5, "cy": -2.25,
    "k1": -0.08, "k2": 0.02, "k3": -0.004, "p1": 0.003, "p2": -0.002,
}  # fmt: skip
MS_FISHEYE = {"f": 70.0, "cx": 1.0, "k1": -0.03, "k2": 0.01, "k3": -0.002, "k4": 0.001}
MS_DECENTRED = {"f": 70.0, "b1": 0.6, "k1": -0.03, "k3": 0.002, "p1": 0.003, "p2": -0.002}
OSFM = {
    "focal_x": 0.9, "focal_y": 0.91, "c_x": 0.012, "c_y": -0.008,
    "k1": -0.07, "k2": 0.02, "k3": -0.003, "p1": 0.002, "p2": -0.004,
}  # fmt: skip
OSFM_OPENCV = {
    "focal_x": 0.7, "focal_y": 0.71, "c_x": 0.01, "c_y": 0.02,
    "k1": -0.02, "k2": 0.01, "k3": -0.003, "k4": 0.001,
}  # fmt: skip
OSFM_SIMPLE = {"focal": 0.88, "k1": -0.1, "k2": 0.02}
OSFM_FISHEYE = {"focal": 0.7, "k1": -0.02, "k2": 0.003}
AV = {"f": 32.0, "cx": 1.25, "cy": -0.75, "k1": -0.06, "k2": 0.015, "k3": -0.002}
AV_BROWN = AV | {"t1": 0.003, "t2": -0.002}
POLYCAM = {"fx": 80.0, "fy": 81.0, "cx": 47.5, "cy": 33.0}
Case = tuple[Callable[..., Path], dict[str, float], dict[str, object], Callable[..., Pixels], str]
_CSV, _XMP = writers.write_realityscan_csv, writers.write_realityscan_xmp
_MS, _AV, _OSFM = writers.write_metashape, writers.write_meshroom, writers.write_opensfm
_SKEWED = MS | {"b1": 1.5, "b2": -0.8, "k4": 0.01}
CASES: dict[str, Case] = {
    "csv": (_CSV, RS, {}, realityscan_csv, "FULL_OPENCV"),
    "csv-plain": (_CSV, {"f": 30.0}, {}, realityscan_csv, "PINHOLE"),
    "csv-k4": (_CSV, RS | {"k4": 0.02}, {}, realityscan_csv, "SKEWED_BROWN"),
    "xmp": (_XMP, RS, {}, realityscan_xmp, "FULL_OPENCV"),
    "xmp-k4": (_XMP, RS | {"k4": 0.02}, {}, realityscan_xmp, "SKEWED_BROWN"),
    "metashape": (_MS, MS, {"rotation": TURN}, metashape, "FULL_OPENCV"),
    "metashape-b1": (_MS, {"f": 88.0, "b1": 1.5, "k1": -0.1}, {}, metashape, "OPENCV"),
    "metashape-b2-k4": (_MS, _SKEWED, {"rotation": TURN}, metashape, "SKEWED_BROWN"),
    "metashape-fisheye": (_MS, MS_FISHEYE, {"kind": "fisheye"}, metashape, "OPENCV_FISHEYE"),
    "metashape-p": (_MS, MS_DECENTRED, {"kind": "fisheye"}, metashape, "THIN_PRISM_FISHEYE"),
    "meshroom": (_AV, AV, {}, meshroom, "FULL_OPENCV"),
    "meshroom-none": (_AV, AV, {"kind": "none"}, meshroom, "PINHOLE"),
    "meshroom-brown": (_AV, AV_BROWN, {"kind": "brown"}, meshroom, "FULL_OPENCV"),
    "meshroom-fisheye": (
        _AV, AV | {"k4": 0.001}, {"kind": "fisheye4"}, meshroom, "OPENCV_FISHEYE",
    ),
    "opensfm": (_OSFM, OSFM, {}, opensfm, "FULL_OPENCV"),
    "opensfm-perspective": (_OSFM, OSFM_SIMPLE, {"kind": "perspective"}, opensfm, "OPENCV"),
    "opensfm-fisheye": (_OSFM, OSFM_FISHEYE, {"kind": "fisheye"}, opensfm, "OPENCV_FISHEYE"),
    "opensfm-fisheye-opencv": (
        _OSFM, OSFM_OPENCV, {"kind": "fisheye_opencv"}, opensfm, "OPENCV_FISHEYE",
    ),
    "opendrone": (writers.write_opendrone_shots, OSFM, {}, opendrone, "FULL_OPENCV"),
    "polycam": (writers.write_polycam, POLYCAM, {}, polycam, "PINHOLE"),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_known_points_land_where_the_program_says(tmp_path: Path, name: str) -> None:
    write, lens, more, reference, model = CASES[name]
    photos = tmp_path if "xmp" in name else tmp_path / "images"
    write_photos(photos)
    source = write(tmp_path, shots(lens), **more)
    points = known_points()
    read_back = read(source)
    ours, theirs = our_pixels(read_back, points), reference(source, points)
    assert sorted(ours) == sorted(theirs) == ["IMG_0001", "IMG_0002", "IMG_0003", "IMG_0004"]
    for photo, pixels in theirs.items():
        np.testing.assert_allclose(ours[photo], pixels, rtol=0, atol=EXACT_PX)
    # All four photos see the points, and not at their edge: the comparison is of whole pictures.
    everything = np.concatenate(list(theirs.values()))
    assert np.ptp(everything, axis=0).min() > 30
    lenses = {
        (photo.relative.of_size(WIDTH, HEIGHT) if photo.relative else photo.lens).model  # type: ignore[union-attr]
        for photo in read_back.photos
    }
    assert lenses == {model}
