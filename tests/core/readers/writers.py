# SPDX-License-Identifier: GPL-3.0-or-later
"""Write known cameras as other programs do, from the public descriptions of their files.

Each writer takes names, poses (COLMAP axes), the photos' size and the lens in the numbers of the
program itself, and returns the path to give as the input.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

_OPENGL_FROM_COLMAP = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class Shots:
    """Photos to write: names with extension, (3, 4) cam_from_world poses, size, lens, points."""

    names: Sequence[str]
    poses: Sequence[np.ndarray]
    width: int
    height: int
    lens: Mapping[str, Any]
    """In the names and units of the program."""
    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    """(n, 3) float64."""
    stored_in: str = ""
    """What stands before the names in the file, such as ``C:/photos/``."""

    def centers(self) -> list[np.ndarray]:
        """Return the (3,) camera centres."""
        return [-pose[:, :3].T @ pose[:, 3] for pose in self.poses]


def _text(values: np.ndarray | Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(values))


def write_realityscan_csv(folder: Path, shots: Shots) -> Path:
    """Lens: f (35 mm), px, py (shares), k1 to k4, t1, t2."""
    columns = ("f", "px", "py", "k1", "k2", "k3", "k4", "t1", "t2")
    lines = ["#name,x,y,alt,heading,pitch,roll," + ",".join(columns)]
    for name, pose, center in zip(shots.names, shots.poses, shots.centers(), strict=True):
        turned = pose[:, :3].T @ _OPENGL_FROM_COLMAP  # world from camera with y up, z back
        pitch = math.asin(max(-1.0, min(1.0, turned[2, 1])))
        heading = math.atan2(turned[0, 1], turned[1, 1])
        roll = math.atan2(-turned[2, 0], turned[2, 2])
        angles = [math.degrees(angle) for angle in (heading, pitch, roll)]
        values = [*center, *angles, *(shots.lens.get(column, 0.0) for column in columns)]
        lines.append(",".join([shots.stored_in + name, *(repr(float(v)) for v in values)]))
    path = folder / "cameras.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def write_realityscan_xmp(folder: Path, shots: Shots) -> Path:
    """Lens: as :func:`write_realityscan_csv`; one file beside each photo in ``folder``."""
    lens = shots.lens
    coefficients = _text([lens.get(k, 0.0) for k in ("k1", "k2", "k3", "k4", "t1", "t2")])
    for name, pose, center in zip(shots.names, shots.poses, shots.centers(), strict=True):
        (folder / Path(name).with_suffix(".xmp")).write_text(
            '<x:xmpmeta xmlns:x="adobe:ns:meta/">\n'
            ' <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">\n'
            '  <rdf:Description xcr:Version="3" xcr:PosePrior="initial"\n'
            '   xcr:Coordinates="absolute"\n'
            f'   xcr:DistortionModel="brown4t2" xcr:FocalLength35mm="{lens["f"]!r}" xcr:Skew="0"\n'
            f'   xcr:AspectRatio="1" xcr:PrincipalPointU="{lens.get("px", 0.0)!r}"\n'
            f'   xcr:PrincipalPointV="{lens.get("py", 0.0)!r}"\n'
            '   xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#">\n'
            f"   <xcr:Rotation>{_text(pose[:, :3])}</xcr:Rotation>\n"
            f"   <xcr:Position>{_text(center)}</xcr:Position>\n"
            f"   <xcr:DistortionCoeficients>{coefficients}</xcr:DistortionCoeficients>\n"
            "  </rdf:Description>\n </rdf:RDF>\n</x:xmpmeta>\n"
        )
    return folder


def write_metashape(
    folder: Path,
    shots: Shots,
    *,
    kind: str = "frame",
    scale: float = 2.5,
    rotation: np.ndarray | None = None,
    translation: Sequence[float] = (4.0, -3.0, 2.0),
) -> Path:
    """Lens: f, cx, cy, b1, b2, k1 to k4, p1, p2 in pixels; a transform of the chunk as given."""
    turned = np.eye(3) if rotation is None else rotation
    cameras = []
    for i, (name, pose, center) in enumerate(
        zip(shots.names, shots.poses, shots.centers(), strict=True)
    ):
        matrix = np.eye(4)
        matrix[:3, :3] = turned.T @ pose[:, :3].T
        matrix[:3, 3] = turned.T @ (center - np.array(translation)) / scale
        cameras.append(
            f'   <camera id="{i}" sensor_id="0" component_id="0" label="{Path(name).stem}">\n'
            f"    <transform>{_text(matrix)}</transform>\n"
            "    <orientation>1</orientation>\n   </camera>\n"
        )
    lens = "".join(f"     <{key}>{value!r}</{key}>\n" for key, value in shots.lens.items())
    size = f'<resolution width="{shots.width}" height="{shots.height}"/>'
    path = folder / "cameras.xml"
    path.write_text(
        '<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0">\n'
        ' <chunk label="Chunk 1" enabled="true">\n  <sensors next_id="1">\n'
        f'   <sensor id="0" label="camera" type="{kind}">\n    {size}\n'
        f'    <calibration type="{kind}" class="adjusted">\n     {size}\n{lens}'
        "    </calibration>\n   </sensor>\n  </sensors>\n"
        f'  <cameras next_id="{len(cameras)}" next_group_id="0">\n{"".join(cameras)}  </cameras>\n'
        f"  <transform>\n   <rotation>{_text(turned)}</rotation>\n"
        f"   <translation>{_text(translation)}</translation>\n   <scale>{scale!r}</scale>\n"
        "  </transform>\n </chunk>\n</document>\n"
    )
    return path


def write_meshroom(folder: Path, shots: Shots, *, kind: str = "radialk3") -> Path:
    """Lens: f (mm of a sensor 36 mm wide), cx, cy (from the middle), k1, k2, k3, t1, t2, k4."""
    lens = shots.lens
    terms = {
        "none": (), "radialk1": ("k1",), "radialk3": ("k1", "k2", "k3"),
        "brown": ("k1", "k2", "k3", "t1", "t2"), "fisheye4": ("k1", "k2", "k3", "k4"),
    }[kind]  # fmt: skip
    views, poses = [], []
    for i, (name, pose, center) in enumerate(
        zip(shots.names, shots.poses, shots.centers(), strict=True)
    ):
        views.append(
            {
                "viewId": str(100 + i), "poseId": str(200 + i), "intrinsicId": "7",
                "path": shots.stored_in + name, "width": str(shots.width),
                "height": str(shots.height), "metadata": "",
            }
        )  # fmt: skip
        by_column = [repr(float(value)) for value in pose[:, :3].T.ravel()]
        transform = {"rotation": by_column, "center": [repr(float(value)) for value in center]}
        poses.append({"poseId": str(200 + i), "pose": {"transform": transform, "locked": "false"}})
    intrinsic = {
        "intrinsicId": "7", "width": str(shots.width), "height": str(shots.height),
        "sensorWidth": "36", "sensorHeight": "24", "serialNumber": "", "type": "pinhole",
        "initializationMode": "estimated", "focalLength": repr(lens["f"]), "pixelRatio": "1",
        "principalPoint": [repr(lens.get("cx", 0.0)), repr(lens.get("cy", 0.0))],
        "distortionType": kind, "undistortionType": "none",
        "distortionParams": [repr(lens.get(k, 0.0)) for k in terms] or "",
        "locked": "false",
    }  # fmt: skip
    values: dict[str, object] = {
        "version": ["1", "2", "11"], "views": views, "intrinsics": [intrinsic], "poses": poses,
    }  # fmt: skip
    if len(shots.points):
        values["structure"] = [
            {"landmarkId": str(i), "descType": "dspsift", "color": ["200", "100", "50"],
             "X": [repr(float(value)) for value in point]}
            for i, point in enumerate(shots.points)
        ]  # fmt: skip
    path = folder / "cameras.sfm"
    path.write_text(json.dumps(values, indent=1))
    return path


def axis_angle(rotation: np.ndarray) -> np.ndarray:
    """Return the (3,) axis times angle of a (3, 3) rotation by less than half a turn."""
    cosine = max(-1.0, min(1.0, (float(np.trace(rotation)) - 1.0) / 2.0))
    angle = math.acos(cosine)
    axis = np.array([
        rotation[2, 1] - rotation[1, 2],
        rotation[0, 2] - rotation[2, 0],
        rotation[1, 0] - rotation[0, 1],
    ])  # fmt: skip
    length = float(np.linalg.norm(axis))
    if length < 1e-6 and cosine < 0:  # half a turn: the axis is in the symmetric part
        squares = (np.diag(rotation) + 1.0) / 2.0
        axis = rotation[int(np.argmax(squares))] + np.eye(3)[int(np.argmax(squares))]
        length = float(np.linalg.norm(axis))
    return axis * (angle / length) if length else np.zeros(3)


def opensfm_camera(shots: Shots, kind: str) -> dict[str, object]:
    """Return the entry of a camera."""
    return {
        "projection_type": kind, "width": shots.width, "height": shots.height, **shots.lens,
    }  # fmt: skip


def write_opensfm(folder: Path, shots: Shots, *, kind: str = "brown") -> Path:
    """Lens: focal or focal_x, focal_y, c_x, c_y (shares), k1, k2, k3, p1, p2."""
    entries = {
        shots.stored_in + name: {
            "rotation": axis_angle(pose[:, :3]).tolist(),
            "translation": pose[:, 3].tolist(),
            "camera": "v2 unknown 0.85",
        }
        for name, pose in zip(shots.names, shots.poses, strict=True)
    }
    points = {
        str(i): {"color": [200.0, 100.0, 50.0], "coordinates": point.tolist()}
        for i, point in enumerate(shots.points)
    }
    cameras = {"v2 unknown 0.85": opensfm_camera(shots, kind)}
    path = folder / "reconstruction.json"
    path.write_text(json.dumps([{"cameras": cameras, "shots": entries, "points": points}]))
    return path


def write_opendrone_shots(folder: Path, shots: Shots, *, kind: str = "brown") -> Path:
    """Lens: as :func:`write_opensfm`; ``odm_report/shots.geojson`` and ``cameras.json``."""
    features = [
        {
            "type": "Feature",
            "properties": {
                "filename": name,
                "focal": shots.lens.get("focal_x", shots.lens.get("focal")),
                "width": shots.width,
                "height": shots.height,
                "translation": center.tolist(),
                "rotation": axis_angle(pose[:, :3]).tolist(),
            },
            "geometry": {"type": "Point", "coordinates": [9.0, 47.0, 400.0]},
        }
        for name, pose, center in zip(shots.names, shots.poses, shots.centers(), strict=True)
    ]
    cameras = {"v2 unknown 0.85": opensfm_camera(shots, kind)}
    (folder / "cameras.json").write_text(json.dumps(cameras))
    path = folder / "odm_report" / "shots.geojson"
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return path


def write_polycam(folder: Path, shots: Shots, *, corrected: bool = True) -> Path:
    """Lens: fx, fy, cx, cy in pixels; the photos belong into the folder beside the cameras."""
    prefix = "corrected_" if corrected else ""
    cameras = folder / "keyframes" / f"{prefix}cameras"
    cameras.mkdir(parents=True)
    (folder / "keyframes" / f"{prefix}images").mkdir(exist_ok=True)
    for name, pose, center in zip(shots.names, shots.poses, shots.centers(), strict=True):
        turned = pose[:, :3].T @ _OPENGL_FROM_COLMAP
        values: dict[str, float] = {f"t_{r}{c}": turned[r, c] for r in range(3) for c in range(3)}
        values |= {f"t_{r}3": center[r] for r in range(3)}
        values |= {"width": shots.width, "height": shots.height, **shots.lens}
        (cameras / Path(name).with_suffix(".json")).write_text(json.dumps(values))
    return folder


def write_transforms(folder: Path, shots: Shots) -> Path:
    """Lens: fl_x, fl_y, cx, cy in pixels, k1, k2, p1, p2, or camera_model EQUIRECTANGULAR."""
    frames = []
    for name, pose, center in zip(shots.names, shots.poses, shots.centers(), strict=True):
        matrix = np.eye(4)
        matrix[:3, :3] = pose[:, :3].T @ _OPENGL_FROM_COLMAP
        matrix[:3, 3] = center
        frames.append({"file_path": shots.stored_in + name, "transform_matrix": matrix.tolist()})
    values = {"w": shots.width, "h": shots.height, **shots.lens, "frames": frames}
    path = folder / "transforms.json"
    path.write_text(json.dumps(values))
    return path
