# SPDX-License-Identifier: GPL-3.0-or-later
"""Judge both results by the photos held out and by the true surface, near borders and elsewhere."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.dataset.photos.photo_store import PhotoStore
from gaussian_wrapping_addon.core.dataset.scene import Scene
from gaussian_wrapping_addon.core.dataset.view_split import held_out_views
from gaussian_wrapping_addon.core.evaluation.surface.samples import (
    SurfaceSamples,
    choose_per_cell,
    scan_virtually,
)
from gaussian_wrapping_addon.core.evaluation.surface.scores import score_surface
from gaussian_wrapping_addon.core.evaluation.surface.truth import MIN_CAMERAS, Truth
from gaussian_wrapping_addon.core.mesh.mesh_file import load_mesh
from gaussian_wrapping_addon.core.render.projection.projection import RawArrays
from gaussian_wrapping_addon.core.render.types.options import RenderOptions
from gaussian_wrapping_addon.core.render.view_renderer import ViewRenderer
from gaussian_wrapping_addon.core.training.blocks.block_plan import BlockPlan

from ..camera_solving.ray_caster import Boxes
from ..speed_error.alpha_shape import alpha_shape
from .comparison import COARSE, JOINED, MESH, WHOLE, Comparison
from .street import face_points, shown_in, street
from .street_mesh import beside_region, street_bounds

BAND_SHARE = 0.5
"""What lies within this share of the smallest margin of a border is near it."""
TOLERANCES_M = (0.05, 0.1, 0.2)
NEAR_M = 12.0
"""A photo shows a point well enough from no deeper: a pixel is 3 cm wide there."""
INSIDE_M = 0.35
"""Surface closer to the region's own boundary, where the mesh is capped, is not judged."""
TRUE_SAMPLES_PER_PHOTO = 1500
SCAN_STEP_PX, SCAN_CELL_M = 4.0, 0.1
"""Rays by which a mesh is looked at from the training photos; one hit a cell is judged."""
SCAN_EVERY = 2
"""Every n-th of them: they are a metre apart."""
ALPHAS_M = (0.5, 1.0, 2.0, 4.0)
ALPHA = "alpha shape"
ALL, NEAR, ELSEWHERE = "all", "near borders", "elsewhere"

_Mesh = tuple[np.ndarray, np.ndarray]


def band_reach(plan: BlockPlan) -> float:
    """Return how far from a border between cells its band reaches, scene units; 0 without one."""
    axes = sorted({axis for _, axis, _ in plan.tiling.splits})
    return BAND_SHARE * float(plan.margins[:, axes].min()) if axes else 0.0


def near_border(plan: BlockPlan, camera: Camera, depth: np.ndarray, reach: float) -> np.ndarray:
    """Tell which pixels show surface within reach of a border between cells, (h * w,) bool."""
    seen = (camera.rays() * depth[..., None]).reshape(-1, 3)
    points = (seen - camera.cam_from_world[:, 3]) @ camera.rotation
    return plan.near_border(points, reach) & (depth.reshape(-1) > 0.0)


def judged_photos(comparison: Comparison, threads: int) -> dict[str, dict[str, float | None]]:
    """Return the PSNR of both results over the held-out photos, dB, by place."""
    scene, plan = comparison.scene("judged", threads), comparison.plan()
    photos = PhotoStore(scene, comparison.settings.max_image_px)
    raw = {
        name: RawArrays.from_gaussians(comparison.gaussians(name))
        for name in (WHOLE, JOINED, COARSE)
    }
    reach, renderer = band_reach(plan), ViewRenderer()
    squared: dict[str, list[np.ndarray]] = {name: [] for name in raw}
    near = []
    for view in held_out_views(scene, comparison.settings.holdout_every):
        camera, photo = photos.camera(view), photos.photo(view) / 255.0
        options = RenderOptions(threads=threads)
        for name, gaussians in raw.items():
            image = renderer.render(gaussians, camera, options)
            if name == WHOLE:
                near.append(near_border(plan, camera, image.depth, reach))
            errors = (np.clip(image.color, 0.0, 1.0) - photo) ** 2
            squared[name].append(errors.mean(2).reshape(-1).astype(np.float64))
    border = np.concatenate(near)
    found = {}
    for name, parts in squared.items():
        errors = np.concatenate(parts)
        places = {ALL: errors, NEAR: errors[border], ELSEWHERE: errors[~border]}
        found[name] = {place: _psnr(values) for place, values in places.items()}
    return found


def _psnr(squared: np.ndarray) -> float | None:
    return float(-10.0 * np.log10(max(squared.mean(), 1e-10))) if len(squared) else None


@dataclasses.dataclass(frozen=True)
class Place:
    """A part of space as a crop volume."""

    inside: Callable[[np.ndarray], np.ndarray]


