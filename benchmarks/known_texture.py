# SPDX-License-Identifier: GPL-3.0-or-later
"""A known texture on a known mesh: photos of it by rays, and what a bake of them is worth."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import map_coordinates

from gaussian_wrapping_addon.core.mesh.components import face_graph
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.mesh.textured_mesh import TexturedMesh
from gaussian_wrapping_addon.core.scene.camera import Camera, Similarity
from gaussian_wrapping_addon.core.scene.scene import Scene, View
from gaussian_wrapping_addon.core.texture.atlas import raster_atlas

from .scenes.geometry import RayScene, around_thing, read_obj, scaled_to

VOLUME_SIDE = 64
"""Cells of the periodic volume; its octaves repeat it at finer scales."""
OCTAVES = ((1.0, 24.0), (4.3, 10.0), (17.1, 5.0))
"""Scale and standard deviation: amplitudes fall about as one over the frequency."""
PERIOD = 2.0
"""Side of the volume at the first octave, scene units."""
CHECKER_SIDE = 0.16
CHECKER_CONTRAST = 30.0
MIDDLE = 128.0


class SolidTexture:
    """Colours in [0, 255] as a function of the position, so that a surface needs no UVs.

    Slices of a volume whose power falls with the third power of the frequency have the spectrum
    of photographs (one over the square).
    """

    def __init__(self, seed: int = 0) -> None:
        random = np.random.default_rng(seed)
        self._volumes = [_volume(random) for _ in range(3)]

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Return (n, 3) float64 colours of (n, 3) points."""
        checker = np.floor(points / CHECKER_SIDE + 0.31).astype(np.int64).sum(axis=1) & 1
        out = np.empty((len(points), 3))
        for channel, volume in enumerate(self._volumes):
            value = MIDDLE + CHECKER_CONTRAST * (2.0 * checker - 1.0)
            for scale, deviation in OCTAVES:
                places = (points * (scale * VOLUME_SIDE / PERIOD)).T
                value += deviation * map_coordinates(volume, places, order=1, mode="grid-wrap")
            out[:, channel] = value
        return out.clip(0.0, 255.0)


def _volume(random: np.random.Generator) -> np.ndarray:
    """Return a periodic (n, n, n) float32 volume of standard deviation 1."""
    frequency = np.fft.fftfreq(VOLUME_SIDE)
    radius2 = frequency[:, None, None] ** 2 + frequency[:, None] ** 2 + frequency[:VOLUME_SIDE] ** 2
    radius2[0, 0, 0] = np.inf
    noise = np.fft.fftn(random.normal(size=(VOLUME_SIDE,) * 3)) * radius2**-0.75
    volume = np.fft.ifftn(noise).real
    return (volume / volume.std()).astype(np.float32)


MESHES = Path(__file__).resolve().parent / "meshes"
DIAGONAL = 2.0
DISTANCE = 2.1
BACKGROUND = (40.0, 90.0, 60.0)
RAYS_AT_ONCE = 400_000

Pattern = Callable[[np.ndarray], np.ndarray]
Unevenness = Callable[[int, np.ndarray], np.ndarray]
"""Factor of a photo's brightness at (n, 2) positions in [0, 1], by the photo's number."""


@dataclasses.dataclass
class RenderedPhotos:
    """The methods of ``PhotoStore`` on images in memory."""

    cameras: list[Camera]
    images: list[np.ndarray]

    def camera(self, index: int, divisor: int = 1) -> Camera:
        """Camera of the photo reduced by whole blocks."""
        base = self.cameras[index]
        return dataclasses.replace(
            base,
            width=base.width // divisor,
            height=base.height // divisor,
            fx=base.fx / divisor,
            fy=base.fy / divisor,
            cx=base.cx / divisor,
            cy=base.cy / divisor,
        )

    def photo(self, index: int, divisor: int = 1) -> np.ndarray:
        """(h, w, 3) uint8, means of blocks."""
        image = self.images[index]
        height, width = image.shape[0] // divisor, image.shape[1] // divisor
        cut = image[: height * divisor, : width * divisor]
        blocks = cut.reshape(height, divisor, width, divisor, 3)
        return np.rint(blocks.mean(axis=(1, 3))).astype(np.uint8)

    def mask(self, index: int, divisor: int = 1) -> None:
        """No masks."""
        return

    def scene(self) -> Scene:
        """Return a scene of these views without sparse points."""
        views = tuple(View(camera, Path("unused.png")) for camera in self.cameras)
        nothing = np.zeros((0, 3))
        return Scene(views, nothing, nothing.astype(np.uint8), Similarity())


