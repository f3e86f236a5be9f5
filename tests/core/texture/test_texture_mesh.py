# SPDX-License-Identifier: GPL-3.0-or-later
"""The texture step on analytic scenes: correct colours, no bleeding, fill, statistics."""

from __future__ import annotations

import json
import logging
from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import Cancelled
from gaussian_wrapping_addon.core.mesh.components import FaceGraph, face_graph
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.mesh.textured_mesh import TexturedMesh
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.settings import TextureSettings
from gaussian_wrapping_addon.core.texture.atlas import raster_atlas
from gaussian_wrapping_addon.core.texture.bake import BakedColors, CoverageStatistics, solve_gains
from gaussian_wrapping_addon.core.texture.fill import surface_positions
from gaussian_wrapping_addon.core.texture.photo_samples import SurfaceArrays, SurfacePoints
from gaussian_wrapping_addon.core.texture.size import gutter_for, plan_textures, required_side
from gaussian_wrapping_addon.core.texture.texture_mesh import texture_mesh
from gaussian_wrapping_addon.core.texture.unwrap.unwrap import Unwrap
from tests.core.texture.texture_scenes import (
    FakePhotos,
    box,
    box_hit,
    joined,
    look_at,
    photograph,
    plain,
    ring,
    scene_of,
    sphere,
    sphere_hit,
    waves,
)

SIZE_PX = 256


def run(
    mesh: SurfaceMesh, photos: FakePhotos, folder: Path, size_px: int = SIZE_PX, **options
) -> TexturedMesh:
    settings = TextureSettings(size_px=size_px, gutter_px=options.pop("gutter_px", 4))
    return texture_mesh(
        mesh, scene_of(photos), photos, settings, folder, Progress(), threads=2, **options
    )


