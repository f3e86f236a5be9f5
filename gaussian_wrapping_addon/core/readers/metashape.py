# SPDX-License-Identifier: GPL-3.0-or-later
"""Read the cameras of Agisoft Metashape ("Export Cameras", XML).

A camera's ``transform`` leads from camera (x right, y down, z forward) to its chunk, a
``transform`` of the component or chunk from there to the world. Pixels count from the photo's
corner; the principal point ``cx, cy`` is an offset from the photo's middle.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from ..scene.camera import Similarity, pose_at
from .program_values import (
    CameraFile,
    PhotoList,
    begins_with,
    fisheye_lens,
    read_xml,
    relative_names,
)
from .source_model import PANORAMA, Brown, LensCamera, SourceModel

KIND = "Metashape cameras"

_CHOOSE = "Export Cameras as Agisoft XML."
_CONVERT = "Convert the photos to perspective images (Tools, Convert Images), and export again."
_COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")
_PANORAMA = "spherical"
_NO_LENS = ("p3", "p4")
"""Coefficients of old versions, which change the tangential terms."""


def is_metashape(path: Path) -> bool:
    """Whether an XML file is of the program: its start names a document with chunks."""
    start = begins_with(path, ".xml", 4096)
    return b"<document" in start and b"<chunk" in start


@dataclass(frozen=True)
class _Group:
    """Cameras in one frame: a component, or a chunk without any."""

    label: str
    cameras: list[Element]
    world_from_group: Similarity


def read_metashape(path: Path) -> SourceModel:
    """Read the largest group of cameras in one frame; the file holds no points.

    Raises ParseError, which names the camera or sensor and the entry; DatasetError: no photo is
    usable.
    """
    file = CameraFile(path)
    root = read_xml(path)
    chunks = [root] if root.tag == "chunk" else root.findall("chunk")
    if root.tag not in ("document", "chunk") or not chunks:
        raise file.wrong("top level", "a document with a chunk was expected.", _CHOOSE)
    photos = PhotoList(path)
    groups = [(chunk, group) for chunk in chunks for group in _groups(file, chunk, photos)]
    if not groups:
        photos.check_count("cameras with a transform", 0)
    chunk, chosen = max(groups, key=lambda pair: len(pair[1].cameras))
    photos.check_count("cameras with a transform", len(chosen.cameras))
    others = sum(len(group.cameras) for _, group in groups) - len(chosen.cameras)
    if others:
        photos.warn(
            "several-models",
            f"{path.name} holds {len(groups)} groups of cameras; {chosen.label} with "
            f"{len(chosen.cameras)} was used, {others} cameras are in others.",
            "Align the chunks or components in Metashape, so that one holds all cameras.",
        )
    lenses: dict[str, LensCamera | None] = {}  # None: a panorama
    sensors = {sensor.get("id", ""): sensor for sensor in chunk.findall("sensors/sensor")}
    names = relative_names(camera.get("label", "") for camera in chosen.cameras)
    for camera in chosen.cameras:
        label = camera.get("label", "")
        place = f"camera {label[:80]!r}"
        sensor_id = camera.get("sensor_id", "")
        if sensor_id not in lenses:
            if sensor_id not in sensors:
                raise file.wrong(place, "its sensor is not in the file.")
            sensor = sensors[sensor_id]
            whole = sensor.get("type") == _PANORAMA
            lenses[sensor_id] = None if whole else _lens(file, sensor)
        pose = _pose(file, place, camera, chosen.world_from_group)
        photos.add(names[label], lenses[sensor_id], pose)
    usable = photos.finished()
    facts = {
        "group": chosen.label,
        "camera_models": sorted({lens.model if lens else PANORAMA for lens in lenses.values()}),
    }
    return SourceModel(KIND, usable, warnings=tuple(photos.warnings), facts=facts)


def _groups(file: CameraFile, chunk: Element, photos: PhotoList) -> list[_Group]:
    """Return the chunk's aligned and enabled cameras by component."""
    chunk_name = chunk.get("label") or "the chunk"
    cameras: dict[str, list[Element]] = {}
    for camera in chunk.findall("cameras//camera"):
        label = camera.get("label", "")
        if camera.get("enabled", "true").lower() in ("false", "0"):
            photos.leave_out(label, "being disabled")
        elif camera.find("transform") is None:
            photos.leave_out(label, "not being aligned")
        else:
            cameras.setdefault(camera.get("component_id", ""), []).append(camera)
    of_chunk = _similarity(file, f"{chunk_name}, transform", chunk.find("transform"))
    found = []
    for component_id, members in cameras.items():
        label, world_from_group = chunk_name, of_chunk
        for component in chunk.findall("components/component"):
            if component_id and component.get("id") == component_id:
                label = component.get("label") or f"component {component_id}"
                own = component.find("transform")
                if own is not None:
                    world_from_group = _similarity(file, f"{label}, transform", own)
        found.append(_Group(label[:80], members, world_from_group))
    return found


