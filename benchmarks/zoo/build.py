# SPDX-License-Identifier: GPL-3.0-or-later
"""Make one scene folder of the zoo: photos, COLMAP project, ground truth, volumes, description."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np
from PIL import Image

from gaussian_wrapping_addon.core.errors import ResourceError
from gaussian_wrapping_addon.core.files import write_json
from gaussian_wrapping_addon.core.regions.region import write_region

from ..scenes.catalogue import THIN_SHARE
from ..scenes.colmap_project import write_colmap
from ..scenes.exposure import draw_gains, expose
from ..scenes.geometry import joined
from ..scenes.ground_truth import SAMPLES, truth_samples
from ..scenes.rendering import require_bpy, union_of
from ..scenes.visibility import RayScene
from .catalogue import ZooScene, draw_content
from .content import Content
from .points import disturbed_poses, found_points
from .rendering import render_photos
from .shapes import Mesh
from .surroundings import SKY_NAME


def true_surface(content: Content) -> Mesh:
    """Return the union of the subject's solids.

    Raises
    ------
    ResourceError
        bpy is missing, or its union is not closed.
    """
    parts = content.subject.parts
    vertices, faces = union_of(parts) if len(parts) > 1 else joined(parts)
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1)
    _, counts = np.unique(edges, axis=0, return_counts=True)
    if not len(faces) or (counts % 2).any():
        raise ResourceError(
            f"The union of {len(parts)} solids is not closed ({len(faces)} faces).",
            "Use the bpy version of requirements-benchmarks.txt.",
        )
    return vertices, faces


def build_zoo_scene(scene: ZooScene, folder: Path, threads: int, samples: int = SAMPLES) -> None:
    """Make the scene in an empty folder.

    Parameters
    ----------
    samples : int
        Of the true surface.

    Raises
    ------
    ResourceError
        bpy, trimesh or embreex is missing.
    """
    content = draw_content(scene)
    truth = true_surface(content)
    images, tests = folder / "images", folder / "test" / "images"
    images.mkdir(parents=True)
    tests.mkdir(parents=True)
    shot, cameras = content.photography, content.cameras
    paths = [images / c.name for c in cameras] + [tests / c.name for c in content.test_cameras]
    render_photos(content, [*cameras, *content.test_cameras], paths, threads)
    if shot.exposure:
        for path, gain in zip(
            paths[: len(cameras)], draw_gains(len(cameras), scene.seed), strict=True
        ):
            Image.fromarray(expose(_read(path), gain)).save(path)
    solid = joined([p for p in (*content.subject.parts, *content.around) if p.name != SKY_NAME])
    photos = [_read(path) for path in paths[: len(cameras)]]
    sparse = found_points(RayScene(*solid), cameras, photos, shot, scene.seed)
    away = [np.linalg.norm(sparse.points - c.center, axis=1) for c in cameras]
    written = disturbed_poses(cameras, shot.pose_noise_px, float(np.median(away)), scene.seed)
    write_colmap(folder / "sparse" / "0", written, sparse)
    test_cameras = [camera.to_json() for camera in content.test_cameras]
    write_json(folder / "test" / "cameras.json", {"cameras": test_cameras})
    thin_below = THIN_SHARE * content.crop.diagonal
    found = truth_samples(truth, solid, cameras, content.crop, thin_below, scene.seed, samples)
    np.savez_compressed(
        folder / "truth.npz", vertices=truth[0], faces=truth[1], points=found.points,
        normals=found.normals, thin=found.thin, seen=found.seen,
    )  # fmt: skip
    write_region(folder / "region.json", content.region)
    write_region(folder / "crop.json", content.crop)
    write_json(
        folder / "scene.json",
        {
            "version": 1,
            "name": scene.name,
            "role": scene.part,
            "family": scene.family,
            "seed": scene.seed,
            "diagonal": content.crop.diagonal,
            "thin_below": thin_below,
            "photography": asdict(shot),
            "sparse_points": len(sparse.points),
            "bpy": require_bpy().app.version_string,
        },
    )


def _read(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))
