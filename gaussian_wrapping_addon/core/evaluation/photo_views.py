# SPDX-License-Identifier: GPL-3.0-or-later
"""Renderings beside photos: comparison, pictures, previews."""

from __future__ import annotations

import dataclasses
import io
import math
import time
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import ParseError, ResourceError, UsageError
from ..files import read_json, resolve_inside, write_bytes
from ..image_metrics import lpips_if_ready
from ..loading.source_kind import read_poses, source_kind
from ..loading.views import prepare_views
from ..mesh.depth_buffer import depth_buffer
from ..mesh.surface_mesh import area_vectors
from ..mesh.textured_mesh import TexturedMesh
from ..parallel import default_threads
from ..photos.store import PhotoStore
from ..progress import Progress
from ..scene.camera import Camera, Similarity
from ..scene.scene import PhotoSource, Scene, View, evenly_spaced
from .mesh_based_rendering import PhotoView, bake_held_out_texture
from .mesh_rendering import BACKGROUND, TexturedRenderer, render_views

# -- Read photos with their cameras for mesh-based rendering: of a scene, or of a folder ----------


LONG_SIDE_PX = 800
"""Photos are reduced to this: as many of them as a capture has must fit into memory at once."""
TEST_CAMERAS = "cameras.json"
"""Cameras of a folder whose photos are in ``images/``; what the benchmarks' scenes have."""


def photo_views(scene: Scene, indices: Iterable[int], *, max_image_px: int) -> list[PhotoView]:
    """Return photos of a scene in its world frame, black pixels of masks left out.

    Raises
    ------
    DatasetError
        A photo was changed or removed.
    """
    store = PhotoStore(scene, max_image_px)
    world = scene.world_from_scene
    return [PhotoView(store.camera(i).moved(world), store.photo(i), store.mask(i)) for i in indices]


def folder_scene(path: Path, work_folder: Path, progress: Progress, *, threads: int) -> Scene:
    """Return the photos of a folder, undistorted where needed, in the frame of their cameras.

    The folder is a COLMAP project, one with ``transforms.json``, or one with :data:`TEST_CAMERAS`
    and ``images/``; undistorted photos are written into ``work_folder``.

    Raises
    ------
    UsageError
        The folder holds photos without cameras.
    DatasetError, ParseError
        It cannot be used.
    """
    if (path / TEST_CAMERAS).is_file():
        return _scene_of(_written_views(path))
    kind = source_kind(path)
    if kind.kind == "photos":
        raise UsageError(
            f"{path.name} holds photos without cameras.",
            "Give a COLMAP project or a transforms.json in the frame of the mesh.",
        )
    prepared, _, _ = prepare_views(read_poses(kind), kind, work_folder, progress, threads=threads)
    views = []
    for view in prepared:
        focal_x, focal_y, middle_x, middle_y = view.pinhole.params
        size = view.pinhole.width, view.pinhole.height
        camera = Camera(view.name, *size, focal_x, focal_y, middle_x, middle_y, view.cam_from_world)
        views.append(View(camera, view.photo_path, view.mask_path))
    return _scene_of(views)


def _scene_of(views: list[View]) -> Scene:
    none = np.zeros((0, 3))
    return Scene(tuple(views), none, none.astype(np.uint8), Similarity())


def _written_views(folder: Path) -> list[View]:
    path = folder / TEST_CAMERAS
    again = "Give a COLMAP project or a transforms.json instead."
    values = read_json(path, follow_links=True)
    entries = values.get("cameras") if isinstance(values, dict) else None
    if not isinstance(entries, list) or not entries:
        raise ParseError(path, "cameras", "a list of cameras was expected.", again)
    views = []
    for number, entry in enumerate(entries):
        try:
            camera = Camera.from_json(entry)
        except (TypeError, ValueError, KeyError) as error:
            raise ParseError(
                path, f"camera {number}", f"not as expected ({error}).", again
            ) from None
        photo = resolve_inside(folder / "images", str(camera.name))
        if photo is None or not photo.is_file():
            raise ParseError(
                path, f"camera {number}", f"the photo images/{camera.name} is missing.", again
            )
        views.append(View(camera, photo))
    return views


# -- Write two images of the same size side by side -----------------------------------------------


GAP_PX = 12
_JPEG: dict[str, Any] = {"format": "JPEG", "quality": 88}


