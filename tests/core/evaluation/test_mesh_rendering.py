# SPDX-License-Identifier: GPL-3.0-or-later
"""Mesh-based rendering against photos made by exact ray casting, and against closed forms."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.evaluation import mesh_rendering
from gaussian_wrapping_addon.core.evaluation.mesh_rendering import (
    BACKGROUND,
    TexturedRenderer,
    render_views,
)
from gaussian_wrapping_addon.core.image_metrics import PSNR_CAP_DB
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.mesh.textured_mesh import TexturedMesh
from tests.core.evaluation.gradient_wall import CAMERAS, gradient_wall
from tests.core.test_image_metrics import MeanDifference
from tests.core.texture.texture_scenes import look_at, ring, shoot, sphere_hit, waves

FLAT = (200, 40, 120)


@pytest.fixture(autouse=True)
def _without_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    absent = (False, "no weights here")
    monkeypatch.setattr(mesh_rendering, "lpips_ready", lambda: absent)


def globe(rows: int = 96, columns: int = 192, texels: int = 1024) -> TexturedMesh:
    """A unit ball of latitudes and longitudes whose texture holds ``waves`` in closed form."""
    rise = np.linspace(-np.pi / 2, np.pi / 2, rows + 1)
    turn = np.linspace(-np.pi, np.pi, columns + 1)
    corners, faces = globe_points(turn[None, :], rise[:, None]), []
    for i in range(rows):
        for j in range(columns):
            a, b = i * (columns + 1) + j, (i + 1) * (columns + 1) + j
            faces += [[a, a + 1, b + 1], [a, b + 1, b]]
    across, up = (turn[None] + np.pi) / (2 * np.pi), (rise[:, None] + np.pi / 2) / np.pi
    uv = np.stack(np.broadcast_arrays(across, up), 2).reshape(-1, 2)
    across = ((np.arange(2 * texels) + 0.5) / (2 * texels) - 0.5) * 2 * np.pi
    down = (0.5 - (np.arange(texels) + 0.5) / texels) * np.pi
    albedo = np.rint(waves(globe_points(across[None], down[:, None]))).astype(np.uint8)
    mesh = SurfaceMesh(corners.reshape(-1, 3), np.array(faces, np.int32))
    return TexturedMesh(mesh, uv[mesh.faces].astype(np.float32), albedo)


def globe_points(turn: np.ndarray, rise: np.ndarray) -> np.ndarray:
    level = np.cos(rise)
    parts = level * np.cos(turn), level * np.sin(turn), np.sin(rise) + 0 * turn
    return np.stack(np.broadcast_arrays(*parts), -1)


def inside_of_ball(camera) -> np.ndarray:
    """Pixels that lie wholly within the ball's outline."""
    fine = camera.resized(3 * camera.width, 3 * camera.height)
    hit = np.isfinite(sphere_hit(fine.center, fine.rays() @ fine.rotation))
    return hit.reshape(camera.height, 3, camera.width, 3).all(axis=(1, 3))


def flat_wall(camera_count: int = 1) -> tuple[TexturedMesh, list, list]:
    """A square of one colour, its exact photos: columns 20 to 100, rows 5 to 85 of 120 x 90."""
    wall = gradient_wall()
    textured = dataclasses.replace(wall, albedo=np.full((8, 8, 3), FLAT, np.uint8))
    photo = np.full((90, 120, 3), 30, np.uint8)
    photo[5:85, 20:100] = FLAT
    return textured, [CAMERAS[0]] * camera_count, [photo] * camera_count


def half_of(textured: TexturedMesh) -> TexturedMesh:
    """A flat wall of which the left 40 columns remain."""
    vertices = textured.mesh.vertices.copy()
    vertices[vertices[:, 0] > 0, 0] = 0.0
    return dataclasses.replace(textured, mesh=dataclasses.replace(textured.mesh, vertices=vertices))


@pytest.mark.parametrize("masked", [False, True])
def test_a_ball_is_rendered_as_an_exact_ray_caster_sees_it(masked: bool) -> None:
    ball, cameras = globe(), [*ring(3, 3.5, 1.2), look_at((0.5, -2.5, -2.0))]
    photos = [shoot(camera, [(sphere_hit, waves)]) for camera in cameras]
    masks = [inside_of_ball(camera) for camera in cameras]
    found = render_views(ball, cameras, photos, masks=masks if masked else None)
    assert len(found.views) == 4
    assert found.mean("psnr") > 54.0
    assert min(view.scores.psnr for view in found.views) > 52.0
    assert found.mean("ssim") > 0.999
    for view, mask in zip(found.views, masks, strict=True):
        share = 1.0 if masked else mask.mean()
        assert view.covered == pytest.approx(share, rel=0.01)


def test_a_hole_counts_under_a_mask_and_not_over_covered_pixels() -> None:
    textured, cameras, photos = flat_wall()
    mask = np.zeros((90, 120), bool)
    mask[5:85, 20:100] = True
    whole = render_views(textured, cameras, photos, masks=[mask])
    assert [whole.mean(name) for name in ("psnr", "ssim", "covered")] == [PSNR_CAP_DB, 1.0, 1.0]
    half = half_of(textured)
    covered = render_views(half, cameras, photos)
    assert (covered.mean("psnr"), covered.pixels) == (PSNR_CAP_DB, "covered")
    found = render_views(half, cameras, photos, masks=[mask])
    squares = (np.array(FLAT) - BACKGROUND) ** 2 / 255.0**2
    assert found.mean("psnr") == pytest.approx(-10 * math.log10(0.5 * squares.mean()), abs=1e-9)
    assert found.mean("ssim") < 0.9
    assert (found.mean("covered"), found.pixels) == (pytest.approx(0.5), "mask")


