# SPDX-License-Identifier: GPL-3.0-or-later
"""The photos and points that blocks are measured on."""

from __future__ import annotations

import dataclasses

import numpy as np

from benchmarks.blocks import make_scene, near_border, seen_points
from benchmarks.camera_solving.places import town
from benchmarks.camera_solving.ray_caster import render
from gaussian_wrapping_addon.core.dataset.loading.load import load_scene
from gaussian_wrapping_addon.core.progress import Progress
from tests.core.training.blocks.row_scene import row_scene, two_blocks


def test_points_lie_where_their_photos_show_their_colour() -> None:
    place = town(12)
    cameras = [c.resized(160, 120) for c in place.cameras]
    images = [render(place.boxes, camera) for camera in cameras]
    found = seen_points(place.boxes, cameras, images, 1500)
    assert len(found.points) > 100
    assert (np.bincount(found.point_ids) >= 2).all()
    assert (np.diff(found.point_ids) >= 0).all()
    errors = []
    for point, view, pixel in zip(found.point_ids, found.camera_ids, found.pixels, strict=True):
        at, depth = cameras[view].project(found.points[point][None])
        assert depth[0] > 0
        assert np.allclose(at[0], pixel)
        column, row = pixel.astype(int)
        errors.append(np.abs(images[view][row, column].astype(int) - found.colors[point]).mean())
    # Textures are finer than pixels here and there; what hides a point looks nothing like it.
    assert np.median(errors) < 12.0
    # One box before a camera hides what is behind it.
    eye = cameras[0].center
    forward = cameras[0].rotation[2]
    boxes = dataclasses.replace(
        place.boxes,
        lower=np.concatenate([place.boxes.lower, [eye + forward - 0.9]]),
        upper=np.concatenate([place.boxes.upper, [eye + forward + 0.9]]),
        face_looks=np.concatenate([place.boxes.face_looks, [[0] * 6]]),
    )
    blinded = seen_points(boxes, cameras, images, 1500)
    behind = blinded.points[blinded.point_ids[blinded.camera_ids == 0]]
    assert not ((behind - eye) @ forward > 2.0).any()
    clear = found.points[found.point_ids[found.camera_ids == 0]]
    assert ((clear - eye) @ forward > 2.0).sum() > 5


def test_the_scene_is_a_project_that_loads(tmp_path) -> None:  # type: ignore[no-untyped-def]
    source = make_scene(tmp_path, 8, 64, 1)
    assert make_scene(tmp_path, 8, 64, 1) == source
    scene = load_scene(source, tmp_path / "work", Progress(), threads=1)
    assert len(scene.views) == 8
    assert {(view.camera.width, view.camera.height) for view in scene.views} == {(64, 48)}
    assert len(scene.points) > 20


def test_pixels_near_a_border_show_surface_that_is() -> None:
    plan, (scene, _) = two_blocks(), row_scene()
    (_, axis, at), = plan.tiling.splits  # fmt: skip
    camera = scene.views[12].camera
    plane = np.full((camera.height, camera.width), 4.0)  # a wall through the row
    plane[:4] = 0.0
    near = near_border(plan, camera, plane, 0.5).reshape(plane.shape)
    assert not near[:4].any()
    rays = camera.rays() * 4.0
    x = camera.center[axis] + (rays @ camera.rotation)[..., axis]
    assert np.array_equal(near[4:], np.abs(x - at)[4:] <= 0.5)
    assert near.any()