def write_side_by_side(
    path: Path, left: np.ndarray, right: np.ndarray, *, max_width_px: int | None = None
) -> None:
    """Write a PNG or JPEG, depending on the path's suffix, of two (h, w, 3) uint8 images.

    A picture wider than ``max_width_px`` is scaled down.

    Raises
    ------
    ResourceError
        The file cannot be written.
    """
    from PIL import Image

    height, width = left.shape[:2]
    canvas = np.empty((height, 2 * width + GAP_PX, 3), np.uint8)
    canvas[:] = BACKGROUND
    canvas[:, :width] = left
    canvas[:, width + GAP_PX :] = right
    picture = Image.fromarray(canvas)
    if max_width_px is not None and picture.width > max_width_px:
        low = max(1, round(height * max_width_px / picture.width))
        picture = picture.resize((max_width_px, low), Image.Resampling.LANCZOS)
    stream = io.BytesIO()
    options = {"format": "PNG"} if path.suffix == ".png" else _JPEG
    picture.save(stream, **options)
    try:
        write_bytes(path, stream.getvalue())
    except OSError as error:
        raise ResourceError(
            f"{path} cannot be written: {error.strerror or error}.",
            "Check that the folder exists, is not read-only, and that the disk has room.",
        ) from error


# -- Compare a job's textured mesh with some of the job's photos: figures and pictures ------------


MAX_PHOTOS = 8
PHOTO_COMPARISON_LONG_SIDE_PX = 800
MAX_PICTURES = 3
PICTURE_WIDTH_PX = 1200
NOTE_ALL_PHOTOS = "the texture was baked from all photos, including those compared"
NOTE_HELD_OUT = (
    "the texture compared was baked without the held-out photos; the files use all photos"
)
NOTE_GAUSSIANS = (
    "the texture is rendered from the Gaussians, which were not trained on the held-out photos"
)


def compare_with_photos(
    textured: TexturedMesh, scene: Scene, photos: PhotoSource, held_out: Collection[str],
    folder: Path, progress: Progress, *, from_gaussians: bool = False, exposed: bool = False,
    threads: int = 0,
) -> dict[str, Any]:  # fmt: skip
    """Evaluate mesh-based rendering over covered pixels, and write some of the comparisons.

    Comparison with a photo from which the texture was baked is biased. If photos were held out, a
    texture baked without them is compared, at the coarsest size that the pictures allow.

    Parameters
    ----------
    held_out : collection of str
        Names of photos held out of training. Up to :data:`MAX_PHOTOS` evenly spaced ones of these
        are compared, or of all photos if none were held out.
    folder : Path
        Where ``comparison-1.jpg`` and so on are written: photo left, rendering right.
    from_gaussians : bool
        The texture has no colours of photos, so no photo has to be left out.
    exposed : bool
        The photos differ in exposure: measure in that of each photo as well.
    threads : int
        0 uses every core.

    Returns
    -------
    dict
        What :meth:`~.mesh_rendering.MeshRenderingScore.to_json` returns, with ``pictures`` (file
        names), ``held_out`` (whether the photos were held out of training), ``note``, and, if a
        texture was baked for it, ``texture_size_px`` and ``bake_s``. Views with a picture have the
        key ``picture``.

    Raises
    ------
    ResourceError
        A picture cannot be written.
    """
    names = [view.camera.name for view in scene.views]
    wanted = [index for index, name in enumerate(names) if name in held_out]
    chosen = evenly_spaced(wanted or range(len(names)), MAX_PHOTOS)
    cameras, images, counted = [], [], []
    reduction = 0
    for index in chosen:
        full = photos.camera(index, 1)
        # Whole blocks of pixels are averaged, as the renderer averages whole blocks of rays.
        divisor = math.ceil(max(full.width, full.height) / PHOTO_COMPARISON_LONG_SIDE_PX)
        divisor = min(divisor, full.width, full.height)
        reduction = min(reduction or divisor, divisor)
        cameras.append(photos.camera(index, divisor))
        images.append(photos.photo(index, divisor))
        counted.append(photos.mask(index, divisor))
    description: dict[str, Any] = {
        "note": NOTE_GAUSSIANS if from_gaussians and wanted else NOTE_ALL_PHOTOS
    }
    if wanted and len(wanted) < len(names) and not from_gaussians:
        begun_s = time.monotonic()
        textured = bake_held_out_texture(
            textured, scene, photos, held_out, reduction, folder, progress,
            threads=threads or default_threads(),
        )  # fmt: skip
        description = {
            "note": NOTE_HELD_OUT,
            "texture_size_px": len(textured.albedo),
            "bake_s": round(time.monotonic() - begun_s, 1),
        }
    shown: list[tuple[np.ndarray, np.ndarray]] = []
    lpips, reason = lpips_if_ready()
    score = render_views(
        textured, cameras, images, counted=counted, lpips=lpips, threads=threads, exposed=exposed,
        on_view=lambda name, photo, image: shown.append((photo, image)),
    )  # fmt: skip
    values = score.to_json()
    if reason:
        values["lpips_note"] = reason
    values["pictures"] = []
    for number, index in enumerate(evenly_spaced(range(len(shown)), MAX_PICTURES), start=1):
        name = f"comparison-{number}.jpg"
        write_side_by_side(folder / name, *shown[index], max_width_px=PICTURE_WIDTH_PX)
        values["views"][index]["picture"] = name
        values["pictures"].append(name)
    return {**values, "held_out": bool(wanted), **description}


