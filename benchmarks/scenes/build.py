# SPDX-License-Identifier: GPL-3.0-or-later
"""Make one scene folder: photos, COLMAP project, ground truth, volumes, description."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.dataset.similarity import Similarity
from gaussian_wrapping_addon.core.files import write_json
from gaussian_wrapping_addon.core.regions.region import write_region

from .catalogue import THIN_SHARE, SceneContent, SceneKind, scene_content, scene_kind
from .colmap_project import write_colmap
from .exposure import draw_gains, expose
from .geometry import joined
from .ground_truth import SAMPLES, truth_samples
from .rendering import render_photos, require_bpy
from .sparse_points import sparse_points
from .visibility import RayScene

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
