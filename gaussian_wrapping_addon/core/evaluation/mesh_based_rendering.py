# SPDX-License-Identifier: GPL-3.0-or-later
"""Mesh-based rendering: a mesh judged by photos."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import UsageError
from ..image_metrics import PSNR_CAP_DB, Lpips, ViewScores, has_windows, psnr, score_images
from ..mesh.components import face_graph, uv_charts
from ..mesh.depth_buffer import depth_buffer
from ..mesh.textured_mesh import TexturedMesh
from ..parallel import default_threads
from ..progress import Progress
from ..resampling import as_unit_floats
from ..scene.camera import Camera
from ..scene.scene import PhotoSource, Scene
from ..settings import TextureSettings
from ..texture.texture_mesh import texture_mesh
from ..texture.unwrap.unwrap import Unwrap
from .color_field import ColorField, ColorFieldSettings, Contraction, Samples, fit_color_field
from .mesh_rendering import OnView, check_sizes

# -- Bake a mesh's texture again without some photos, for an unbiased comparison with them --------


MIN_SIZE_PX = 256


class _PhotoSubset:
    """A renumbered subset of the photos of a store."""

    def __init__(self, photos: PhotoSource, indices: list[int]) -> None:
        self._photos = photos
        self._indices = indices

    def camera(self, index: int, divisor: int = 1) -> Camera:
        return self._photos.camera(self._indices[index], divisor)

    def photo(self, index: int, divisor: int = 1) -> np.ndarray:
        return self._photos.photo(self._indices[index], divisor)

    def mask(self, index: int, divisor: int = 1) -> np.ndarray | None:
        return self._photos.mask(self._indices[index], divisor)


def bake_held_out_texture(
    textured: TexturedMesh, scene: Scene, photos: PhotoSource, names: Collection[str],
    reduction: int, work_folder: Path, progress: Progress, *, threads: int,
) -> TexturedMesh:  # fmt: skip
    """Bake the colours again on the same UVs from all photos except the named ones.

    At least one photo must remain. The result has no normal map and no occlusion, which unlit
    pictures do not show.

    Parameters
    ----------
    reduction : int
        Factor by which the compared pictures are coarser than the photos: the texture is reduced
        by the largest power of two up to it.
    work_folder : Path
        For temporary files, all removed before returning.
    """
    kept = [i for i, view in enumerate(scene.views) if view.camera.name not in names]
    full_px = len(textured.albedo)
    size_px = full_px
    while size_px >= 2 * MIN_SIZE_PX and full_px // size_px * 2 <= reduction:
        size_px //= 2
    mesh, uvs = textured.mesh, textured.corner_uvs
    graph = face_graph(mesh.vertices, mesh.faces)
    gutter_px = float(textured.statistics.get("gutter_px", 1.0)) * size_px / full_px
    charts = uv_charts(graph, mesh.faces, uvs)
    unwrapped = Unwrap(uvs, charts, "kept", gutter_px, face_atlas=textured.face_atlas)
    settings = TextureSettings(
        size_px, max(1, math.floor(gutter_px)), normal_map="off", ambient_occlusion="off"
    )
    part = dataclasses.replace(scene, views=tuple(scene.views[i] for i in kept))
    return texture_mesh(
        mesh, part, _PhotoSubset(photos, kept), settings, work_folder, progress,
        threads=threads, unwrapped=unwrapped,
    )  # fmt: skip


# -- Mesh-based rendering: train a colour field on a frozen mesh, compare it with unseen photos
#
# The measure of MILo that the paper uses (docs/method.md, section 9.3). The field belongs to
# places, not to faces, so that a mesh gains nothing by having more of them.


BACKGROUND = 0.0
"""Grey value of a pixel that no face covers: a renderer of the mesh alone shows black there."""
NEAR_SHARE = 1e-3
"""Near plane, share of the cameras' distance to the farthest of them from their middle."""
SAME_PLACE_SHARE = 1e-6
"""Cameras no farther apart than this share of the frame, turned as little, are the same."""