@pytest.mark.parametrize("masked", [False, True])
def test_uncovered_pixels_are_counted_and_black_in_a_second_figure(masked: bool) -> None:
    """The wall covers columns 20 to 60 of 120 and rows 5 to 85 of 90; its edges lie on pixels."""
    textured, cameras, photos = flat_wall()
    masks = [np.ones((90, 120), bool)] if masked else None
    found = render_views(half_of(textured), cameras, photos, masks=masks)
    share = 1 - 80 * 40 / (90 * 120)
    assert found.mean("uncovered") == pytest.approx(share)
    assert found.mean("covered") == pytest.approx(1 - share)
    error = (photos[0] / 255.0) ** 2
    error[5:85, 20:60] = 0.0
    assert found.mean("whole_psnr") == pytest.approx(-10 * math.log10(error.mean()), abs=1e-4)
    values = found.to_json()
    for name in ("uncovered", "whole_psnr"):
        assert values[name] == values["views"][0][name] == found.mean(name)


def test_pixels_that_may_not_count_do_not() -> None:
    textured, cameras, photos = flat_wall()
    spoilt = photos[0].copy()
    spoilt[:, 50:] = 0
    counted = np.zeros((90, 120), bool)
    counted[:, :50] = True
    mask = np.zeros((90, 120), bool)
    mask[5:85, 20:100] = True
    for masks, share in ((None, 80 * 30 / (90 * 50)), ([mask], 1.0)):
        found = render_views(textured, cameras, [spoilt], masks=masks, counted=[counted])
        assert found.mean("psnr") == PSNR_CAP_DB
        assert found.mean("covered") == pytest.approx(share)
        assert render_views(textured, cameras, [spoilt], masks=masks).mean("psnr") < 20.0
    assert render_views(textured, cameras, photos, counted=[None]).mean("psnr") == PSNR_CAP_DB


def test_json_is_finite_and_means_are_over_the_photos() -> None:
    textured, cameras, photos = flat_wall(2)
    photos[1] = (photos[1] // 2).astype(np.uint8)
    found = render_views(textured, cameras, photos)
    values = json.loads(json.dumps(found.to_json(), allow_nan=False))
    first, second = values["views"]
    assert (first["psnr"], first["name"]) == (100.0, "c")
    error = ((np.array(FLAT) - np.array(FLAT) // 2) / 255.0) ** 2
    assert second["psnr"] == pytest.approx(-10 * math.log10(error.mean()))
    assert values["psnr"] == pytest.approx((first["psnr"] + second["psnr"]) / 2)
    assert values["ssim"] == pytest.approx((first["ssim"] + second["ssim"]) / 2)
    assert values["pixels"] == "covered"
    assert values["lpips_note"] == "no weights here"
    assert not any("lpips" in part for part in (values.keys() - {"lpips_note"}, first))


def test_views_without_a_pixel_to_judge_are_left_out_and_counted() -> None:
    textured, cameras, photos = flat_wall()
    away = look_at((0, -3.0, 0), (0, -6.0, 0), width=120, height=90)
    seen = []
    found = render_views(
        textured, [away, *cameras], [photos[0], photos[0]],
        on_view=lambda *values: seen.append(values),
    )  # fmt: skip
    assert (len(found.views), found.left_out, len(seen)) == (1, 1, 1)
    name, photo, image = seen[0]
    assert name == "c"
    assert photo is photos[0]
    assert np.array_equal(image, TexturedRenderer(textured).render(cameras[0]).image)
    # Under a mask, a mesh out of sight is as wrong as can be, not left out.
    mask = np.ones((90, 120), bool)
    assert render_views(textured, [away], photos, masks=[mask]).mean("covered") == 0.0
    nothing = render_views(textured, cameras, photos, masks=[np.zeros((90, 120), bool)])
    values = nothing.to_json()
    assert (values["left_out"], values["views"]) == (1, [])
    assert "psnr" not in values


def test_lpips_is_measured_where_it_is_given() -> None:
    metric = MeanDifference()
    textured, cameras, photos = flat_wall(2)
    photos[1] = 255 - photos[1]
    found = render_views(textured, cameras, photos, lpips=metric)
    # Outside of the wall, where the pictures differ, the photo stands in both.
    assert found.views[0].scores.lpips == 0.0
    shown = photos[1].copy()
    shown[5:85, 20:100] = FLAT
    expected = metric.distance(shown / 255.0, photos[1] / 255.0)
    assert found.views[1].scores.lpips == pytest.approx(expected, rel=1e-5)
    values = found.to_json()
    assert values["lpips"] == pytest.approx(expected / 2, rel=1e-5)
    assert "lpips_note" not in values
    small = cameras[0].resized(16, 12)
    tiny = render_views(textured, [small], [np.zeros((12, 16, 3), np.uint8)], lpips=metric)
    assert tiny.mean("lpips") is None
    assert "too small" in tiny.to_json()["lpips_note"]


def test_the_result_does_not_depend_on_threads() -> None:
    ball, cameras = globe(24, 48, 64), ring(2, 3.5, 1.2)
    photos = [shoot(camera, [(sphere_hit, waves)]) for camera in cameras]
    one, many = (render_views(ball, cameras, photos, threads=n) for n in (1, 3))
    assert one == many


def test_columns_of_other_lengths_and_sizes_are_refused() -> None:
    textured, cameras, photos = flat_wall()
    small = np.ones((45, 60), bool)
    for given, masks, words in (
        (photos * 2, None, "2 photos for 1 cameras"),
        (photos, [], "masks"),
        ([photos[0][::2, ::2]], None, r"\(45, 60\)"),
        (photos, [small], None),
    ):
        with pytest.raises(UsageError, match=words):
            render_views(textured, cameras, given, masks=masks)
