# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos of the turntable benchmark: background that stands still, cameras that go around."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from benchmarks.scenes.visibility import RayScene
from benchmarks.turntable.__main__ import _page
from benchmarks.turntable.photos import Turntable, truth_of, turntable, write_photos

COUNT, WIDTH, HEIGHT = 6, 80, 60


def silhouettes(made: Turntable) -> np.ndarray:
    rays = RayScene(made.mesh.vertices, made.mesh.faces)
    shapes = []
    for camera in made.cameras:
        y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
        local = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, x * 0 + 1], -1)
        directions = (local @ camera.rotation).reshape(-1, 3)
        origins = np.broadcast_to(camera.center, directions.shape)
        shapes.append((rays.first_hits(origins, directions)[1] >= 0).reshape(HEIGHT, WIDTH))
    return np.array(shapes)


def test_only_the_cow_turns() -> None:
    made = turntable(COUNT, WIDTH, HEIGHT)
    shapes, photos = silhouettes(made), np.array(made.photos, float)
    assert 0.05 < shapes.mean() < 0.4
    still = ~shapes.any(axis=0)
    still[1:-1, 1:-1] &= ~(shapes.any(axis=0)[:-2, 1:-1] | shapes.any(axis=0)[2:, 1:-1])
    deviation = photos[:, still].std(axis=0)
    assert np.median(deviation) < 2.5  # noise alone
    turning = photos[:, shapes.all(axis=0)].std(axis=0)
    assert np.median(turning) > 5.0


def test_cameras_stand_at_one_height_around_the_cow() -> None:
    made = turntable(COUNT, WIDTH, HEIGHT, elevations=2)
    centers = np.array([camera.center for camera in made.cameras])
    assert len(made.photos) == len(centers) == COUNT
    assert len(np.unique(centers[:, 2].round(6))) == 2
    assert np.ptp(np.linalg.norm(centers, axis=1)) < 1e-6
    seen = truth_of(made).seen
    assert seen is not None
    assert 0.5 < (seen >= 2).mean() < 1.0


def test_photos_tell_their_focal_length(tmp_path: Path) -> None:
    made = turntable(2, WIDTH, HEIGHT)
    write_photos(made, tmp_path / "photos")
    with Image.open(tmp_path / "photos" / made.cameras[1].name) as photo:
        assert photo.size == (WIDTH, HEIGHT)
        assert photo.getexif().get_ifd(0x8769)[0xA405] == 45


def test_the_page_shows_failures_as_such() -> None:
    common = {"photos": 4, "places": 1, "preset": "draft", "code": "c", "date": "d", "machine": "m"}
    failed = {**common, "turntable": "off", "failed": "error: none placed"}
    good = {
        **common, "turntable": "auto", "placed": 4, "rotation_degrees_median": 0.1, "mask_iou": 0.9,
        "f1": [0.1, 0.2, 0.3], "precision": [0.4] * 3, "recall": [0.5] * 3, "processor_s": 9.0,
    }  # fmt: skip
    page = _page([good, failed])
    assert "error: none placed" in page
    assert "| 4 of 4 " in page
    assert "0.100 / 0.200 / 0.300" in page
