# SPDX-License-Identifier: GPL-3.0-or-later
"""Places with known cameras: rooms and streets of boxes, their photos and their matches."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from gaussian_wrapping_addon.core.compiled import kernel, part
from gaussian_wrapping_addon.core.parallel import even_bounds, run_chunks
from gaussian_wrapping_addon.core.readers.lenses import import_pycolmap
from gaussian_wrapping_addon.core.scene.camera import Camera

from .scenes.build import SparsePoints, write_colmap
from .scenes.cache import CACHE

SAMPLES = 2
"""Rays along each side of a pixel."""
CELLS_M = (1.6, 0.7, 0.3, 0.14)
"""Sizes of the squares of plain colour that the texture is a sum of, metres."""


@dataclass(frozen=True)
class Boxes:
    """Axis-parallel boxes; the first is seen from inside, the others from outside."""

    lower: np.ndarray
    """(n, 3) float64, metres."""
    upper: np.ndarray
    """(n, 3) float64, metres."""
    face_looks: np.ndarray
    """(n, 6) int64: number of the texture of the faces -x, +x, -y, +y, -z, +z. Faces of one number
    that have one size look the same."""


def render(boxes: Boxes, camera: Camera, *, threads: int = 1) -> np.ndarray:
    """Return a (h, w, 3) uint8 photo."""
    photo = np.empty((camera.height, camera.width, 3), np.uint8)
    lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    cells = np.array(CELLS_M)
    rotation, center = np.ascontiguousarray(camera.rotation), camera.center

    shown = _in_view(boxes, camera)
    lower, upper, looks = boxes.lower[shown], boxes.upper[shown], boxes.face_looks[shown]

    def rows(begin: int, end: int) -> None:
        _cast(lower, upper, looks, rotation, center, lens, cells, begin, end, photo)

    run_chunks(rows, even_bounds(camera.height, threads), threads)
    return photo


def _in_view(boxes: Boxes, camera: Camera) -> np.ndarray:
    """Return the numbers of the first box and of those whose spheres meet the cone of view."""
    middle = (boxes.lower + boxes.upper) / 2
    radius = np.linalg.norm(boxes.upper - boxes.lower, axis=1) / 2
    seen = camera.to_camera(middle)
    half = math.atan(math.hypot(camera.cx / camera.fx, camera.cy / camera.fy))
    beside, ahead = np.hypot(seen[:, 0], seen[:, 1]), seen[:, 2]
    # Distance of the sphere's middle from the cone's surface, positive outside.
    outside = beside * math.cos(half) - ahead * math.sin(half)
    return np.flatnonzero((outside < radius) | (np.arange(len(middle)) == 0))


@part(fast=False)
def _hashed(a: int, b: int, c: int, d: int) -> float:
    """Return a number in [0, 1) that four integers decide."""
    value = np.uint64(a * 73856093 ^ b * 19349663 ^ c * 83492791 ^ d * 2654435761)
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    value = value ^ (value >> np.uint64(31))
    return (value >> np.uint64(40)) / 16777216.0


@kernel(fast=False)
def _cast(lower, upper, looks, rotation, center, lens, cells, begin, end, photo):  # type: ignore[no-untyped-def]
    inverse = np.empty(3)
    ray = np.empty(3)
    for row in range(begin, end):
        for column in range(photo.shape[1]):
            red, green, blue = 0.0, 0.0, 0.0
            for sample in range(SAMPLES * SAMPLES):
                u = column + (sample % SAMPLES + 0.5) / SAMPLES
                v = row + (sample // SAMPLES + 0.5) / SAMPLES
                x, y = (u - lens[2]) / lens[0], (v - lens[3]) / lens[1]
                for axis in range(3):
                    ray[axis] = rotation[0, axis] * x + rotation[1, axis] * y + rotation[2, axis]
                    step = ray[axis] if abs(ray[axis]) > 1e-12 else 1e-12
                    inverse[axis] = 1.0 / step
                best, box, face = 1e30, 0, 0
                for b in range(lower.shape[0]):
                    near, far = -1e30, 1e30
                    near_face, far_face = 0, 0
                    for axis in range(3):
                        t0 = (lower[b, axis] - center[axis]) * inverse[axis]
                        t1 = (upper[b, axis] - center[axis]) * inverse[axis]
                        f0, f1 = 2 * axis, 2 * axis + 1
                        if t0 > t1:
                            t0, t1 = t1, t0
                            f0, f1 = f1, f0
                        if t0 > near:
                            near, near_face = t0, f0
                        if t1 < far:
                            far, far_face = t1, f1
                    if b == 0:
                        best, face = far, far_face
                    elif 1e-6 < near < far and near < best:
                        best, box, face = near, b, near_face
                axis = face // 2
                first, second = (axis + 1) % 3, (axis + 2) % 3
                if first == 2:  # along the wall, then up
                    first, second = second, first
                a = center[first] + best * ray[first] - lower[box, first]
                c = center[second] + best * ray[second] - lower[box, second]
                if (face == 1 or face == 2) and axis < 2:
                    # Seen from the room, all walls run in one direction.
                    a = upper[box, first] - lower[box, first] - a
                look = looks[box, face]
                pixel_m = best / lens[0]
                shades = 0.0
                colour0, colour1, colour2 = 0.0, 0.0, 0.0
                for level in range(cells.shape[0]):
                    size = cells[level]
                    # Squares fade out before they are smaller than a pixel, which would alias.
                    weight = min(max((size / pixel_m - 1.0) / 2.0, 0.0), 1.0)
                    weight *= (size / cells[0]) ** 0.3  # large squares stand out
                    if weight > 0.0:
                        i, j = math.floor(a / size), math.floor(c / size)
                        key = look * 64 + level
                        grey = _hashed(key, i, j, 7) - 0.5
                        colour0 += weight * (grey + 0.5 * (_hashed(key, i, j, 1) - 0.5))
                        colour1 += weight * (grey + 0.5 * (_hashed(key, i, j, 2) - 0.5))
                        colour2 += weight * (grey + 0.5 * (_hashed(key, i, j, 3) - 0.5))
                    shades += 1.0
                light = 0.42 + 0.05 * (face % 3)
                gain = 0.9 / math.sqrt(shades)
                red += light + gain * colour0
                green += light + gain * colour1
                blue += light + gain * colour2
            share = 255.0 / (SAMPLES * SAMPLES)
            photo[row, column, 0] = np.uint8(min(max(red * share, 0.0), 255.0))
            photo[row, column, 1] = np.uint8(min(max(green * share, 0.0), 255.0))
            photo[row, column, 2] = np.uint8(min(max(blue * share, 0.0), 255.0))


WIDTH_PX, HEIGHT_PX = 640, 480
FOCAL_PX = 430.0
BLOCKS, PITCH_M, BLOCK_M = 4, 11.0, 6.0
"""Blocks along each side of the town, their distance, and their largest side."""
_EXIF_FOLDER, _FOCAL_35MM = 0x8769, 0xA405


@dataclass(frozen=True)
class Place:
    """Boxes, and who looks at them."""

    boxes: Boxes
    cameras: tuple[Camera, ...]


def town(count: int) -> Place:
    """Return streets between unlike blocks, walked through by somebody who looks to both sides."""
    chance = np.random.default_rng(1)
    half = BLOCKS * PITCH_M / 2
    lower, upper = [[-half - 8, -half - 8, 0.0]], [[half + 8, half + 8, 18.0]]
    for i in range(BLOCKS):
        for j in range(BLOCKS):
            middle = (np.array([i, j]) + 0.5) * PITCH_M - half + chance.uniform(-0.6, 0.6, 2)
            side = chance.uniform(0.6, 1.0, 2) * BLOCK_M / 2
            lower.append([*(middle - side), 0.0])
            upper.append([*(middle + side), chance.uniform(2.5, 7.0)])
            for _ in range(3):  # things along the walls, which stand out
                at = middle + chance.uniform(-1.25, 1.25, 2) * side
                size = chance.uniform(0.2, 0.6, 2)
                lower.append([*(at - size), 0.0])
                upper.append([*(at + size), chance.uniform(0.5, 2.2)])
    looks = np.arange(6 * len(lower)).reshape(-1, 6)
    boxes = Boxes(np.array(lower), np.array(upper), looks)
    return Place(boxes, tuple(_walk(count, half, chance)))


def _walk(count: int, half: float, chance: np.random.Generator) -> list[Camera]:
    """Return cameras along all streets, first one way, then across, and along the first again."""
    streets = [-half + PITCH_M * k for k in range(BLOCKS + 1)]
    ends = (-half, half)
    corners = [(x, y) for k, x in enumerate(streets) for y in ends[:: 1 - k % 2 * 2]]
    corners += [(x, y) for k, y in enumerate(streets[::-1]) for x in ends[:: k % 2 * 2 - 1]]
    corners += [(-half, half), (half, half)]
    path = np.array(corners, float)
    lengths = np.concatenate([[0.0], np.linalg.norm(np.diff(path, axis=0), axis=1).cumsum()])
    # The end of the way is where the way began: the loop closes.
    at = np.linspace(0.0, lengths[-3] + np.hypot(2 * half, 2 * half), count)
    spots = np.stack([np.interp(at, lengths, path[:, k]) for k in (0, 1)], 1)
    ahead = np.stack([np.interp(at + 3.0, lengths, path[:, k]) for k in (0, 1)], 1)
    behind = np.stack([np.interp(at - 3.0, lengths, path[:, k]) for k in (0, 1)], 1)
    heading = np.arctan2(*(ahead - behind).T[::-1])
    # Swings from side to side: neighbours share most of what they see.
    heading = heading + np.radians(38.0) * np.sin(2 * np.pi * at / 34.0)
    cameras = []
    for k in range(count):
        height = 1.7 + 0.5 * np.sin(k / 9.0)
        center = np.array([*(spots[k] + chance.uniform(-0.15, 0.15, 2)), height])
        forward = np.array([np.cos(heading[k]), np.sin(heading[k]), 0.05])
        cameras.append(camera_at(k, center, forward))
    return cameras


def hall(count: int) -> Place:
    """Return a square hall whose four walls look the same, with the same crate before each."""
    chance = np.random.default_rng(2)
    half = 5.0
    lower, upper = [[-half, -half, 0.0]], [[half, half, 4.0]]
    looks = [[0, 0, 0, 0, 5, 6]]
    for k in range(4):  # the same crate before each wall
        angle = np.pi / 2 * k
        at = 3.2 * np.array([np.cos(angle), np.sin(angle)])
        lower.append([*(at - 0.5), 0.0])
        upper.append([*(at + 0.5), 1.0])
        looks.append([7, 7, 7, 7, 8, 8])
    boxes = Boxes(np.array(lower), np.array(upper), np.array(looks))
    cameras = []
    for k in range(count):
        angle = 2 * np.pi * k / count
        center = np.array([1.6 * np.cos(angle), 1.6 * np.sin(angle), 1.5])
        center = center + chance.uniform(-0.3, 0.3, 3)
        cameras.append(camera_at(k, center, np.array([np.cos(angle), np.sin(angle), 0.18])))
    return Place(boxes, tuple(cameras))


def camera_at(number: int, center: np.ndarray, forward: np.ndarray) -> Camera:
    z = forward / np.linalg.norm(forward)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x = x / np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    pose = np.concatenate([rotation, -(rotation @ center)[:, None]], 1)
    return Camera(
        f"photo_{number:04d}.jpg", WIDTH_PX, HEIGHT_PX, FOCAL_PX, FOCAL_PX, WIDTH_PX / 2,
        HEIGHT_PX / 2, pose,
    )  # fmt: skip


DRAWN = 1
"""Raised whenever photos of a place come out otherwise."""

PLACES: dict[str, Callable[[int], Place]] = {"town": town, "hall": hall}


def ensure_photos(name: str, count: int, *, threads: int = 1, root: Path = CACHE) -> Path:
    """Return a folder with ``images/`` and exact cameras in ``sparse/0``; make it if missing."""
    folder = root / f"solving-{name}-{count}-v{DRAWN}"
    if folder.is_dir():
        return folder
    making = folder.with_name(f"{folder.name}.making")
    shutil.rmtree(making, ignore_errors=True)
    (making / "images").mkdir(parents=True)
    place = PLACES[name](count)
    for camera in place.cameras:
        photo = render(place.boxes, camera, threads=threads)
        write_photo(making / "images" / camera.name, photo)
    write_colmap(making / "sparse" / "0", place.cameras, _no_points())
    making.rename(folder)
    return folder


def write_photo(path: Path, photo: np.ndarray) -> None:
    """Write a JPEG with the focal length in EXIF, rounded to millimetres as cameras do."""
    exif = Image.Exif()
    focal_35mm = FOCAL_PX * np.hypot(36.0, 24.0) / np.hypot(WIDTH_PX, HEIGHT_PX)
    exif.get_ifd(_EXIF_FOLDER)[_FOCAL_35MM] = round(focal_35mm)
    Image.fromarray(photo).save(path, quality=95, exif=exif)


def _no_points() -> SparsePoints:
    nothing: Sequence[int] = ()
    whole = np.array(nothing, np.int64)
    return SparsePoints(
        points=np.zeros((0, 3)), colors=np.zeros((0, 3), np.uint8), errors_px=np.zeros(0),
        point_ids=whole, camera_ids=whole, pixels=np.zeros((0, 2)),
    )  # fmt: skip


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
