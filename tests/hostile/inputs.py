# SPDX-License-Identifier: GPL-3.0-or-later
"""Good inputs and the ways in which cases spoil them. All are made without chance."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from tests.core.readers.model_writers import (
    Model,
    ring_model,
    ring_poses,
    write_binary,
    write_photos,
    write_text,
)
from tests.hostile.case import Build

COUNT = 6
"""Photos of a good input: one that is dropped leaves enough, and less than a fifth."""
POINTS = 120
_OPENGL_FROM_COLMAP = np.diag([1.0, -1.0, -1.0, 1.0])

CUBE = [[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)]


def nothing(_folder: Path) -> None:
    """Leave the folder of the input empty."""


def steps(*builds: Build) -> Build:
    """Return a build of several, one after another."""

    def build(folder: Path) -> None:
        for one in builds:
            one(folder)

    return build


def file(name: str, content: bytes | str = b"") -> Build:
    """Return the build of one file, with the folders that it lies in."""
    data = content.encode() if isinstance(content, str) else content

    def build(folder: Path) -> None:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)

    return build


def json_file(name: str, values: Any) -> Build:
    """Return the build of one JSON file."""
    return file(name, json.dumps(values))


def folder_of(name: str) -> Build:
    """Return the build of an empty folder."""
    return lambda folder: (folder / name).mkdir(parents=True)


def link(name: str, target: str) -> Build:
    """Return the build of a symbolic link; it replaces what is there."""

    def build(folder: Path) -> None:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        remove(name)(folder)
        path.symlink_to(target)

    return build


def pipe(name: str) -> Build:
    """Return the build of a named pipe; it replaces what is there."""

    def build(folder: Path) -> None:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        remove(name)(folder)
        os.mkfifo(path)

    return build


def remove(name: str) -> Build:
    """Return what removes a file."""
    return lambda folder: (folder / name).unlink(missing_ok=True)


def unreadable(name: str) -> Build:
    """Return what takes all rights on an entry away."""
    return lambda folder: (folder / name).chmod(0)


def renamed(name: str, new: str) -> Build:
    """Return what moves an entry."""

    def build(folder: Path) -> None:
        (folder / new).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).rename(folder / new)

    return build


def changed(name: str, change: Callable[[bytes], bytes]) -> Build:
    """Return what replaces the content of a file."""

    def build(folder: Path) -> None:
        path = folder / name
        path.write_bytes(change(path.read_bytes()))

    return build


def colmap(
    change: Callable[[Model], None] = lambda model: None,
    *,
    count: int = COUNT,
    points: int = POINTS,
    text: bool = False,
    place: str = "set/sparse/0",
    photos: bool = True,
    **lines: Any,
) -> Build:
    """Return the build of a COLMAP project whose model is changed, but not its photos."""

    def build(folder: Path) -> None:
        model = ring_model(count, points=points)
        if photos:
            write_photos(model, folder / "set" / "images")
        change(model)
        if text:
            write_text(model, folder / place, **lines)
        else:
            write_binary(model, folder / place)

    return build


def transforms_values(count: int = COUNT) -> dict[str, Any]:
    """Return the values of a good transforms.json."""
    frames = []
    for number, pose in enumerate(ring_poses(count)):
        world = np.linalg.inv(np.vstack([pose, [0.0, 0.0, 0.0, 1.0]])) @ _OPENGL_FROM_COLMAP
        name = f"images/p{number:02d}.png"
        frames.append({"file_path": name, "transform_matrix": world.tolist()})
    size = {"w": 64, "h": 48, "fl_x": 60.0, "fl_y": 61.0, "cx": 32.0, "cy": 24.0}
    return {**size, "frames": frames}


def transforms(
    change: Callable[[dict[str, Any]], Any] = lambda values: None,
    *,
    name: str = "transforms.json",
    count: int = COUNT,
) -> Build:
    """Return the build of photos with a transforms.json; a change may return other values."""

    def build(folder: Path) -> None:
        write_photos(ring_model(count), folder / "set" / "images")
        values = transforms_values(count)
        other = change(values)
        json_file(f"set/{name}", values if other is None else other)(folder)

    return build


def transforms_text(text: str) -> Build:
    """Return the build of photos with a transforms.json of the given text."""
    return steps(transforms(), file("set/transforms.json", text))


def photo(name: str, save: Callable[[Path], None]) -> Build:
    """Return the build that replaces one photo of a good COLMAP project."""

    def build(folder: Path) -> None:
        colmap()(folder)
        path = folder / "set" / "images" / name
        path.unlink(missing_ok=True)
        save(path)

    return build


def every_photo(save: Callable[[Path], None]) -> Build:
    """Return the build that replaces all photos of a good COLMAP project."""

    def build(folder: Path) -> None:
        colmap()(folder)
        for path in sorted((folder / "set" / "images").iterdir()):
            path.unlink()
            save(path)

    return build


def plain(width: int, height: int, **options: Any) -> Callable[[Path], None]:
    """Return what saves a grey photo of a size."""

    def save(path: Path) -> None:
        pixels = np.random.default_rng(width).integers(0, 255, (height, width, 3)).astype(np.uint8)
        Image.fromarray(pixels).save(path, **options)

    return save


def region(**changes: Any) -> dict[str, Any]:
    """Return the values of a region file, a cube, with changes."""
    values = {
        "class_name": "GaussianWrappingBoundingVolume", "version": 1,
        "blender_object_name": "Cube", "vertices": CUBE, "hull_simplices": None,
    }  # fmt: skip
    return {**values, **changes}