# -- Preview picture: a photo beside a rendering of the textured mesh from the same camera --------


PREVIEW_LONG_SIDE_PX = 900
CHOICE_LONG_SIDE_PX = 120
MAX_CHOICES = 64
CROP_MARGIN = 0.15
MIN_MARGIN_SHARE = 0.02


def choose_view(
    textured: TexturedMesh, photos: PhotoSource, count: int, *, threads: int = 0
) -> int:
    """Return the photo that shows the mesh large, complete, and from the front.

    With 0 threads, every core is used.
    """
    threads = threads or default_threads()
    vertices, faces = textured.mesh.vertices, textured.mesh.faces
    corners = vertices[faces]
    cross = area_vectors(vertices, faces)
    best, best_score = 0, -1.0
    for index in np.unique(np.linspace(0, count - 1, min(count, MAX_CHOICES)).astype(int)).tolist():
        full = photos.camera(index, 1)
        scale = CHOICE_LONG_SIDE_PX / max(full.width, full.height)
        camera = full.resized(max(1, round(full.width * scale)), max(1, round(full.height * scale)))
        hit = depth_buffer(vertices, faces, camera, threads=threads).face
        covered = hit >= 0
        pixels, depth = camera.project(vertices)
        inside = (depth > 0) & (pixels > 0).all(axis=1)
        inside &= (pixels < [camera.width, camera.height]).all(axis=1)
        facing = (cross[hit[covered]] * (corners[hit[covered], 0] - camera.center)).sum(axis=1) < 0
        score = float(facing.sum()) / covered.size * float(inside.mean()) ** 2
        if score > best_score:
            best, best_score = index, score
    return best


def _crop(textured: TexturedMesh, camera: Camera, threads: int) -> tuple[int, int, int, int]:
    """Return left, top, right, bottom of the part of the photo that shows the mesh."""
    factor = max(1, max(camera.width, camera.height) // (2 * CHOICE_LONG_SIDE_PX))
    coarse = camera.resized(max(1, camera.width // factor), max(1, camera.height // factor))
    mesh = textured.mesh
    hit = depth_buffer(mesh.vertices, mesh.faces, coarse, threads=threads).face >= 0
    if not hit.any():
        return 0, 0, camera.width, camera.height
    bounds = []
    for axis, side in ((0, camera.width), (1, camera.height)):
        covered = np.flatnonzero(hit.any(axis=axis)) / hit.shape[1 - axis] * side
        margin = CROP_MARGIN * (covered[-1] - covered[0]) + MIN_MARGIN_SHARE * side
        bounds.append((max(0, int(covered[0] - margin)), min(side, int(covered[-1] + margin) + 1)))
    return bounds[0][0], bounds[1][0], bounds[0][1], bounds[1][1]


def write_preview(
    textured: TexturedMesh, scene: Scene, photos: PhotoSource, path: Path, *, threads: int = 0,
) -> None:  # fmt: skip
    """Write a PNG: left the part of a photo that shows the mesh best, right its rendering.

    With 0 threads, every core is used.

    Raises
    ------
    ResourceError
        The file cannot be written.
    """
    from PIL import Image

    threads = threads or default_threads()
    index = choose_view(textured, photos, len(scene.views), threads=threads)
    full = photos.camera(index, 1)
    left, top, right, bottom = _crop(textured, full, threads)
    part = dataclasses.replace(
        full, width=right - left, height=bottom - top, cx=full.cx - left, cy=full.cy - top
    )
    scale = min(1.0, PREVIEW_LONG_SIDE_PX / max(part.width, part.height))
    width, height = max(1, round(part.width * scale)), max(1, round(part.height * scale))
    pixels = photos.photo(index, 1)[top:bottom, left:right]
    resampling = Image.Resampling.LANCZOS
    photo = Image.fromarray(np.ascontiguousarray(pixels)).resize((width, height), resampling)
    rendered = TexturedRenderer(textured, threads=threads).render(part, (width, height)).image
    write_side_by_side(path, np.asarray(photo), rendered)