def spot() -> SurfaceMesh:
    """Return the cow, z up, of diagonal 2 around 0."""
    vertices, faces, _ = read_obj(MESHES / "spot.obj")
    upright = vertices @ np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    return SurfaceMesh(scaled_to(upright, DIAGONAL), faces)


def cameras_around(count: int, width: int, height: int, seed: int = 0) -> list[Camera]:
    """Return cameras on rings around 0."""
    random = np.random.default_rng(seed)
    return around_thing(count, width, height, DISTANCE, random, "photo")


def uneven(index: int, places: np.ndarray) -> np.ndarray:
    """Return the brightness of one photo: dark corners, and a gradient of 6 to 10 % either way."""
    random = np.random.default_rng(1000 + index)
    direction = random.normal(size=2)
    direction *= random.uniform(0.12, 0.2) / np.linalg.norm(direction)
    offset = places - 0.5
    return (1.0 + offset @ direction) * (1.0 - 0.5 * (offset**2).sum(axis=1))


def photograph(
    mesh: SurfaceMesh,
    pattern: Pattern,
    cameras: list[Camera],
    supersampling: int,
    unevenness: Unevenness | None = None,
) -> RenderedPhotos:
    """Render the mesh unlit: each pixel the mean of ``supersampling``^2 rays."""
    rays = RayScene(mesh.vertices, mesh.faces)
    images = []
    for index, camera in enumerate(cameras):
        image = _render(rays, pattern, camera, supersampling)
        if unevenness is not None:
            rows, columns = np.mgrid[: camera.height, : camera.width]
            places = np.stack([columns + 0.5, rows + 0.5], -1).reshape(-1, 2)
            places /= [camera.width, camera.height]
            image *= unevenness(index, places).reshape(camera.height, camera.width, 1)
        images.append(np.rint(image.clip(0, 255)).astype(np.uint8))
    return RenderedPhotos(cameras, images)


