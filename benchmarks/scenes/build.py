# SPDX-License-Identifier: GPL-3.0-or-later
"""Build the folder of a scene: cameras, sparse points, truth, and the scenes of one thing."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from gaussian_wrapping_addon.core.files import write_json
from gaussian_wrapping_addon.core.regions.scene_regions import write_region
from gaussian_wrapping_addon.core.regions.shapes import Region
from gaussian_wrapping_addon.core.scene.camera import Camera, Similarity

from .catalogue import THIN_SHARE, SceneContent, SceneKind, scene_content, scene_kind
from .geometry import (
    PRINCIPAL_POINT,
    START_SHARE,
    Part,
    RayScene,
    around_thing,
    box,
    count_views,
    joined,
    look_at,
)
from .rendering import draw_gains, expose, render_photos, require_bpy


def write_colmap(folder: Path, cameras: Sequence[Camera], sparse: SparsePoints) -> None:
    """Write ``cameras.txt``, ``images.txt`` and ``points3D.txt``; numbers with full precision.

    All cameras must share one lens. Ids start at 1, as COLMAP's do.
    """
    folder.mkdir(parents=True, exist_ok=True)
    c = cameras[0]
    lens = f"{c.fx!r} {c.fy!r} {c.cx!r} {c.cy!r}"
    (folder / "cameras.txt").write_text(
        "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        f"1 PINHOLE {c.width} {c.height} {lens}\n"
    )  # fmt: skip
    place = np.zeros(len(sparse.point_ids), np.int64)  # index among the image's observations
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# X, Y, POINT3D_ID ..."]
    for index, camera in enumerate(cameras):
        x, y, z, w = Rotation.from_matrix(camera.rotation).as_quat(canonical=True).tolist()
        pose = [w, x, y, z, *camera.cam_from_world[:, 3].tolist()]
        lines.append(f"{index + 1} {' '.join(map(repr, pose))} 1 {camera.name}")
        mine = np.flatnonzero(sparse.camera_ids == index)
        place[mine] = np.arange(len(mine))
        lines.append(
            " ".join(
                f"{u:.4f} {v:.4f} {point + 1}"
                for (u, v), point in zip(
                    sparse.pixels[mine].tolist(), sparse.point_ids[mine].tolist(), strict=True
                )
            )
        )
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    lines = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    ends = np.searchsorted(sparse.point_ids, np.arange(len(sparse.points) + 1))
    for index in range(len(sparse.points)):
        begin, end = ends[index], ends[index + 1]
        track = " ".join(
            f"{camera + 1} {at}"
            for camera, at in zip(
                sparse.camera_ids[begin:end].tolist(), place[begin:end].tolist(), strict=True
            )
        )
        position = " ".join(map(repr, sparse.points[index].tolist()))
        color = " ".join(map(str, sparse.colors[index].tolist()))
        lines.append(f"{index + 1} {position} {color} {sparse.errors_px[index]:.4f} {track}")
    (folder / "points3D.txt").write_text("\n".join(lines) + "\n")


NOISE_PX = 0.5
"""Standard deviation of an observation, per axis."""

SHARED_COSINE = np.cos(np.radians(35.0))
"""A keypoint is found again by cameras that see it from within this angle only."""

FOUND_SHARE = 0.75
"""Of the cameras that could find a keypoint again, this share does."""

MIN_TRACK = 3


@dataclass(frozen=True)
class SparsePoints:
    """Points with colours and tracks."""

    points: np.ndarray
    """(n, 3) float64."""
    colors: np.ndarray
    """(n, 3) uint8."""
    errors_px: np.ndarray
    """(n,) mean reprojection error."""
    point_ids: np.ndarray
    """(o,) int64 point of each observation, sorted."""
    camera_ids: np.ndarray
    """(o,) int64 camera of each observation."""
    pixels: np.ndarray
    """(o, 2) float64 position of each observation."""


def _keypoints(photo: np.ndarray, count: int, random: np.random.Generator) -> np.ndarray:
    """Return (n, 2) distinct pixels, mostly where the photo has structure."""
    gray = photo.astype(np.float64).mean(2)
    # Averaged over 3 x 3 pixels first, so that the grain of the photo is no structure.
    padded = np.pad(gray, 1, mode="edge")
    h, w = gray.shape
    gray = sum(padded[i : i + h, j : j + w] for i in range(3) for j in range(3)) / 9.0
    dy, dx = np.gradient(gray)
    weight = (dx**2 + dy**2 + 0.02).reshape(-1) ** 0.5
    border = np.zeros(gray.shape, bool)
    border[2:-2, 2:-2] = True
    weight *= border.reshape(-1)
    chosen = random.choice(weight.size, min(count, int(border.sum())), False, weight / weight.sum())
    return np.stack([chosen % w, chosen // w], 1)


def sparse_points(
    rays: RayScene,
    cameras: Sequence[Camera],
    photos: Sequence[np.ndarray],
    seed: int,
    count: int = 3000,
) -> SparsePoints:
    """Find keypoints in the photos, follow them through the cameras, and triangulate.

    Observations have Gaussian noise; the points are one Gauss-Newton step from the truth to the
    smallest reprojection error, so their noise is that of a bundle adjustment with known cameras.

    Parameters
    ----------
    photos : sequence of (h, w, 3) uint8
    """
    random = np.random.default_rng([seed, 2])
    points, normals, colors, origin = _candidates(rays, cameras, photos, count, random)
    found = np.zeros((len(points), len(cameras)), bool)
    towards = np.array([camera.center for camera in cameras])[origin] - points
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    for index, camera in enumerate(cameras):
        way = camera.center - points
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        near = np.einsum("ij,ij->i", way, towards) > SHARED_COSINE
        lucky = random.random(len(points)) < FOUND_SHARE
        found[:, index] = rays.sees(camera, points, normals) & near & (lucky | (origin == index))
    kept = np.flatnonzero(found.sum(1) >= MIN_TRACK)
    kept = np.sort(random.permutation(kept)[:count])
    points, colors, found = points[kept], colors[kept], found[kept]
    point_ids, camera_ids = np.nonzero(found)
    noise = random.normal(size=(len(point_ids), 2)) * NOISE_PX
    return _triangulated(points, colors, point_ids, camera_ids, noise, cameras)


def _candidates(
    rays: RayScene,
    cameras: Sequence[Camera],
    photos: Sequence[np.ndarray],
    count: int,
    random: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return surface points, normals, colours and the camera of keypoints of every photo."""
    each = 2 * count // len(cameras) + 1
    rows = []
    for index, (camera, photo) in enumerate(zip(cameras, photos, strict=True)):
        pixels = _keypoints(photo, each, random)
        directions = camera.rays_at(pixels + 0.5) @ camera.rotation
        origins = np.broadcast_to(camera.center, directions.shape)
        distance, face = rays.first_hits(origins, directions)
        hit = np.isfinite(distance)
        points = origins[hit] + distance[hit, None] * directions[hit]
        normals = rays.normals[face[hit]]
        facing = np.einsum("ij,ij->i", normals, directions[hit]) < 0
        normals = np.where(facing[:, None], normals, -normals)
        colors = photo[pixels[hit, 1], pixels[hit, 0]]
        rows.append((points, normals, colors, np.full(len(points), index)))
    return tuple(np.concatenate(column) for column in zip(*rows, strict=True))  # type: ignore[return-value]