def _similarity(file: CameraFile, place: str, transform: Element | None) -> Similarity:
    """Read a transform: rotation, translation and scale, or a 4 x 4 matrix; none is identity."""
    if transform is None:
        return Similarity()
    text = (transform.text or "").strip()
    if text:
        matrix = file.numbers(place, text, 16).reshape(4, 4)
        scale = float(np.cbrt(max(np.linalg.det(matrix[:3, :3]), 0.0)))
        linear, translation = matrix[:3, :3], matrix[:3, 3]
    else:
        values = {name: transform.findtext(name) for name in ("rotation", "translation", "scale")}
        linear = file.numbers(place, values["rotation"] or "1 0 0 0 1 0 0 0 1", 9).reshape(3, 3)
        translation = file.numbers(place, values["translation"] or "0 0 0", 3)
        scale = file.number(f"{place}, scale", values["scale"] or "1")
        linear = scale * linear
    if not scale > 0:
        raise file.wrong(place, "the scale is not positive, or it mirrors.")
    return Similarity(scale, file.rotation(place, linear / scale), translation)


def _pose(
    file: CameraFile, place: str, camera: Element, world_from_group: Similarity
) -> np.ndarray:
    """Return (3, 4) cam_from_world."""
    place = f"{place}, transform"
    matrix = file.numbers(place, camera.findtext("transform") or "", 16).reshape(4, 4)
    if np.abs(matrix[3] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-6:
        raise file.wrong(place, "the last row is not 0 0 0 1.")
    group_from_camera = file.rotation(place, matrix[:3, :3])
    cam_from_world = (world_from_group.rotation @ group_from_camera).T
    return pose_at(cam_from_world, world_from_group.points(matrix[None, :3, 3])[0])


def _lens(file: CameraFile, sensor: Element) -> LensCamera:
    """Return the lens of a sensor: its adjusted calibration, else the initial one."""
    place = f"sensor {(sensor.get('label') or sensor.get('id') or '')[:80]!r}"
    found = sensor.findall("calibration")
    adjusted = [entry for entry in found if entry.get("class", "adjusted") == "adjusted"]
    if not found:
        hint = "Align the photos and export again."
        raise file.wrong(place, "it has no calibration.", hint)
    calibration = (adjusted or found)[0]
    size = calibration.find("resolution")
    if size is None:
        size = sensor.find("resolution")
    if size is None:
        raise file.wrong(place, "the resolution is missing.")
    width, height = file.image_size(place, size.get("width"), size.get("height"))

    def value(name: str) -> float:
        return file.number(f"{place}, {name}", calibration.findtext(name) or "0")

    kind = calibration.get("type") or sensor.get("type") or "frame"
    if kind not in ("frame", "fisheye"):
        raise file.unsupported(place, f"the sensor type {kind}", _CONVERT)
    for name in _NO_LENS:
        if value(name):
            raise file.unsupported(place, f"the coefficient {name}", "Fit p1 and p2 alone.")
    focal = value("f")
    if calibration.find("f") is None and calibration.find("fx") is not None:
        raise file.unsupported(place, "a calibration with fx and fy", _CHOOSE)
    if focal <= 0:
        raise file.wrong(f"{place}, f", "the focal length is not positive.")
    focals = focal + value("b1"), focal
    center = 0.5 * width + value("cx"), 0.5 * height + value("cy")
    k1, k2, k3, k4, p1, p2 = (value(name) for name in _COEFFICIENTS)
    skew = value("b2")
    if kind == "frame":
        # The program's p1 and p2 are OpenCV's p2 and p1.
        brown = Brown(k1, k2, k3, k4, p1=p2, p2=p1, skew=skew)
        lens = brown.lens(width, height, focals, center)
    elif skew:
        raise file.unsupported(place, "b2 of a fisheye", "Fit the cameras without b2.")
    else:
        lens = fisheye_lens(width, height, focals, center, (k1, k2, k3, k4), (p2, p1))
    return file.lens(place, lens)