def texels(textured: TexturedMesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, colours and face normals of the texels whose centre lies in a face."""
    mesh = textured.mesh
    raster = raster_atlas(textured.corner_uvs, len(textured.albedo), 2)
    face, bary = raster.face[raster.inside], raster.bary[raster.inside]
    graph = face_graph(mesh.vertices, mesh.faces)
    surface = SurfaceArrays.of(mesh.vertices, mesh.faces, graph.normals, 1.0)
    positions = surface_positions(SurfacePoints(face, bary), surface)
    return positions, textured.albedo[raster.inside].astype(float), graph.normals[face]


def cameras_all_around() -> list:
    return [*ring(5, 3.0, 1.6), *ring(5, 3.0, -1.6)]


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> TexturedMesh:
    photos = photograph(cameras_all_around(), [(sphere_hit, waves)])
    return run(sphere(4), photos, tmp_path_factory.mktemp("ball"))


def test_colours_of_a_sphere_are_those_of_the_pattern(ball: TexturedMesh) -> None:
    positions, colors, _ = texels(ball)
    error = np.abs(colors - waves(positions))
    assert ball.statistics["coverage"] > 0.99
    assert error.mean() < 2.0
    assert np.percentile(error, 99) < 10.0
    assert 10 * np.log10(255**2 / (error**2).mean()) > 38.0


def test_statistics_are_plain_json_and_add_up(ball: TexturedMesh) -> None:
    counts = json.loads(json.dumps(ball.statistics, allow_nan=False))
    assert counts["texels_seen"] + counts["texels_filled"] == counts["texels_used"]
    assert counts["coverage"] == counts["texels_seen"] / counts["texels_used"]
    assert counts["unwrap"] == "xatlas"
    assert counts["texels_overlapping"] == 0
    assert counts["size_px"] == SIZE_PX == len(ball.albedo)
    assert counts["photos_used"] == 10
    assert counts["views_per_seen_texel"] > 1.5
    assert not counts["exposure_corrected"]
    assert ball.albedo.dtype == np.uint8
    assert ball.albedo.shape == (SIZE_PX, SIZE_PX, 3)


def test_threads_and_repeats_change_nothing(tmp_path: Path, ball: TexturedMesh) -> None:
    photos = photograph(cameras_all_around(), [(sphere_hit, waves)])
    settings = TextureSettings(SIZE_PX, 4)
    again = texture_mesh(
        ball.mesh, scene_of(photos), photos, settings, tmp_path, Progress(), threads=1
    )
    assert (again.corner_uvs == ball.corner_uvs).all()
    assert (again.albedo == ball.albedo).all()


def wall_and_plate(cameras: list, folder: Path) -> tuple[TexturedMesh, FaceGraph]:
    """A red plate before a blue wall."""
    wall, plate = ([-2.0, 1.0, -2.0], [2.0, 1.2, 2.0]), ([-0.4, 0.0, -0.4], [0.4, 0.05, 0.4])
    mesh = joined(box(*wall, 4), box(*plate, 3))
    things = [
        (lambda o, r: box_hit(o, r, *wall), plain((30, 120, 200))),
        (lambda o, r: box_hit(o, r, *plate), plain((230, 20, 20))),
    ]
    return run(mesh, photograph(cameras, things), folder), face_graph(mesh.vertices, mesh.faces)


def test_an_occluder_is_not_painted_on_what_lies_behind(tmp_path: Path) -> None:
    cameras = [look_at((x, -3.0, z), (0, 0.5, 0)) for x in (-1.0, 0.0, 1.0) for z in (-0.5, 0.5)]
    textured, _ = wall_and_plate(cameras, tmp_path)
    positions, colors, normals = texels(textured)
    front = (positions[:, 1] > 0.999) & (normals[:, 1] < -0.9)
    assert front.sum() > 1000
    # Pixels that mix both colours at the plate's outline are rejected or outvoted.
    assert (np.abs(colors[front] - [30, 120, 200]).max(axis=1) < 25).mean() > 0.999
    assert np.abs(colors[front] - [230, 20, 20]).max(axis=1).min() > 80
    plate = (positions[:, 1] < 1e-9) & (normals[:, 1] < -0.9)
    assert (np.abs(colors[plate] - [230, 20, 20]).max(axis=1) < 40).mean() > 0.98


def test_hidden_texels_of_a_single_photo_are_counted_as_unseen(tmp_path: Path) -> None:
    textured, graph = wall_and_plate([look_at((0, -2.0, 0), focal=60.0)], tmp_path)
    positions, colors, normals = texels(textured)
    front = (positions[:, 1] > 0.999) & (normals[:, 1] < -0.9)
    # The plate's shadow on the wall: 0.8 wide at distance 2, so 1.2 wide at distance 3.
    shadow = front & (np.abs(positions[:, [0, 2]]).max(axis=1) < 0.55)
    lit = front & (np.abs(positions[:, [0, 2]]).max(axis=1) > 0.75)
    assert (np.abs(colors[shadow | lit] - [30, 120, 200]).max(axis=1) < 25).mean() > 0.95
    visible = 4.0 * 4.0 - 1.2 * 1.2 + 0.8 * 0.8
    assert abs(textured.statistics["coverage"] - visible / graph.areas.sum()) < 0.04


def test_faces_that_no_photo_sees_are_filled_and_counted(tmp_path: Path) -> None:
    low, high = [-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]
    from_above = [look_at((2.5 * np.cos(a), 2.5 * np.sin(a), 2.5)) for a in (0.1, 1.6, 3.2, 4.7)]
    things = [(lambda o, r: box_hit(o, r, low, high), plain((40, 160, 90)))]
    textured = run(box(low, high), photograph(from_above, things), tmp_path)
    _, colors, normals = texels(textured)
    below = normals[:, 2] < -0.9
    assert below.sum() > 1000
    assert np.abs(colors[below] - [40, 160, 90]).max() <= 12
    counts = textured.statistics
    assert abs(counts["texels_filled"] / counts["texels_used"] - below.mean()) < 0.05
    assert abs(counts["area_seen_share"] - 5 / 6) < 0.03
    assert counts["coverage"] < 0.86


@pytest.mark.parametrize("areas", [(3.0, 1.0, 4.0), (0.0, 0.0, 4.0)])
def test_faces_smaller_than_a_texel_are_neither_seen_nor_unseen(areas: tuple) -> None:
    """Of three faces one is seen, one is not, and one has no texel to tell by."""
    points = SurfacePoints(np.array([0, 0, 1]), np.zeros((3, 2), np.float32))
    views = np.array([2, 0, 0], np.uint8)
    baked = BakedColors(np.zeros((3, 3), np.uint8), views, views > 0, views > 0, 0)
    unwrapped = Unwrap(np.zeros((3, 3, 2), np.float32), np.zeros(3, np.int32), "box", 2.0)
    coverage = CoverageStatistics(3)
    coverage.add(points, baked, 0)
    counts = coverage.statistics(SIZE_PX, TextureSettings(SIZE_PX, 4), unwrapped, np.array(areas))
    assert counts["area_seen_share"] == (0.75 if areas[0] else 0.0)
    assert counts["area_without_texel_share"] == areas[2] / sum(areas)
    assert counts["faces_without_texel"] == 1


def test_the_whole_image_is_filled_and_gutters_repeat_their_chart(ball: TexturedMesh) -> None:
    raster = raster_atlas(ball.corner_uvs, SIZE_PX, 2)
    used = raster.face >= 0
    image = ball.albedo.astype(int)
    near = np.zeros_like(used)
    difference = np.zeros(used.shape)
    for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        neighbour = np.roll(used, (dy, dx), (0, 1)) & ~used
        value = np.roll(image, (dy, dx), (0, 1))
        near |= neighbour
        step = np.abs(value - image).max(axis=2)
        difference = np.where(neighbour, np.maximum(difference, step), difference)
    assert near.sum() > 200
    assert (difference[near] <= 30).mean() > 0.97
    assert (image.max(axis=2) > 0).all()


def test_a_constant_colour_stays_constant_everywhere(tmp_path: Path) -> None:
    photos = photograph(ring(6, 3.0, 0.5), [(sphere_hit, plain((200, 100, 50)))])
    photos.images = [np.broadcast_to(np.uint8([200, 100, 50]), i.shape) for i in photos.images]
    textured = run(sphere(3), photos, tmp_path)
    assert 0.7 < textured.statistics["coverage"] < 1.0
    assert np.abs(textured.albedo.astype(int) - [200, 100, 50]).max() <= 1


@pytest.mark.parametrize("brighter", [21, 90])
def test_a_highlight_in_the_best_photo_is_outvoted(tmp_path: Path, brighter: int) -> None:
    """The others agree exactly: that must not let the best one win by its weight."""
    low, high = [-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]
    frontal = look_at((0.0, -2.6, 0.0))
    aside = [look_at((x, -3.2, z)) for x in (-2.2, 2.2) for z in (-1.6, 1.6)]
    things = [(lambda o, r: box_hit(o, r, low, high), plain((100, 100, 100)))]
    photos = photograph([frontal, *aside], things)
    shine = photos.images[0] = photos.images[0].copy()
    height, width = shine.shape[:2]
    middle = (slice(height * 4 // 9, height * 5 // 9), slice(width * 4 // 9, width * 5 // 9))
    shine[middle] += np.uint8(brighter)
    positions, colors, normals = texels(run(box(low, high), photos, tmp_path))
    centre = (normals[:, 1] < -0.9) & (np.abs(positions[:, [0, 2]]) < 0.05).all(1)
    assert centre.sum() > 10
    assert np.abs(colors[centre] - 100).max() <= 2


def test_masked_photos_give_nothing(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    photos = photograph(ring(3, 3.0, 0.5), [(sphere_hit, waves)])
    photos.masks = [np.zeros(i.shape[:2], bool) for i in photos.images]
    with caplog.at_level(logging.WARNING):
        textured = run(sphere(2), photos, tmp_path, 128)
    assert textured.statistics["coverage"] == 0.0
    assert textured.statistics["texels_filled"] == textured.statistics["texels_used"]
    assert (textured.albedo == 128).all()
    assert any("no photo sees" in r.message for r in caplog.records)


def test_masks_cut_off_what_stands_before_the_thing(tmp_path: Path) -> None:
    photos = photograph(cameras_all_around(), [(sphere_hit, plain((60, 140, 60)))])
    photos.masks = []
    for image in photos.images:
        mask = np.ones(image.shape[:2], bool)
        image[40:70, 60:150] = (255, 0, 255)
        mask[40:70, 60:150] = False
        photos.masks.append(mask)
    textured = run(sphere(3), photos, tmp_path)
    _, colors, _ = texels(textured)
    assert (np.abs(colors - [60, 140, 60]).max(axis=1) < 40).mean() > 0.995


def test_one_wrong_photo_is_outvoted(tmp_path: Path) -> None:
    photos = photograph([*ring(9, 3.0, 1.2), *ring(9, 3.0, -1.2)], [(sphere_hit, waves)])
    photos.images[4] = np.full_like(photos.images[4], (255, 0, 255))
    textured = run(sphere(4), photos, tmp_path)
    positions, colors, _ = texels(textured)
    error = np.abs(colors - waves(positions)).max(axis=1)
    assert (error > 40).mean() < 0.002
    assert textured.statistics["views_rejected_share"] > 0.01


def test_exposures_are_brought_together(tmp_path: Path) -> None:
    photos = photograph(ring(8, 3.0, 0.3), [(sphere_hit, waves)])
    gains = np.exp(np.random.default_rng(2).normal(0, 0.15, (8, 1)))
    gains /= np.exp(np.median(np.log(gains)))
    photos.images = [
        np.rint((i * g).clip(0, 255)).astype(np.uint8)
        for i, g in zip(photos.images, gains, strict=True)
    ]
    textured = run(sphere(4), photos, tmp_path)
    assert textured.statistics["exposure_corrected"]
    assert abs(textured.statistics["exposure_spread"] - np.log(gains).std()) < 0.05
    positions, colors, normals = texels(textured)
    side = np.abs(normals[:, 2]) < 0.7
    error = np.abs(colors - waves(positions))[side]
    assert error.mean() < 8.0


def test_gains_are_recovered_and_absent_ones_left_alone() -> None:
    generator = np.random.default_rng(0)
    truth = np.exp(generator.normal(0, 0.2, (6, 3)))
    truth /= np.exp(np.median(np.log(truth), axis=0))
    points = generator.uniform(60, 150, (2000, 1, 3))
    colors = np.rint((points / truth).clip(0, 255)).astype(np.uint8)
    valid = generator.random((2000, 6)) < 0.5
    colors[generator.random((2000, 6)) < 0.05] = 130
    gains, spread = solve_gains(colors, valid)
    assert np.abs(np.log(gains / truth)).max() < 0.02
    assert spread > 0.1
    same, spread = solve_gains(np.broadcast_to(points, (2000, 6, 3)).astype(np.uint8), valid)
    assert (same == 1).all()
    assert spread < 0.01
    # The texture has the exposure of most photos.
    brightness = np.array([1.0, 1.0, 1.0, 1.6, 1.6])[:, None]
    colors = np.rint(generator.uniform(20, 150, (2000, 1, 3)) * brightness).astype(np.uint8)
    gains, _ = solve_gains(colors, np.ones((2000, 5), bool))
    assert np.abs(np.log(gains * brightness)).max() < 0.02


def test_overexposed_photos_leave_no_grey_on_white(tmp_path: Path) -> None:
    def paper(points: np.ndarray) -> np.ndarray:
        return np.where(np.sin(9.0 * points[..., 2:]) > 0.0, 200.0, 70.0) * np.ones(3)

    photos = photograph(ring(9, 3.0, 0.3), [(sphere_hit, paper)])
    for i in range(0, 9, 3):
        bright = 1.7 * photos.images[i].astype(float)
        # Cameras bend the curve before it ends at white.
        bent = 205.0 + 45.0 * np.tanh((bright - 205.0) / 45.0)
        photos.images[i] = np.rint(np.where(bright < 205.0, bright, bent)).astype(np.uint8)
    textured = run(sphere(4), photos, tmp_path)
    assert textured.statistics["exposure_corrected"]
    positions, colors, normals = texels(textured)
    white = (np.abs(normals[:, 2]) < 0.6) & (np.sin(9.0 * positions[:, 2]) > 0.5)
    assert white.sum() > 1000
    assert np.percentile(np.abs(colors[white] - 200.0), 99.0) < 10.0


def automatic_size(graph: FaceGraph, photos: FakePhotos, count: int, detail_points: int = 0) -> int:
    return plan_textures(required_side(graph, photos, count, detail_points), 0, 1)[0]


def test_the_automatic_size_follows_the_photos_and_the_detail() -> None:
    graph = face_graph(sphere(4).vertices, sphere(4).faces)
    sizes = {}
    for focal in (85.0, 170.0, 340.0, 1e5):
        scale = focal / 170.0
        cameras = [
            c.resized(round(c.width * scale), round(c.height * scale)) for c in cameras_all_around()
        ]
        sizes[focal] = automatic_size(graph, FakePhotos(cameras, []), len(cameras))
    # 4 pi area; footprint about 2.3 / focal: 0.8 sqrt(4 pi / 0.5) focal / 2.3 = 1.7 focal.
    # However coarse the photos are, the faces need room.
    assert sizes == {85.0: 512, 170.0: 512, 340.0: 1024, 1e5: 4096}
    assert automatic_size(graph, FakePhotos([], []), 0) == 256
    coarse = face_graph(sphere(2).vertices, sphere(2).faces)
    afar = FakePhotos([look_at((0.0, -300.0, 0.0))], [])
    assert automatic_size(coarse, afar, 1) == 256
    assert automatic_size(coarse, afar, 1, 200_000) == 1024


@pytest.mark.parametrize(
    ("normal_map", "dense", "baked"),
    [("auto", False, False), ("auto", True, True), ("on", False, True), ("off", True, False)],
)
def test_maps_are_baked_as_settings_ask(
    tmp_path: Path, normal_map: str, dense: bool, baked: bool
) -> None:
    photos = photograph(ring(4, 3.5, 1.0), [(sphere_hit, waves)])
    settings = TextureSettings(64, 2, normal_map=normal_map)
    textured = texture_mesh(
        sphere(2), scene_of(photos), photos, settings, tmp_path, Progress(), threads=2,
        dense=sphere(4) if dense else None,
    )  # fmt: skip
    assert (textured.normal_map is not None) == baked
    assert ("normal_map" in textured.statistics) == baked
    if baked:
        assert textured.normal_map.shape == textured.albedo.shape
        told = textured.statistics["normal_map"]["dense_faces"]
        assert told == (5120 if dense else 320)


def test_photos_finer_than_the_texture_do_not_alias(tmp_path: Path) -> None:
    """A checker much finer than a texel must turn grey, not into noise."""

    def checker(points: np.ndarray) -> np.ndarray:
        odd = np.floor(points * 30.0).sum(axis=-1) % 2
        return np.repeat(np.where(odd, 220.0, 20.0)[..., None], 3, axis=-1)

    cameras = [
        look_at((3 * np.cos(a), 3 * np.sin(a), 0.0), width=400, height=300, focal=350.0)
        for a in (0.3, 1.9, 3.4, 5.0)
    ]
    low, high = [-0.8, -0.8, -0.8], [0.8, 0.8, 0.8]
    photos = photograph(cameras, [(lambda o, r: box_hit(o, r, low, high), checker)])
    textured = run(box(low, high, 2), photos, tmp_path, 64, gutter_px=1)
    positions, colors, normals = texels(textured)
    sides = (np.abs(normals[:, 2]) < 0.5) & (np.abs(positions[:, 2]) < 0.6)
    assert abs(colors[sides].mean() - 120) < 12
    assert colors[sides].std() < 25


def test_cancelling_is_obeyed_between_photos(tmp_path: Path) -> None:
    photos = photograph(ring(3, 3.0, 0.0), [(sphere_hit, waves)])
    messages: list[str] = []
    progress = Progress(
        "texture",
        lambda event: messages.append(event.message),
        lambda: any("photo 2 of 3" in m for m in messages),
    )
    with pytest.raises(Cancelled):
        texture_mesh(
            sphere(2), scene_of(photos), photos, TextureSettings(64, 2), tmp_path, progress,
            threads=1,
        )  # fmt: skip
    assert "photo 3 of 3" not in messages[-1]
    assert list(tmp_path.iterdir()) == []


def test_the_gutter_shrinks_with_the_texture() -> None:
    assert [gutter_for(side, 8) for side in (8192, 4096, 2048, 1024, 512)] == [8, 8, 4, 2, 2]
    assert gutter_for(512, 1) == 1