def _render(rays: RayScene, pattern: Pattern, camera: Camera, supersampling: int) -> np.ndarray:
    fine = camera.resized(camera.width * supersampling, camera.height * supersampling)
    rows = max(1, RAYS_AT_ONCE // fine.width // supersampling) * supersampling
    parts = []
    for begin in range(0, fine.height, rows):
        end = min(begin + rows, fine.height)
        y, x = np.mgrid[begin:end, : fine.width]
        local = np.stack(
            [(x + 0.5 - fine.cx) / fine.fx, (y + 0.5 - fine.cy) / fine.fy, np.ones(x.shape)], -1
        )
        directions = (local @ fine.rotation).reshape(-1, 3)
        origins = np.broadcast_to(fine.center, directions.shape)
        distance, face = rays.first_hits(origins, directions)
        hit = face >= 0
        colors = np.broadcast_to(np.array(BACKGROUND), directions.shape).copy()
        colors[hit] = pattern(fine.center + directions[hit] * distance[hit, None])
        blocks = colors.reshape(-1, supersampling, camera.width, supersampling, 3)
        parts.append(blocks.mean(axis=(1, 3)))
    return np.concatenate(parts)


SUBTEXELS = 4
"""Samples of the true texture along each side of a texel."""
EDGE_SAMPLES = 4
TEXELS_APART = 0.5
"""Distance from an edge to the samples on both of its sides."""


@dataclass(frozen=True)
class Seams:
    """Differences between the two sides of edges, at one distance, levels of 255."""

    across: float
    """Mean over edges between charts."""
    inside: float
    """Mean over edges inside of charts."""
    across_true: float
    """The same of the true texture."""
    inside_true: float
    gap: float
    """Mean difference of the two look-ups at the border itself, where one colour is right."""
    error_inside: float
    """Mean error of look-ups on edges inside of charts."""
    error_across: float
    """Mean error of look-ups on edges between charts."""


def true_albedo(
    textured: TexturedMesh, pattern: Pattern, subtexels: int = SUBTEXELS
) -> tuple[np.ndarray, np.ndarray]:
    """Return the true texture, means over texels (h, w, 3), and where it is known (h, w)."""
    size = len(textured.albedo)
    fine = raster_atlas(textured.corner_uvs, size * subtexels, 2)
    inside = fine.inside
    points = _positions(textured.mesh, fine.face[inside], fine.bary[inside])
    rows, columns = np.nonzero(inside)
    texel = (rows // subtexels) * size + columns // subtexels
    count = np.bincount(texel, minlength=size * size)
    colors = pattern(points)
    mean = np.stack([np.bincount(texel, colors[:, k], size * size) for k in range(3)], -1)
    mean /= np.maximum(count, 1)[:, None]
    # Texels at chart borders are judged where their centre is inside.
    centre = raster_atlas(textured.corner_uvs, size, 2).inside
    return mean.reshape(size, size, 3), centre & (count.reshape(size, size) > 0)


def psnr(error: np.ndarray) -> float:
    """Return the peak signal-to-noise ratio of differences of 8-bit colours, dB."""
    return float(10.0 * np.log10(255.0**2 / max(float((error**2).mean()), 1e-12)))


def photos_that_see(
    textured: TexturedMesh, cameras: list[Camera], texels: np.ndarray
) -> np.ndarray:
    """Count by rays the photos that see each of the texels (flat places)."""
    mesh = textured.mesh
    raster = raster_atlas(textured.corner_uvs, len(textured.albedo), 2)
    face = raster.face.ravel()[texels]
    points = _positions(mesh, face, raster.bary.reshape(-1, 2)[texels])
    normals = face_graph(mesh.vertices, mesh.faces).normals[face]
    rays = RayScene(mesh.vertices, mesh.faces)
    return sum(rays.sees(camera, points, normals).astype(int) for camera in cameras)


def steps_between_texels(textured: TexturedMesh, texels_apart: int) -> float:
    """Return the difference that one in a thousand pairs of texels so far apart exceeds.

    Of texels into which two photos or more were blended: what one photo alone shows cannot be
    evened with anything. Of a thing of one colour that photos show in different brightness, this is
    how visible the borders are where the leading view changes.
    """
    return float(np.percentile(all_steps(textured, texels_apart), 99.9))


def all_steps(textured: TexturedMesh, texels_apart: int) -> np.ndarray:
    """Return the grey differences of all pairs of such texels so far apart."""
    size = len(textured.albedo)
    assert textured.views is not None
    good = raster_atlas(textured.corner_uvs, size, 2).inside & (textured.views >= 2)
    grey = textured.albedo.astype(np.float64).mean(axis=2)
    steps = []
    for image, usable in ((grey, good), (grey.T, good.T)):
        step = image[texels_apart:] - image[:-texels_apart]
        steps.append(step[usable[texels_apart:] & usable[:-texels_apart]])
    return np.abs(np.concatenate(steps))


def look_up(image: np.ndarray, uvs: np.ndarray) -> np.ndarray:
    """Bilinear look-up of (n, 2) UVs, v upwards, as renderers do it."""
    size = len(image)
    x = (uvs[:, 0] * size - 0.5).clip(0, size - 1)
    y = ((1.0 - uvs[:, 1]) * size - 0.5).clip(0, size - 1)
    ix, iy = x.astype(int), y.astype(int)
    jx, jy = np.minimum(ix + 1, size - 1), np.minimum(iy + 1, size - 1)
    tx, ty = (x - ix)[:, None], (y - iy)[:, None]
    pixels = image.astype(np.float64)
    upper = pixels[iy, ix] * (1 - tx) + pixels[iy, jx] * tx
    lower = pixels[jy, ix] * (1 - tx) + pixels[jy, jx] * tx
    return upper * (1 - ty) + lower * ty


def seams(textured: TexturedMesh, pattern: Pattern, seen: np.ndarray) -> Seams:
    """Compare the jump over edges between charts with the jump over edges inside of charts.

    Parameters
    ----------
    seen : (f,) bool
        Faces to judge at.
    """
    mesh, uvs = textured.mesh, textured.corner_uvs.astype(np.float64)
    graph = face_graph(mesh.vertices, mesh.faces)
    face, corner = np.nonzero(graph.opposite >= 0)
    half = 3 * face + corner
    other = graph.opposite[face, corner]
    once = (half < other) & seen[face] & seen[other // 3]
    half, other = half[once], other[once]
    uv_area = np.abs(_cross(uvs[:, 1] - uvs[:, 0], uvs[:, 2] - uvs[:, 0])).sum() / 2
    texel = np.sqrt(graph.areas.sum() / uv_area) / len(textured.albedo)
    here, there = [], []
    steps = (np.arange(EDGE_SAMPLES) + 0.5) / EDGE_SAMPLES
    for t in steps.tolist():
        here.append(_beside(mesh, half, t, TEXELS_APART * texel))
        there.append(_beside(mesh, other, 1.0 - t, TEXELS_APART * texel))
    a, b = np.concatenate(here), np.concatenate(there)
    half, other = np.tile(half, EDGE_SAMPLES), np.tile(other, EDGE_SAMPLES)
    good = (a > 0).all(1) & (b > 0).all(1)
    half, other, a, b = half[good], other[good], a[good], b[good]
    fa, fb = half // 3, other // 3
    # An edge is inside of a chart where both of its ends have the same UVs in both faces.
    start, end = uvs[fa, half % 3], uvs[fa, (half % 3 + 1) % 3]
    start_b, end_b = uvs[fb, (other % 3 + 1) % 3], uvs[fb, other % 3]
    joined = (start == start_b).all(1) & (end == end_b).all(1)
    color_a, color_b = (
        look_up(textured.albedo, np.einsum("nk,nkd->nd", w, uvs[f])) for w, f in ((a, fa), (b, fb))
    )
    corners = mesh.vertices[mesh.faces]
    true_a, true_b = (
        pattern(np.einsum("nk,nkd->nd", w, corners[f])) for w, f in ((a, fa), (b, fb))
    )
    t = np.repeat(steps, len(good) // EDGE_SAMPLES)[good][:, None]
    at_edge = look_up(textured.albedo, start * (1 - t) + end * t)
    at_edge_b = look_up(textured.albedo, start_b * (1 - t) + end_b * t)
    first = corners[fa, half % 3]
    true_edge = pattern(first * (1 - t) + corners[fa, (half % 3 + 1) % 3] * t)
    jump = np.abs(color_a - color_b).mean(1)
    jump_true = np.abs(true_a - true_b).mean(1)
    off = 0.5 * (np.abs(at_edge - true_edge) + np.abs(at_edge_b - true_edge)).mean(1)
    return Seams(
        float(jump[~joined].mean()),
        float(jump[joined].mean()),
        float(jump_true[~joined].mean()),
        float(jump_true[joined].mean()),
        float(np.abs(at_edge - at_edge_b).mean(1)[~joined].mean()),
        float(off[joined].mean()),
        float(off[~joined].mean()),
    )


def _positions(mesh: SurfaceMesh, face: np.ndarray, bary: np.ndarray) -> np.ndarray:
    first, second = bary[:, 0].astype(np.float64), bary[:, 1].astype(np.float64)
    weights = np.stack([first, second, 1.0 - first - second], -1)
    return np.einsum("nk,nkd->nd", weights, mesh.vertices[mesh.faces[face]])


def _beside(mesh: SurfaceMesh, half: np.ndarray, t: float, distance: float) -> np.ndarray:
    """Return (n, 3) barycentric weights of points beside edges, within the edges' faces."""
    face, k = half // 3, half % 3
    corners = mesh.vertices[mesh.faces[face]]
    rows = np.arange(len(half))
    a, b, c = corners[rows, k], corners[rows, (k + 1) % 3], corners[rows, (k + 2) % 3]
    edge = b - a
    length2 = np.maximum((edge**2).sum(1), 1e-30)
    foot = ((c - a) * edge).sum(1) / length2
    height = np.linalg.norm(c - a - foot[:, None] * edge, axis=1)
    share = distance / np.maximum(height, 1e-30)
    weights = np.empty((len(half), 3))
    weights[rows, (k + 2) % 3] = share
    weights[rows, (k + 1) % 3] = t - share * foot
    weights[rows, k] = 1.0 - t - share * (1.0 - foot)
    return weights


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