@dataclass(frozen=True)
class MeshBasedSettings:
    """How the field is trained and what is compared."""

    max_samples: int = 3_000_000
    """Training pixels that are used, of each photo at most an equal share, drawn evenly."""
    seed: int = 0  # of the draw
    outline_margin: float = 0.02
    """Where outlines are given: distance around them, as a share of the long side of the photo,
    within which pixels are compared."""
    color_field: ColorFieldSettings = field(default_factory=ColorFieldSettings)


@dataclass(frozen=True)
class PhotoView:
    """A photo with its camera."""

    camera: Camera  # in the mesh's frame, of the size of the photo
    photo: np.ndarray  # (h, w, 3) uint8, or floats whose white is 1
    counted: np.ndarray | None = None  # (h, w) bool: pixels that may be used; all without it.
    outline: np.ndarray | None = None
    """(h, w) bool: where the photo shows what the mesh should show. Outside of it the photo is
    taken as black, as if the thing had been photographed alone."""


@dataclass(frozen=True)
class MeshBasedView:
    """Figures of one test photo."""

    name: str
    scores: ViewScores  # Over the compared pixels; uncovered ones are black.
    covered_psnr: float | None
    """dB, over compared pixels that a face covers; ``None`` if there are none."""
    inside_psnr: float | None
    """dB, over the outline's pixels alone: holes count, what reaches beyond the outline does not;
    ``None`` without outline."""
    uncovered: float
    """Share of the pixels that should show the mesh (of the outline, or all compared ones) that no
    face covers."""
    beyond: float | None
    """Compared pixels outside of the outline that a face covers, as a share of the outline's
    pixels; ``None`` without outline."""

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values; unmeasured ones are absent."""
        names = ("covered_psnr", "inside_psnr", "uncovered", "beyond")
        own = {name: getattr(self, name) for name in names}
        measured = {name: value for name, value in own.items() if value is not None}
        return {"name": self.name, **self.scores.to_json(), **measured}


@dataclass(frozen=True)
class MeshBasedRendering:
    """Figures of all test photos; means are over photos with equal weights."""

    views: tuple[MeshBasedView, ...]
    left_out: int  # test photos without a pixel to compare
    training_views: int
    training_pixels: int
    """Pixels of training photos that a face covers."""
    samples: int  # those of them that the field was fitted to
    training_psnr: float | None
    """dB at the samples: how well the field could follow the training photos."""
    field_vertices: tuple[int, int]  # of the fine and the coarse lattice
    settings: MeshBasedSettings

    def mean(self, name: str) -> float | None:
        """Return the mean over the views that have the figure: a key of their JSON values."""
        found = [values[name] for view in self.views if name in (values := view.to_json())]
        return sum(found) / len(found) if found else None

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values; unmeasured ones are absent."""
        names = ("psnr", "ssim", "lpips", "covered_psnr", "inside_psnr", "uncovered", "beyond")
        means = {name: self.mean(name) for name in names}
        values = {
            **means, "views": [view.to_json() for view in self.views], "left_out": self.left_out,
            "background": "black", "training_views": self.training_views,
            "training_pixels": self.training_pixels, "samples": self.samples,
            "training_psnr": self.training_psnr, "field_vertices": list(self.field_vertices),
            "settings": asdict(self.settings),
        }  # fmt: skip
        return {key: value for key, value in values.items() if value is not None}