def _triangulated(
    points: np.ndarray,
    colors: np.ndarray,
    point_ids: np.ndarray,
    camera_ids: np.ndarray,
    noise: np.ndarray,
    cameras: Sequence[Camera],
) -> SparsePoints:
    exact = np.empty((len(point_ids), 2))
    slope = np.empty((len(point_ids), 2, 3))
    for index, camera in enumerate(cameras):
        mine = camera_ids == index
        local = camera.to_camera(points[point_ids[mine]])
        exact[mine] = camera.project(points[point_ids[mine]])[0]
        x, y, z = local.T
        zero = np.zeros_like(z)
        inner = np.stack(
            [np.stack([camera.fx / z, zero, -camera.fx * x / z**2], 1),
             np.stack([zero, camera.fy / z, -camera.fy * y / z**2], 1)], 1
        )  # fmt: skip
        slope[mine] = inner @ camera.rotation
    normal = np.zeros((len(points), 3, 3))
    right = np.zeros((len(points), 3))
    np.add.at(normal, point_ids, np.einsum("oki,okj->oij", slope, slope))
    np.add.at(right, point_ids, np.einsum("oki,ok->oi", slope, noise))
    moved = np.linalg.solve(normal, right[..., None])[..., 0]
    residual = np.linalg.norm(noise - np.einsum("oki,oi->ok", slope, moved[point_ids]), axis=1)
    length = np.bincount(point_ids, minlength=len(points))
    errors = np.bincount(point_ids, residual, len(points)) / np.maximum(length, 1)
    return SparsePoints(points + moved, colors, errors, point_ids, camera_ids, exact + noise)


