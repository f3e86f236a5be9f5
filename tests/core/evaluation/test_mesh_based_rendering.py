# SPDX-License-Identifier: GPL-3.0-or-later
"""Mesh-based rendering of shapes photographed by exact ray casting."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import json
import math

import numpy as np
import pytest
import trimesh

from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.evaluation.mesh_based_rendering import (
    MeshBasedRendering,
    MeshBasedSettings,
    PhotoView,
    mesh_based_rendering,
)
from gaussian_wrapping_addon.core.scene.camera import Camera, Similarity
from tests.core.evaluation.surface_scenes import ball
from tests.core.test_image_metrics import MeanDifference
from tests.core.texture.texture_scenes import look_at, ring, shoot, sphere_hit

TRAINING = 14
AWAY = np.array([0.0, 0.0, 1e4])


def ripples(points: np.ndarray) -> np.ndarray:
    """Colours in [0, 255] with a period of 9 to 12 pixels of the photos below."""
    phase = points @ np.array([[11.0, -7.0, 3.0], [6.0, 12.0, -5.0], [-4.0, 6.0, 13.0]])
    return 127.5 + 100.0 * np.sin(phase + np.array([0.0, 1.0, 2.0]))


def outline(camera: Camera, radius: float = 1.0) -> np.ndarray:
    return np.isfinite(sphere_hit(camera.center, camera.rays() @ camera.rotation, radius))


@functools.cache
def views(outlined: bool = True) -> tuple[list[PhotoView], list[PhotoView]]:
    """Photos of a ball of radius 1: training from two rings and the poles, tests between them."""
    above, below = ring(6, 3.5, 1.2), ring(6, 3.5, -1.4)
    poles = [look_at((0.2, 0.1, 3.7)), look_at((0.1, -0.2, -3.7))]
    between = [look_at((3.4, 1.0, 0.3)), look_at((-1.0, 3.3, -0.5)), look_at((1.2, -3.2, 0.9))]

    def photo_view(name: str, camera: Camera) -> PhotoView:
        camera = dataclasses.replace(camera, name=name)
        photo = shoot(camera, [(sphere_hit, ripples)])
        return PhotoView(camera, photo, outline=outline(camera) if outlined else None)

    training = [photo_view(f"train-{i}", c) for i, c in enumerate([*above, *below, *poles])]
    return training, [photo_view(f"test-{i}", c) for i, c in enumerate(between)]


@functools.cache
def of_ball(outlined: bool = True) -> MeshBasedRendering:
    return mesh_based_rendering(*ball(), *views(outlined))


def test_a_true_mesh_with_its_photos_scores_high() -> None:
    found = of_ball()
    assert found.mean("psnr") > 29.5
    assert found.mean("ssim") > 0.97
    assert found.mean("uncovered") < 0.01
    assert found.mean("beyond") < 0.01
    assert (len(found.views), found.left_out, found.training_views) == (3, 0, TRAINING)
    # Away from the rim, where photos blend with what is behind and few cameras look.
    inner = [
        dataclasses.replace(view, counted=outline(view.camera, 0.9), outline=None)
        for view in views()[1]
    ]
    found = mesh_based_rendering(*ball(), views()[0], inner)
    assert min(view.scores.psnr for view in found.views) > 33.0


def test_the_same_surface_with_four_times_the_faces_scores_the_same() -> None:
    flat = ball(3)  # its faces are planes: subdivision leaves the surface as it is
    finer = trimesh.Trimesh(*flat, process=False).subdivide()
    coarse = mesh_based_rendering(*flat, *views())
    fine = mesh_based_rendering(finer.vertices, finer.faces, *views(), lpips=MeanDifference())
    for name in ("psnr", "covered_psnr", "inside_psnr"):
        assert coarse.mean(name) == pytest.approx(fine.mean(name), abs=0.02)
    assert coarse.mean("ssim") == pytest.approx(fine.mean("ssim"), abs=1e-3)
    assert 0.0 < fine.to_json()["lpips"] < 1.0
    assert "lpips" not in coarse.to_json()
    assert mesh_based_rendering(*flat, *views(), threads=3) == coarse


@pytest.mark.parametrize("outlined", [True, False])
def test_a_displaced_mesh_scores_lower_the_farther_it_is(outlined: bool) -> None:
    vertices, faces = ball()
    figures = [of_ball(outlined)]
    for share in (0.02, 0.05):
        moved = vertices + np.array([0.0, 0.0, 2.0 * share])
        figures.append(mesh_based_rendering(moved, faces, *views(outlined)))
    for near, far in itertools.pairwise(figures):
        assert near.mean("psnr") > far.mean("psnr") + 1.0
        assert near.mean("covered_psnr") > far.mean("covered_psnr") + 1.0
        assert near.mean("ssim") > far.mean("ssim") + 0.02


def test_an_inflated_mesh_reaches_beyond_the_outline() -> None:
    vertices, faces = ball()
    found = mesh_based_rendering(1.04 * vertices, faces, *views())
    assert found.mean("beyond") > of_ball().mean("beyond") + 0.05
    assert found.mean("inside_psnr") < of_ball().mean("inside_psnr") - 3.0


@pytest.mark.parametrize("outlined", [True, False])
def test_a_hole_costs_and_is_counted(outlined: bool) -> None:
    # A bowl is left: through a small hole the far side shows.
    vertices, faces = ball()
    bowl = vertices, faces[vertices[faces].mean(axis=1)[:, 0] < -0.6]
    whole, found = of_ball(outlined), mesh_based_rendering(*bowl, *views(outlined))
    assert found.mean("psnr") < whole.mean("psnr") - 3.0
    assert found.mean("uncovered") > whole.mean("uncovered") + 0.02
    first, before = found.views[0], whole.views[0]
    assert first.name == "test-0"
    assert first.uncovered > before.uncovered + 0.05
    near = np.linalg.norm(vertices[faces].mean(axis=1) - [1.0, 0, 0], axis=1) < 0.3
    small = mesh_based_rendering(vertices, faces[~near], *views(outlined))
    assert small.views[0].scores.psnr < before.scores.psnr - 1.0


def test_uncovered_pixels_are_black_and_compared() -> None:
    """A mesh out of sight leaves photos against black, whose PSNR is known."""
    vertices, faces = ball()
    for outlined in (False, True):
        training, test = views(outlined)
        found = mesh_based_rendering(
            vertices + AWAY, faces, training, test, MeshBasedSettings(outline_margin=0.0)
        )
        # Under outlines what lies beyond them is black as well.
        for view, given in zip(found.views, test, strict=True):
            shown = given.photo[given.outline] if outlined else given.photo
            mean = ((shown / 255.0) ** 2).mean()
            assert view.scores.psnr == pytest.approx(-10 * math.log10(mean), abs=1e-4)
            assert view.uncovered == 1.0
        values = json.loads(json.dumps(found.to_json(), allow_nan=False))
        assert (values["samples"], values["background"]) == (0, "black")
        assert "covered_psnr" not in values


def test_test_photos_are_never_used_for_the_fit() -> None:
    """Whatever the test photos show, what is rendered is bit for bit the same."""
    training, test = views()
    inverted = [dataclasses.replace(v, photo=255 - v.photo) for v in test]
    shown: list[list[np.ndarray]] = []
    for photos in (test, inverted):
        images: list[np.ndarray] = []
        found = mesh_based_rendering(
            *ball(), training, photos, on_view=lambda *given, to=images: to.append(given[2])
        )
        assert found.training_psnr == of_ball().training_psnr
        shown.append(images)
    np.testing.assert_array_equal(*shown)
    # Training photos, on the other hand, decide everything.
    spoilt = [dataclasses.replace(v, photo=255 - v.photo) for v in training]
    assert mesh_based_rendering(*ball(), spoilt, test).mean("psnr") < 12.0


def test_pixels_that_may_not_count_are_neither_fitted_nor_compared() -> None:
    training, test = views(outlined=False)

    def counted(view: PhotoView, columns: slice, *, spoilt: bool) -> PhotoView:
        photo, mask = view.photo.copy(), np.ones(view.photo.shape[:2], np.bool_)
        mask[:, columns] = False
        photo[~mask & spoilt] = 0
        return dataclasses.replace(view, photo=photo, counted=mask)

    right = slice(120, None)
    found = mesh_based_rendering(
        *ball(),
        [training[0], *(counted(v, slice(0, 60), spoilt=True) for v in training[1:])],
        [counted(v, right, spoilt=True) for v in test],
    )
    same = [counted(v, right, spoilt=False) for v in test]
    whole = mesh_based_rendering(*ball(), training, same)
    assert found.mean("psnr") == pytest.approx(whole.mean("psnr"), abs=1.0)
    assert found.mean("uncovered") == whole.mean("uncovered")
    nothing = [counted(v, slice(None), spoilt=False) for v in test]
    values = mesh_based_rendering(*ball(), training, nothing).to_json()
    assert (values["left_out"], values["views"]) == (3, [])
    assert "psnr" not in values


def test_scale_and_place_of_the_world_change_nothing() -> None:
    turn = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3])[:3, :3]
    world = Similarity(300.0, turn, np.array([5e5, 4e6, 100.0]))
    vertices, faces = ball()

    def moved(given: list[PhotoView]) -> list[PhotoView]:
        return [dataclasses.replace(v, camera=v.camera.moved(world)) for v in given]

    training, test = views()
    found = mesh_based_rendering(world.points(vertices), faces, moved(training), moved(test))
    # The lattice lies differently in the turned world.
    assert found.mean("psnr") == pytest.approx(of_ball().mean("psnr"), abs=0.4)


def test_few_samples_are_enough_and_the_draw_has_a_seed() -> None:
    def with_seed(seed: int) -> MeshBasedRendering:
        settings = MeshBasedSettings(max_samples=40_000, seed=seed)
        return mesh_based_rendering(*ball(), *views(), settings)

    first = with_seed(0)
    assert first.samples <= 40_000 + TRAINING
    assert first.training_pixels == of_ball().samples > 60_000
    assert first == dataclasses.replace(with_seed(0))
    assert first.mean("psnr") != with_seed(1).mean("psnr")
    assert first.mean("psnr") == pytest.approx(of_ball().mean("psnr"), abs=1.5)


def test_training_photos_are_refused_as_test_photos() -> None:
    training, test = views()
    with pytest.raises(UsageError, match="test photo train-0 has the camera of the training"):
        mesh_based_rendering(*ball(), training, [*test, training[0]])
    # Another view from the same place is one that was not trained on.
    camera = training[0].camera
    turned = dataclasses.replace(
        camera, cam_from_world=np.diag([-1.0, -1.0, 1.0]) @ camera.cam_from_world
    )
    photo = np.ascontiguousarray(training[0].photo[::-1, ::-1])
    found = mesh_based_rendering(*ball(), training, [PhotoView(turned, photo)])
    assert found.views


def test_absent_photos_and_pictures_of_other_sizes_are_refused() -> None:
    training, test = views()
    for given, hint in (
        (([], test), "photos of the reconstruction"),
        ((training, []), "Hold photos out"),
    ):
        with pytest.raises(UsageError) as caught:
            mesh_based_rendering(*ball(), *given)
        assert hint in caught.value.hint
    for name, picture in (("photo", test[0].photo[::2]), ("counted", np.ones((5, 5), np.bool_))):
        wrong = dataclasses.replace(test[0], **{name: picture})
        with pytest.raises(UsageError, match="test-0: a picture of"):
            mesh_based_rendering(*ball(), training, [wrong])