def mesh_based_rendering(
    vertices: np.ndarray, faces: np.ndarray, training: Sequence[PhotoView],
    test: Sequence[PhotoView], settings: MeshBasedSettings | None = None, *,
    lpips: Lpips | None = None, threads: int = 0, progress: Progress | None = None,
    on_view: OnView | None = None,
) -> MeshBasedRendering:  # fmt: skip
    """Fit colours on the mesh to the training photos, and compare with the test photos.

    A pixel is covered if the ray through its centre meets a face from either side. An uncovered
    pixel is black and is compared like any other.

    Parameters
    ----------
    vertices, faces : (v, 3) float64, (f, 3)
    training, test : sequence of PhotoView
        The only photos that the field is fitted to, and the only ones that are compared.
    threads : int
        0 uses every core; the result does not depend on it, except for the last digits of LPIPS.
    on_view : callable, optional
        Called with name, photo and rendering (floats) of each view compared.

    Raises
    ------
    UsageError
        There is no training or no test photo, one is among both, or sizes differ.
    """
    settings, progress = settings or MeshBasedSettings(), progress or Progress()
    threads = threads or default_threads()
    _check(training, test)
    vertices = np.ascontiguousarray(vertices, np.float64)
    faces = np.ascontiguousarray(faces, np.int32)
    contraction = Contraction.of_cameras(
        [view.camera for view in training], _distance(vertices, faces, training)
    )
    surface = _Surface(vertices, faces, NEAR_SHARE * contraction.radius, threads)
    samples, pixels = _draw(surface, training, settings, progress.span(0.0, 0.3))
    color_field, reached = None, None
    if samples is not None:
        color_field = fit_color_field(
            samples, contraction, settings.color_field, progress.span(0.3, 0.8), threads=threads
        )
        shown = color_field.colors(samples.points, samples.directions, threads=threads)
        reached = min(psnr(shown[None], samples.colors[None]), PSNR_CAP_DB)
    views = []
    for number, view in enumerate(test):
        progress.span(0.8, 1.0).update(number / len(test), "comparing with test photos")
        found = _compare(surface, color_field, view, settings, lpips, on_view)
        if found is not None:
            views.append(found)
    levels = () if color_field is None else color_field.levels
    near, far = [len(level.vertices) for level in levels] or [0, 0]
    return MeshBasedRendering(
        tuple(views), len(test) - len(views), len(training), pixels,
        0 if samples is None else len(samples.points), reached, (near, far), settings,
    )  # fmt: skip


@dataclass(frozen=True)
class _Surface:
    vertices: np.ndarray
    faces: np.ndarray
    near: float
    threads: int

    def depth(self, camera: Camera) -> np.ndarray:
        """Return (h, w) float32 z-depth, infinite where no face is met."""
        return depth_buffer(
            self.vertices, self.faces, camera, threads=self.threads, near=self.near
        ).depth


def _check(training: Sequence[PhotoView], test: Sequence[PhotoView]) -> None:
    if not training:
        raise UsageError(
            "Mesh-based rendering has no training photo.", "Give the photos of the reconstruction."
        )
    if not test:
        raise UsageError(
            "Mesh-based rendering has no test photo.",
            "Hold photos out of training, or give a folder of test photos.",
        )
    for view in (*training, *test):
        check_sizes(view.camera, view.photo, view.counted, view.outline)
    centers = np.array([view.camera.center for view in training])
    spread = max(float(np.ptp(centers, axis=0).max()), float(np.finfo(np.float64).tiny))
    for view in test:
        near = np.linalg.norm(centers - view.camera.center, axis=1) <= SAME_PLACE_SHARE * spread
        for at in np.flatnonzero(near).tolist():
            other = training[at].camera
            if np.abs(other.rotation - view.camera.rotation).max() <= SAME_PLACE_SHARE:
                raise UsageError(
                    f"The test photo {view.camera.name} has the camera of the training photo "
                    f"{other.name}.",
                    "Give test photos that were not used for training.",
                )


def _distance(vertices: np.ndarray, faces: np.ndarray, training: Sequence[PhotoView]) -> float:
    """Return a typical distance of the mesh from the cameras, world units, > 0."""
    used = vertices[faces.reshape(-1)] if len(faces) else np.zeros((1, 3))
    center = np.median(used, axis=0)
    distances = [float(np.linalg.norm(view.camera.center - center)) for view in training]
    return max(float(np.median(distances)), float(np.finfo(np.float32).tiny))


