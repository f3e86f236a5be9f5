# SPDX-License-Identifier: GPL-3.0-or-later
"""Cameras and points for the tests of camera files, and our own projection of what was read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from gaussian_wrapping_addon.core.loading.source_kind import read_poses, source_kind
from gaussian_wrapping_addon.core.photos.formats import PhotoHeader
from gaussian_wrapping_addon.core.readers.lenses import fit_lens, project
from gaussian_wrapping_addon.core.readers.source_model import SourceModel, counts_stored_pixels
from tests.core.readers.writers import Shots
from tests.poses import look_at_pose

WIDTH, HEIGHT = 96, 64
NAMES = ("IMG_0001.jpg", "IMG_0002.jpg", "IMG_0003.jpg", "IMG_0004.jpg")
EYES = ((3.0, 0.3, 1.0), (0.5, 2.8, -0.7), (-2.5, -1.0, 1.6), (0.9, -2.7, 0.4))


def known_points() -> np.ndarray:
    """Return (40, 3) points around the origin, in view of all cameras."""
    return np.random.default_rng(11).uniform(-0.6, 0.6, (40, 3))


def shots(lens: dict[str, float], **more: object) -> Shots:
    """Return four cameras around the origin, each turned about its own axis as well."""
    poses = []
    for i, eye in enumerate(EYES):
        pose = look_at_pose(eye, (0.1, -0.05, 0.07 * i))
        angle = 0.35 * i - 0.4
        turn = np.array([
            [np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0, 0, 1.0],
        ])  # fmt: skip
        poses.append(turn @ pose)
    return Shots(NAMES, poses, WIDTH, HEIGHT, lens, **more)  # type: ignore[arg-type]


def write_photos(folder: Path, names: tuple[str, ...] = NAMES) -> None:
    """Write photos with some texture."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(5)
    for name in names:
        pixels = rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(folder / name, quality=95)


def read(source: Path) -> SourceModel:
    """Read an input as the command line does."""
    return read_poses(source_kind(source))


def our_pixels(model: SourceModel, points: np.ndarray) -> dict[str, np.ndarray]:
    """Return (n, 2) pixels of (n, 3) world points in each photo, first pixel's centre at 0.5."""
    found = {}
    for photo in model.photos:
        header = PhotoHeader(WIDTH, HEIGHT)
        lens, _, _ = fit_lens(
            photo, header, photo.name, prefers_stored=counts_stored_pixels(model.kind)
        )
        local = points @ photo.cam_from_world[:, :3].T + photo.cam_from_world[:, 3]
        found[Path(photo.name).stem] = project(lens, local)
    return found
