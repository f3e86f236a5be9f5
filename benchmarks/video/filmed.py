# SPDX-License-Identifier: GPL-3.0-or-later
"""A video and photos of spot above a floor, by rays, with the exact cameras.

The camera goes around once, up and down, with the shake of a hand, and stands still for a while.
A third of the frames is blurred as by a turn of the camera while the shutter is open.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np
from PIL import Image

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.evaluation.surface.samples import sample_uniformly
from gaussian_wrapping_addon.core.evaluation.surface.truth import Truth
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh

from ..scenes.viewpoints import look_at
from ..scenes.visibility import RayScene, count_views
from ..texturing_parts.photographed import spot
from ..texturing_parts.solid_texture import SolidTexture

SECONDS, FPS = 20, 15
PAUSE = (8.0, 10.0)
"""Seconds in which the camera stands still."""
BLURRED_SHARE = 1.0 / 3.0
BLUR_PX = (8.0, 24.0)
"""Length of the blur in a video 1920 pixels wide."""
DISTANCE, FOCAL_SHARE = 3.1, 1.0
ELEVATION_DEGREES, BOB_DEGREES, BOBS = 24.0, 14.0, 3
SHAKE_DEGREES, SHAKE_WAY = 0.5, 0.01
FLOOR_Z, WALL_RADIUS = -1.0, 5.0
FAR_SCALE = 0.3
"""Of the texture of floor and wall, which are farther away."""
LIGHT = np.array([0.45, -0.65, 0.62])
AMBIENT = 0.55
NOISE_LEVELS = 1.5
TRUTH_SAMPLES = 100_000
JPEG_QUALITY = 95
CRF = "18"
"""Quality of H.264, as of good phones."""
FOCAL_35MM = 36.0
CROP_MARGIN = 0.02
"""Around the cow, as a share of its diagonal: what is farther away is floor."""


@dataclass(frozen=True)
class Box:
    """The cow's box, as a crop volume."""

    low: np.ndarray
    high: np.ndarray

    def inside(self, points: np.ndarray) -> np.ndarray:
        """Return whether (n, 3) points are inside, (n,) bool."""
        return ((points >= self.low) & (points <= self.high)).all(1)


@dataclass(frozen=True)
class Walk:
    """The camera of each frame, and which frames are blurred or of the pause."""

    cameras: list[Camera]
    blurred: np.ndarray
    paused: np.ndarray
    """(n,) bool."""