def _rays(depth: np.ndarray, camera: Camera, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the points and unit directions of pixels (flat indices) with a finite depth."""
    rows, columns = np.divmod(chosen, camera.width)
    rays = camera.rays_at(np.stack([columns, rows], 1) + 0.5) @ camera.rotation
    points = camera.center + rays * depth.reshape(-1)[chosen, None].astype(np.float64)
    return points, (rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(np.float32)


def _target(view: PhotoView) -> np.ndarray:
    """Return (h, w, 3) float32: the photo, black outside of the outline."""
    photo = as_unit_floats(view.photo)
    if view.outline is not None:
        photo = np.where(np.asarray(view.outline, np.bool_)[..., None], photo, BACKGROUND)
    return np.ascontiguousarray(photo, np.float32)


def _draw(
    surface: _Surface,
    training: Sequence[PhotoView],
    settings: MeshBasedSettings,
    progress: Progress,
) -> tuple[Samples | None, int]:
    """Return samples of the surface and the number of pixels that they were drawn from."""
    quota = -(-settings.max_samples // len(training))
    generator = np.random.default_rng(settings.seed)
    points, directions, footprints, colors = [], [], [], []
    total = 0
    for number, view in enumerate(training):
        progress.update(number / len(training), "finding the surface in the training photos")
        depth = surface.depth(view.camera)
        use = np.isfinite(depth)
        if view.counted is not None:
            use &= view.counted
        chosen = np.flatnonzero(use)
        total += len(chosen)
        if len(chosen) > quota:
            chosen = np.sort(generator.choice(chosen, quota, replace=False))
        found = _rays(depth, view.camera, chosen)
        points.append(found[0])
        directions.append(found[1])
        focal = float(np.sqrt(view.camera.fx * view.camera.fy))
        footprints.append((depth.reshape(-1)[chosen] / focal).astype(np.float32))
        colors.append(_target(view).reshape(-1, 3)[chosen])
    if total == 0:
        return None, 0
    joined = (np.concatenate(parts) for parts in (points, directions, footprints, colors))
    return Samples(*joined), total


def _compare(
    surface: _Surface, color_field: ColorField | None, view: PhotoView,
    settings: MeshBasedSettings, lpips: Lpips | None, on_view: OnView | None,
) -> MeshBasedView | None:  # fmt: skip
    camera, target = view.camera, _target(view)
    depth = surface.depth(camera)
    covered = np.isfinite(depth)
    image = np.full(target.shape, BACKGROUND, np.float32)
    chosen = np.flatnonzero(covered)
    if color_field is not None and len(chosen):
        colors = color_field.colors(*_rays(depth, camera, chosen), threads=surface.threads)
        image.reshape(-1, 3)[chosen] = colors
    compared = np.ones(covered.shape, np.bool_) if view.counted is None else view.counted.copy()
    wanted = compared
    if view.outline is not None:
        wanted = compared & view.outline
        compared &= _widened(view.outline, settings.outline_margin)
    if not has_windows(compared.shape, compared) or not wanted.any():
        return None
    scores = score_images(image, target, compared, lpips=lpips, threads=surface.threads)
    both = compared & covered
    own = min(psnr(image, target, both), PSNR_CAP_DB) if both.any() else None
    beyond = inside = None
    if view.outline is not None:
        inside = min(psnr(image, target, wanted), PSNR_CAP_DB)
        outside = np.count_nonzero(both & ~view.outline)
        beyond = outside / np.count_nonzero(wanted)
    uncovered = np.count_nonzero(wanted & ~covered) / np.count_nonzero(wanted)
    if on_view is not None:
        on_view(camera.name, target, image)
    return MeshBasedView(camera.name, scores, own, inside, uncovered, beyond)


def _widened(outline: np.ndarray, share: float) -> np.ndarray:
    """Return the pixels no farther from the outline than a share of the picture's long side."""
    from scipy.ndimage import distance_transform_edt

    if not outline.any():
        return outline
    distance: np.ndarray = distance_transform_edt(~np.asarray(outline, np.bool_))
    return distance <= share * max(outline.shape)