def box_triangles(boxes: Boxes) -> _Mesh:
    """Return the faces of all boxes as triangles, outward; those of the first box inward."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    quads = np.array(
        [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    )
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    sizes = boxes.upper - boxes.lower
    vertices = (boxes.lower[:, None] + corners * sizes[:, None]).reshape(-1, 3)
    faces = (triangles + 8 * np.arange(len(sizes))[:, None, None]).astype(np.int64)
    faces[0] = faces[0][:, ::-1]
    return vertices, faces.reshape(-1, 3)


def true_surface(comparison: Comparison, views: tuple[int, ...]) -> tuple[Truth, np.ndarray]:
    """Return the street's surface that training photos see, and a mask of what others hide.

    Returns
    -------
    truth : Truth
        World frame, metres; samples that at least two of the photos see from near.
    hidden : (n, 3) float64
        The other samples of the faces.
    """
    place = street(comparison.photos)
    points, normals = face_points(place.boxes, TRUE_SAMPLES_PER_PHOTO * comparison.photos, seed=1)
    low, high = street_bounds(comparison.photos)
    kept = ((points >= low) & (points <= high)).all(1)
    points, normals = points[kept], normals[kept]
    seen = np.zeros(len(points), np.int32)
    for view in views:
        rows, _ = shown_in(place.boxes, place.cameras[view], points, NEAR_M)
        seen[rows] += 1
    shown = seen >= MIN_CAMERAS
    samples = SurfaceSamples(points[shown], normals[shown])
    return Truth(samples, *box_triangles(place.boxes)), points[~shown]


def judged_surface(comparison: Comparison, threads: int) -> dict[str, Any]:
    """Return F1, precision and recall of each mesh at the tolerances, by place.

    Of a mesh what training photos would see of it from near is judged, where the nearest true
    sample is one that they see.
    """
    scene, plan = comparison.scene("judged", threads), comparison.plan()
    truth, hidden = true_surface(comparison, plan.views)
    tree = cKDTree(np.concatenate([truth.samples.points, hidden]))
    crops = places(scene, plan, comparison.photos)
    cameras = [street(comparison.photos).cameras[view] for view in plan.views[::SCAN_EVERY]]
    beside = beside_region(np.array([camera.center for camera in cameras]), comparison.photos)
    cameras = [cameras[row] for row in np.flatnonzero(beside)]
    sparse = scene.world_from_scene.points(scene.points)

    def judged(mesh: _Mesh) -> dict[str, Any]:
        samples = scanned(mesh, cameras, crops[ALL], threads)
        samples = samples.kept(tree.query(samples.points)[1] < len(truth.samples))
        found = {}
        for name, crop in crops.items():
            of = dataclasses.replace(truth, crop=crop)
            if of.judged().any():
                score = score_surface(samples, mesh, of, TOLERANCES_M, threads=threads)
                found[name] = {
                    "f1": list(score.f1),
                    "precision": list(score.precision),
                    "recall": list(score.recall),
                    "samples": [score.predicted_count, score.truth_count],
                }
        return found

    results = {}
    for name in (WHOLE, JOINED, COARSE):
        path = comparison.folder / f"{MESH}{name}" / "mesh.npz"
        if path.is_file():
            mesh = load_mesh(path)
            vertices = scene.world_from_scene.points(np.asarray(mesh.vertices, np.float64))
            results[name] = judged((vertices, np.asarray(mesh.faces)))
    shapes = [judged(shape) for a in ALPHAS_M if len((shape := alpha_shape(sparse, a))[1])]
    if shapes:
        results[ALPHA] = max(shapes, key=lambda of: of[ALL]["f1"][1])
    return results


def scanned(mesh: _Mesh, cameras: Sequence[Camera], crop: Place, threads: int) -> SurfaceSamples:
    """Return the points of a mesh that cameras see from near, thinned evenly."""
    points, normals = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for camera in cameras:
        found = scan_virtually(*mesh, [camera], threads=threads, step_px=SCAN_STEP_PX)
        near = camera.to_camera(found.points)[:, 2] <= NEAR_M
        near &= crop.inside(found.points)
        kept = choose_per_cell(found.kept(near), SCAN_CELL_M)
        points.append(kept.points)
        normals.append(kept.normals)
    return choose_per_cell(
        SurfaceSamples(np.concatenate(points), np.concatenate(normals)), SCAN_CELL_M
    )


def places(scene: Scene, plan: BlockPlan, photos: int) -> Mapping[str, Place]:
    """Return the parts of the street that are judged apart, world frame."""
    low, high = street_bounds(photos)
    low, high = low + INSIDE_M, high - INSIDE_M
    scene_from_world, reach = scene.world_from_scene.inverse(), band_reach(plan)

    def inside(points: np.ndarray) -> np.ndarray:
        return np.asarray(((points >= low) & (points <= high)).all(1))

    def near(points: np.ndarray) -> np.ndarray:
        return plan.near_border(scene_from_world.points(points), reach)

    return {
        ALL: Place(inside),
        NEAR: Place(lambda points: inside(points) & near(points)),
        ELSEWHERE: Place(lambda points: inside(points) & ~near(points)),
    }
