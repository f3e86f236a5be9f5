# SPDX-License-Identifier: GPL-3.0-or-later
"""Matches of a hall without its photos: what a solver is given where walls repeat, in seconds.

Points on four walls with relief, and on the floor. Where walls repeat, a point of one wall looks
like that at the same place of each other wall, and photos of different walls match.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.dataset.pycolmap_import import import_pycolmap

from .places import Place, hall

NOISE_PX = 0.4
WRONG_SHARE = 0.15
"""Of the matches of a pair, those made by chance."""
_WALL_POINTS = 320
_RELIEF_M = 0.6


@dataclass(frozen=True)
class Tracks:
    """Features of photos."""

    cameras: tuple[Camera, ...]
    pixels: tuple[np.ndarray, ...]
    """(n, 2) of each photo."""
    looks: tuple[np.ndarray, ...]
    """(n,) int64 of each photo: features of one number match."""


def hall_tracks(
    photos: int, floor_points: int, *, repeats: int, seed: int, alike: float = 1.0
) -> Tracks:
    """Return what photos of the hall show.

    Parameters
    ----------
    floor_points : int
        Points that look like no others, all over the hall.
    repeats : int
        Walls that look the same, 1 to 4.
    alike : float
        Share of their points that do.
    """
    chance = np.random.default_rng(seed)
    place: Place = hall(photos)
    half, height = 5.0, 4.0
    points, looks = [], []
    patterns: dict[int, np.ndarray] = {}
    for wall in range(4):
        pattern = 0 if wall < repeats else wall
        if pattern not in patterns:
            patterns[pattern] = chance.uniform(
                [-half, 0.0, 0.0], [half, height, _RELIEF_M], (_WALL_POINTS, 3)
            )
        along, up, out = patterns[pattern].T
        turn = np.pi / 2 * wall
        axis, normal = [np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]
        ground = np.outer(along, axis) + np.outer(half - out, normal)
        points.append(np.column_stack([ground, up]))
        own = np.arange(_WALL_POINTS) >= alike * _WALL_POINTS
        looks.append(np.where(own, wall, pattern) * _WALL_POINTS + np.arange(_WALL_POINTS))
    floor = chance.uniform([-half, -half, 0.0], [half, half, 0.4], (floor_points, 3))
    points.append(floor)
    looks.append(10 * _WALL_POINTS + np.arange(floor_points))
    xyz, look = np.concatenate(points), np.concatenate(looks)
    pixels_of, looks_of = [], []
    for camera in place.cameras:
        pixels, depth = camera.project(xyz)
        inside = (
            (depth > 0.2) & (pixels > 0).all(1) & (pixels < [camera.width, camera.height]).all(1)
        )
        pixels_of.append(pixels[inside] + chance.normal(0.0, NOISE_PX, (int(inside.sum()), 2)))
        looks_of.append(look[inside])
    return Tracks(place.cameras, tuple(pixels_of), tuple(looks_of))


def write_database(path: Path, tracks: Tracks, *, seed: int) -> list[tuple[int, int]]:
    """Write features and verified matches of all pairs; return the pairs that were matched."""
    pycolmap = import_pycolmap()

    chance = np.random.default_rng(seed)
    with pycolmap.Database.open(path) as db:
        first = tracks.cameras[0]
        lens = pycolmap.Camera(
            model="SIMPLE_RADIAL", width=first.width, height=first.height,
            params=[first.fx, first.cx, first.cy, 0.0],
        )  # fmt: skip
        lens.has_prior_focal_length = True
        camera_id = db.write_camera(lens)
        rig = pycolmap.Rig()
        rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id))
        rig_id = db.write_rig(rig)
        numbers = []
        for camera, pixels in zip(tracks.cameras, tracks.pixels, strict=True):
            image_id = db.write_image(pycolmap.Image(name=camera.name, camera_id=camera_id))
            frame = pycolmap.Frame()
            frame.rig_id = rig_id
            frame.add_data_id(
                pycolmap.data_t(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id), image_id)
            )
            db.write_frame(frame)
            db.write_keypoints(image_id, pixels.astype(np.float32))
            numbers.append(image_id)
        pairs = []
        for i in range(len(numbers)):
            for j in range(i + 1, len(numbers)):
                matches = _matches(tracks.looks[i], tracks.looks[j], chance)
                if len(matches) >= 15:
                    db.write_matches(numbers[i], numbers[j], matches)
                    pairs.append((i, j))
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = seed
    verifier = pycolmap.GeometricVerifierOptions()
    verifier.num_threads = 1
    pycolmap.geometric_verification(
        path, verifier_options=verifier, two_view_geometry_options=options
    )
    return pairs


def _matches(one: np.ndarray, other: np.ndarray, chance: np.random.Generator) -> np.ndarray:
    """Return (m, 2) uint32 features of one look; of several in a photo any one."""
    order_one, order_other = chance.permutation(len(one)), chance.permutation(len(other))
    common, a, b = np.intersect1d(one[order_one], other[order_other], return_indices=True)
    first, second = order_one[a], order_other[b]
    wrong = chance.uniform(size=len(common)) < WRONG_SHARE
    second[wrong] = chance.permutation(second[wrong])
    return np.column_stack([first, second]).astype(np.uint32)