class Studio:
    """The cow, its floor and its wall."""

    def __init__(self) -> None:
        self.mesh: SurfaceMesh = spot()
        self._rays = RayScene(self.mesh.vertices, self.mesh.faces)
        self._near, self._far = SolidTexture(1), SolidTexture(2)

    @property
    def diagonal(self) -> float:
        """Of the box around the cow."""
        return float(np.linalg.norm(np.ptp(self.mesh.vertices, axis=0)))

    def picture(self, camera: Camera) -> np.ndarray:
        """Return the picture without noise, (h, w, 3) float32."""
        small = camera.resized(camera.width // 2, camera.height // 2)
        behind = self._background(small, directions_of(small))
        behind = behind.reshape(small.height, small.width, 3).clip(0, 255).astype(np.uint8)
        size = (camera.width, camera.height)
        colors = np.asarray(
            Image.fromarray(behind).resize(size, Image.Resampling.BICUBIC), np.float32
        ).copy()
        box = self._shown(camera)
        directions = directions_of(camera).reshape(camera.height, camera.width, 3)[box]
        shape = directions.shape
        directions = directions.reshape(-1, 3)
        origins = np.broadcast_to(camera.center, directions.shape)
        distance, face = self._rays.first_hits(origins, directions)
        hit = face >= 0
        points = origins[hit] + directions[hit] * distance[hit, None]
        lit = (self._rays.normals[face[hit]] @ (LIGHT / np.linalg.norm(LIGHT))).clip(0.0)
        part = colors[box].reshape(-1, 3)
        part[hit] = self._near(points) * (AMBIENT + (1.0 - AMBIENT) * lit)[:, None]
        colors[box] = part.reshape(shape)
        return colors

    def truth(self, cameras: list[Camera]) -> Truth:
        """Return the true surface, and how many cameras see each of its samples."""
        vertices, faces = self.mesh.vertices, self.mesh.faces
        samples = sample_uniformly(vertices, faces, TRUTH_SAMPLES, seed=0)
        seen = count_views(self._rays, cameras, samples.points, samples.normals)
        margin = CROP_MARGIN * self.diagonal
        box = Box(vertices.min(0) - margin, vertices.max(0) + margin)
        return Truth(samples, vertices, faces, seen=seen, crop=box)

    def _shown(self, camera: Camera) -> tuple[slice, slice]:
        """Return the rows and columns in which the cow lies."""
        pixels, _ = camera.project(self.mesh.vertices)
        low, high = np.floor(pixels.min(0)).astype(int), np.ceil(pixels.max(0)).astype(int)
        low, high = np.maximum(low, 0), np.minimum(high, [camera.width, camera.height])
        return slice(low[1], high[1]), slice(low[0], high[0])

    def _background(self, camera: Camera, directions: np.ndarray) -> np.ndarray:
        center = camera.center
        with np.errstate(divide="ignore"):
            floor = (FLOOR_Z - center[2]) / directions[:, 2]
        floor[floor <= 0.0] = np.inf
        a = (directions[:, :2] ** 2).sum(1)
        b = directions[:, :2] @ center[:2]
        c = float(center[:2] @ center[:2]) - WALL_RADIUS**2
        wall = (-b + np.sqrt(b * b - a * c)) / a  # the camera is inside
        nearest = np.minimum(floor, wall)[:, None]
        return self._far((center + directions * nearest) * FAR_SCALE + [5.0, 3.0, 7.0])


def walk(width: int, height: int, *, seconds: int = SECONDS, fps: int = FPS) -> Walk:
    """Return the cameras of the video."""
    random = np.random.default_rng(0)
    count = seconds * fps
    times = np.arange(count) / fps
    share = seconds / SECONDS
    paused = (times > PAUSE[0] * share) & (times < PAUSE[1] * share)
    moved = np.cumsum(~paused) / (~paused).sum()  # (n,) 0 to 1
    shake = _smooth(random.normal(size=(count, 6)), max(1, fps // 8))
    for i in np.flatnonzero(paused):
        shake[i] = shake[i - 1]
    cameras = [
        _camera(f"frame-{i:06d}.jpg", width, height, 2.0 * np.pi * moved[i], shake[i])
        for i in range(count)
    ]
    blurred = np.zeros(count, bool)
    moving = np.flatnonzero(~paused)
    while blurred.sum() < round(BLURRED_SHARE * count):  # in bursts, as shakes come
        begin, length = int(random.choice(moving)), int(random.integers(1, 6))
        burst = moving[(moving >= begin) & (moving < begin + length)]
        blurred[burst[: round(BLURRED_SHARE * count) - int(blurred.sum())]] = True
    return Walk(cameras, blurred, paused)


def photo_cameras(count: int, width: int, height: int) -> list[Camera]:
    """Return the cameras of photos on the same way, without shake."""
    return [
        _camera(f"{i:03d}.jpg", width, height, 2.0 * np.pi * i / count, np.zeros(6))
        for i in range(count)
    ]


def frames(studio: Studio, way: Walk) -> Iterator[np.ndarray]:
    """Yield the frames of the video, (h, w, 3) uint8."""
    random = np.random.default_rng(1)
    clean = studio.picture(way.cameras[0])
    for i, camera in enumerate(way.cameras):
        if i and not way.paused[i]:
            clean = studio.picture(camera)
        shown = clean
        if way.blurred[i]:
            length = random.uniform(*BLUR_PX) * camera.width / 1920
            shown = blurred(clean, length, random.uniform(0.0, np.pi))
        yield with_noise(shown, random)


def blurred(picture: np.ndarray, length_px: float, angle: float) -> np.ndarray:
    """Return the mean of a picture moved along a line."""
    steps = np.linspace(-0.5, 0.5, max(2, round(length_px))) * length_px
    offsets = np.rint(np.outer(steps, [np.sin(angle), np.cos(angle)])).astype(int)
    margin = int(np.abs(offsets).max())
    padded = np.pad(picture, ((margin, margin), (margin, margin), (0, 0)), mode="edge")
    height, width = picture.shape[:2]
    total = np.zeros(picture.shape, np.float32)
    for y, x in offsets:
        total += padded[margin + y : margin + y + height, margin + x : margin + x + width]
    return total / len(offsets)


def with_noise(picture: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Return a picture as a sensor gives it, (h, w, 3) uint8."""
    noise = random.standard_normal(picture.shape, np.float32) * np.float32(NOISE_LEVELS)
    return np.rint((picture + noise).clip(0, 255)).astype(np.uint8)


def write_video(path: Path, pictures: Iterator[np.ndarray], *, fps: int = FPS) -> None:
    """Write frames as MP4 with H.264."""
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=fps, options={"crf": CRF, "preset": "fast"})
        stream.pix_fmt = "yuv420p"
        stream.thread_count = 1
        for i, picture in enumerate(pictures):
            if i == 0:
                stream.height, stream.width = picture.shape[:2]
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts, frame.time_base = i, Fraction(1, fps)
            for packet in stream.encode(frame):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)


def write_photos(studio: Studio, cameras: list[Camera], folder: Path) -> None:
    """Write photos as a camera does: JPEG with the focal length in EXIF."""
    folder.mkdir(parents=True)
    random = np.random.default_rng(2)
    for camera in cameras:
        exif = Image.Exif()
        exif.get_ifd(0x8769)[0xA405] = round(FOCAL_35MM * camera.fx / camera.width)
        photo = with_noise(studio.picture(camera), random)
        Image.fromarray(photo).save(folder / camera.name, quality=JPEG_QUALITY, exif=exif)


def directions_of(camera: Camera) -> np.ndarray:
    """Return the rays of all pixels, (h w, 3) float64."""
    y, x = np.mgrid[: camera.height, : camera.width]
    local = np.stack(
        [(x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy, np.ones(x.shape)], -1
    )
    return (local @ camera.rotation).reshape(-1, 3)


def _camera(name: str, width: int, height: int, angle: float, shake: np.ndarray) -> Camera:
    lift = np.radians(ELEVATION_DEGREES + BOB_DEGREES * np.sin(BOBS * angle))
    center = DISTANCE * np.array(
        [np.cos(lift) * np.sin(angle), -np.cos(lift) * np.cos(angle), np.sin(lift)]
    )
    turn = np.radians(SHAKE_DEGREES) * DISTANCE
    target = np.array([0.03, 0.0, -0.05]) + turn * shake[3:]
    pose = look_at(center + SHAKE_WAY * shake[:3], target, SHAKE_DEGREES * float(shake[3]))
    focal = FOCAL_SHARE * width
    return Camera(name, width, height, focal, focal, width / 2, height / 2, pose)


def _smooth(values: np.ndarray, width: int) -> np.ndarray:
    """Return noise of deviation 1 that changes over ``width`` steps."""
    kernel = np.hanning(2 * width + 3)
    kernel /= np.sqrt((kernel**2).sum())
    return np.stack([np.convolve(column, kernel, "same") for column in values.T], 1)