SAMPLES = 200_000


@dataclass(frozen=True)
class TruthSamples:
    """Samples of the true surface inside of the crop, uniform by area."""

    points: np.ndarray
    """(n, 3) float64."""
    normals: np.ndarray
    """(n, 3) float64, unit, of the face that the sample lies on, outward."""
    thin: np.ndarray
    """(n,) bool: the solid below the sample is thinner than the scene's bound."""
    seen: np.ndarray
    """(n,) int32: number of cameras that see it."""


def sample_surface(
    vertices: np.ndarray, faces: np.ndarray, crop: Region, count: int, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return about ``count`` points (n, 3) and unit normals (n, 3), uniform by area in the crop.

    Stratified along the list of faces: every face gets its share of samples, to within one.
    """
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    area = np.linalg.norm(cross, axis=1) / 2  # (f,)
    # Faces outside of the crop take samples too: draw so many that the wanted number remains.
    trial = _draw(a, b, c, area, 20_000, random)[0]
    share = float(crop.contains(trial).mean())
    points, owner = _draw(a, b, c, area, int(np.ceil(count / max(share, 1e-3))), random)
    kept = crop.contains(points)
    normals = cross / np.maximum(2 * area, 1e-300)[:, None]
    return points[kept], normals[owner[kept]]


def _draw(
    a: np.ndarray,
    b: np.ndarray,
    c: np.ndarray,
    area: np.ndarray,
    count: int,
    random: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    place = (np.arange(count) + random.random(count)) / count * area.sum()
    owner = np.minimum(np.searchsorted(np.cumsum(area), place, side="right"), len(area) - 1)
    u, v = np.sqrt(random.random(count)), random.random(count)
    weights = np.stack([1 - u, u * (1 - v), u * v], 1)  # (n, 3) barycentric
    corners = np.stack([a[owner], b[owner], c[owner]], 1)  # (n, 3, 3)
    return np.einsum("nk,nkd->nd", weights, corners), owner


def inward_thickness(
    vertices: np.ndarray, faces: np.ndarray, points: np.ndarray, normals: np.ndarray
) -> np.ndarray:
    """Return the way from each sample straight into the solid to its other side, (n,)."""
    rays = RayScene(vertices, faces)
    start = START_SHARE * rays.diagonal
    distance, _ = rays.first_hits(points - start * normals, -normals)
    return distance + start


def truth_samples(
    truth: tuple[np.ndarray, np.ndarray],
    everything: tuple[np.ndarray, np.ndarray],
    cameras: Sequence[Camera],
    crop: Region,
    thin_below: float,
    seed: int,
    count: int = SAMPLES,
) -> TruthSamples:
    """Sample the true surface and label the samples.

    Parameters
    ----------
    truth, everything : (vertices, faces)
        The true surface; all geometry of the scene, which hides things from cameras.
    thin_below : float
        Inward thickness under which a sample is thin, units of the world.
    """
    points, normals = sample_surface(*truth, crop, count, np.random.default_rng([seed, 1]))
    seen = count_views(RayScene(*everything), cameras, points, normals)
    thin = inward_thickness(*truth, points, normals) < thin_below
    return TruthSamples(points, normals, thin, seen)


FAR_FROM_NEAR = Similarity(20.0, np.eye(3), np.array([5e5, 4e6, 100.0]))
"""Where the far scene stands: like a drone's photos in map coordinates."""


@dataclass(frozen=True)
class BuildSize:
    """How much of a scene is made."""

    photos: int = 40
    test_views: int = 8
    width: int = 640
    height: int = 480
    truth_samples: int = SAMPLES


def build_scene(kind: SceneKind, size: BuildSize, folder: Path, base: Path | None) -> None:
    """Make the scene in an empty folder.

    Parameters
    ----------
    base : Path or None
        Finished folder of ``kind.derived_from``, of the same size; None where it has none.

    Raises
    ------
    ResourceError
        bpy, trimesh or embreex is missing.
    """
    source = scene_kind(kind.derived_from) if kind.derived_from else kind
    content = scene_content(source, size.photos, size.test_views, (size.width, size.height))
    images, tests = folder / "images", folder / "test" / "images"
    images.mkdir(parents=True)
    tests.mkdir(parents=True)
    facts: dict[str, object] = {}
    if base is None:
        cameras = [*content.cameras, *content.test_cameras]
        paths = [images / c.name for c in content.cameras]
        paths += [tests / c.name for c in content.test_cameras]
        glossy = int(kind.name == "glossy")
        render_photos(
            content.parts, cameras, paths, content.light, samples=kind.samples,
            glossy_bounces=glossy,
            wall_shadows=kind.name == "room",
            wall_density=(220.0 if kind.name == "room" else 140.0) * size.width / 640,
        )  # fmt: skip
        facts["bpy"] = require_bpy().app.version_string
    else:
        shutil.copytree(base / "images", images, dirs_exist_ok=True)
        shutil.copytree(base / "test" / "images", tests, dirs_exist_ok=True)
        facts["photos_from"] = source.name
    if kind.exposure:
        gains = draw_gains(size.photos, kind.seed)
        facts["gains"] = {c.name: g.tolist() for c, g in zip(content.cameras, gains, strict=True)}
        for camera, gain in zip(content.cameras, gains, strict=True):
            path = images / camera.name
            Image.fromarray(expose(_read(path), gain)).save(path)
    place = FAR_FROM_NEAR if kind.far else Similarity()
    if kind.far:
        facts["world_from_base"] = place.to_json()
    _write_data(kind, source.seed, content, size, place, facts, folder)


def _read(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


def _write_data(
    kind: SceneKind,
    seed: int,
    content: SceneContent,
    size: BuildSize,
    place: Similarity,
    facts: dict[str, object],
    folder: Path,
) -> None:
    """Write everything but the photos; rays are cast in the base's frame, near the origin."""
    everything = joined(content.parts)
    photos = [_read(folder / "images" / camera.name) for camera in content.cameras]
    sparse = sparse_points(RayScene(*everything), content.cameras, photos, seed)
    sparse = replace(sparse, points=place.points(sparse.points))
    write_colmap(folder / "sparse" / "0", _moved(content.cameras, place), sparse)
    test_cameras = [camera.to_json() for camera in _moved(content.test_cameras, place)]
    write_json(folder / "test" / "cameras.json", {"cameras": test_cameras})
    thin_below = THIN_SHARE * content.crop.diagonal
    samples = truth_samples(
        content.truth, everything, content.cameras, content.crop, thin_below, seed,
        size.truth_samples,
    )  # fmt: skip
    np.savez_compressed(
        folder / "truth.npz",
        vertices=place.points(content.truth[0]),
        faces=content.truth[1],
        points=place.points(samples.points),
        normals=place.directions(samples.normals),
        thin=samples.thin,
        seen=samples.seen,
    )
    write_region(folder / "region.json", content.region.transformed(place))
    write_region(folder / "crop.json", content.crop.transformed(place))
    write_json(
        folder / "scene.json",
        {
            "version": 1,
            "name": kind.name,
            "role": kind.role,
            "description": kind.description,
            "diagonal": content.crop.diagonal * place.scale,
            "thin_below": thin_below * place.scale,
            "seed": kind.seed,
            "photos": size.photos,
            "photo_size": [size.width, size.height],
            "samples_per_pixel": kind.samples,
            **facts,
        },
    )


def _moved(cameras: Sequence[Camera], place: Similarity) -> list[Camera]:
    return [camera.moved(place) for camera in cameras]


WALL_DENSITY_AT_640 = 140.0
"""Detail of the studio's walls, as of all single things."""


def build_matte_thing(
    kind: SceneKind, content: SceneContent, size: BuildSize, folder: Path
) -> None:
    """Make the scene in an empty folder, as :func:`build_scene` makes the others.

    Raises
    ------
    ResourceError
        bpy, trimesh or embreex is missing.
    """
    images, tests = folder / "images", folder / "test" / "images"
    images.mkdir(parents=True)
    tests.mkdir(parents=True)
    paths = [images / camera.name for camera in content.cameras]
    paths += [tests / camera.name for camera in content.test_cameras]
    render_photos(
        content.parts, [*content.cameras, *content.test_cameras], paths, content.light,
        samples=kind.samples, glossy_bounces=0, wall_shadows=False,
        wall_density=WALL_DENSITY_AT_640 * size.width / 640,
    )  # fmt: skip
    facts: dict[str, object] = {"bpy": require_bpy().app.version_string}
    _write_data(kind, kind.seed, content, size, Similarity(), facts, folder)


CUP_INSIDE = SceneKind(
    "cup_inside", "test", "The cup; a quarter of its photos look steeply into it.", 109
)

STEEP_SHARE = 0.25
"""Of the photos, and of the test views."""

STEEP_DEGREES = (55.0, 70.0)
"""Elevations between which the steep photos are taken, evenly."""

STEEP_FOCAL_SHARE = 0.92
"""Of the width, as that of the rings."""


def cup_inside_content(photos: int, tests: int, size: tuple[int, int]) -> SceneContent:
    """Return the cup's geometry, light and volumes with cameras around and above it."""
    cup = scene_content(scene_kind("cup"), photos, tests, size)
    random = np.random.default_rng(CUP_INSIDE.seed)
    return replace(
        cup,
        cameras=_cameras(photos, size, random, "photo"),
        test_cameras=_cameras(tests, size, random, "test"),
    )


def _cameras(
    count: int, size: tuple[int, int], random: np.random.Generator, prefix: str
) -> tuple[Camera, ...]:
    """Return the rings, then one steep ring; test views stand between the photos of that ring."""
    steep = round(STEEP_SHARE * count)
    distance = CUP_INSIDE.distance
    cameras = around_thing(count - steep, *size, distance, random, prefix)
    width, height = size
    focal = STEEP_FOCAL_SHARE * width
    cx, cy = PRINCIPAL_POINT[0] * width, PRINCIPAL_POINT[1] * height
    phase = 0.5 if prefix == "test" else 0.0
    low, high = STEEP_DEGREES
    for k in range(steep):
        angle = 2 * np.pi * (k + phase + random.uniform(-0.15, 0.15)) / steep
        # Neighbours alternate between both ends, so that no side is seen from one height only.
        lift = low + (high - low) * ((2 * k) % steep + 0.5) / steep
        lift = np.radians(lift + random.uniform(-3, 3))
        direction = np.array(
            [np.cos(lift) * np.cos(angle), np.cos(lift) * np.sin(angle), np.sin(lift)]
        )
        center = direction * distance * random.uniform(0.93, 1.08)
        target = random.normal(size=3) * 0.04 * distance / 2.5
        pose = look_at(center, target, random.uniform(-3, 3))
        name = f"{prefix}_{len(cameras):03d}.png"
        cameras.append(Camera(name, width, height, focal, focal, cx, cy, pose))
    return tuple(cameras)


def build_cup_inside(size: BuildSize, folder: Path) -> None:
    """Make the scene in an empty folder, as :func:`build_scene` makes the others.

    Raises
    ------
    ResourceError
        bpy, trimesh or embreex is missing.
    """
    content = cup_inside_content(size.photos, size.test_views, (size.width, size.height))
    build_matte_thing(CUP_INSIDE, content, size, folder)


TORUS = SceneKind("torus", "test", "A torus and a thin plate beside it, matte.", 110, distance=2.6)

RING_RADIUS, TUBE_RADIUS = 0.40, 0.15
"""Of the torus, whose axis is horizontal."""
RING_STEPS, TUBE_STEPS = 192, 72

PLATE_WIDTH, PLATE_HEIGHT, PLATE_SHARE = 0.8, 1.0, 0.005
"""The plate's thickness is this share of the region's diagonal."""

PLATE_TURN_DEGREES = 15.0

MIDDLE_X = 0.55
"""Of the plate, and of the torus on the other side."""
MARGIN = 0.1
"""Of the region around both; the crop's margin is three fifths of it."""


def torus(ring_radius: float, tube_radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a closed torus around the y axis: vertices (v, 3), faces (f, 3)."""
    around, across = np.meshgrid(
        2 * np.pi * np.arange(RING_STEPS) / RING_STEPS,
        2 * np.pi * np.arange(TUBE_STEPS) / TUBE_STEPS,
        indexing="ij",
    )
    radius = ring_radius + tube_radius * np.cos(across)
    vertices = np.stack(
        [radius * np.cos(around), tube_radius * np.sin(across), radius * np.sin(around)], -1
    ).reshape(-1, 3)
    ids = np.arange(len(vertices)).reshape(RING_STEPS, TUBE_STEPS)
    a, b = ids, np.roll(ids, -1, 0)
    c, d = np.roll(b, -1, 1), np.roll(a, -1, 1)
    faces = np.concatenate(
        [np.stack([a, d, c], -1).reshape(-1, 3), np.stack([a, c, b], -1).reshape(-1, 3)]
    )
    return vertices, faces.astype(np.int32)


def torus_content(photos: int, tests: int, size: tuple[int, int]) -> SceneContent:
    """Return both things in the studio of the cup, with cameras around them."""
    studio = scene_content(scene_kind("cup"), photos, tests, size)
    random = np.random.default_rng(TORUS.seed)
    vertices, faces = torus(RING_RADIUS, TUBE_RADIUS)
    ring = Part("torus", vertices - (MIDDLE_X, 0.0, 0.0), faces, "painted_metal")
    middle = np.array([MIDDLE_X, 0.0, 0.0])
    sides = np.array([PLATE_WIDTH, 0.0, PLATE_HEIGHT])
    low = np.minimum(ring.vertices.min(0), middle - sides / 2) - MARGIN
    high = np.maximum(ring.vertices.max(0), middle + sides / 2) + MARGIN
    sides[1] = PLATE_SHARE * np.linalg.norm(high - low)
    plate = box(
        "plate", middle - sides / 2, middle + sides / 2, "painted_metal", PLATE_TURN_DEGREES
    )
    things = [ring, plate]
    return replace(
        studio,
        parts=(*things, *(part for part in studio.parts if part.surrounding)),
        truth=joined(things),
        region=Region.box("region", low, high),
        crop=Region.box("crop", low + 0.4 * MARGIN, high - 0.4 * MARGIN),
        cameras=tuple(around_thing(photos, *size, TORUS.distance, random, "photo")),
        test_cameras=tuple(around_thing(tests, *size, TORUS.distance, random, "test")),
    )


def build_torus(size: BuildSize, folder: Path) -> None:
    """Make the scene in an empty folder.

    Raises
    ------
    ResourceError
        bpy, trimesh or embreex is missing.
    """
    content = torus_content(size.photos, size.test_views, (size.width, size.height))
    build_matte_thing(TORUS, content, size, folder)
