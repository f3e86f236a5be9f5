# SPDX-License-Identifier: GPL-3.0-or-later
"""Planes through plain parts: evidence of other photos, alignment."""

from __future__ import annotations

import dataclasses
import io

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.stereo.depth_maps import DepthMap
from gaussian_wrapping_addon.core.stereo.plane_evidence import (
    AGREEING_SHARE,
    ALIKE_LEVELS,
    NEARER,
    THROUGH_SHARE,
    UNLIKE,
    Aligner,
    Part,
    correlate,
    count_votes,
    packed,
)
from gaussian_wrapping_addon.core.stereo.plane_fitting import Plane, segments_of
from tests.core.stereo.plain_room import (
    COUNT,
    FAINT_LEVELS,
    SKY,
    WALL,
    WALL_Y,
    cameras,
    depth_map,
    depth_maps,
    near,
    noisy_maps,
    sparse_points,
    traced,
    with_noise,
)
from tests.core.stereo.test_plane_fitting import wall_plane

# -- Points looked up in other photos, against numpy ----------------------------------------------


def looked_up(photos, other: int, points: np.ndarray):
    pixels, depth = cameras()[other].project(points)
    inside = (depth > 0) & (pixels >= 0).all(1) & (pixels < photos.sizes[other]).all(1)
    column, row = pixels[inside].astype(int).T
    return inside, depth[inside], photos.depths[other][row, column], (row, column)


def test_votes_are_those_of_numpy() -> None:
    photos = packed(depth_maps(), np.random.default_rng(0))
    random = np.random.default_rng(1)
    points = random.uniform((-2, 0.5, 0), (2, 3.2, 2.4), (3000, 3))
    colors = (random.integers(120, 160, (3000, 1)) * [1.0, 0.97, 0.93]).astype(np.uint8)
    expected = np.zeros((3000, 5), int)
    others = np.array([0, 2, 3, 5])
    for other in others[1:]:  # 0 is the points' own photo
        inside, depth, known, at = looked_up(photos, other, points)
        ratio = np.where(known > 0, known / depth, 1.0)
        difference = np.abs(photos.images[other][at].astype(int) - colors[inside]).max(-1)
        agree = (known > 0) & (np.abs(ratio - 1) < AGREEING_SHARE)
        rows = [
            agree,
            (known == 0) & (difference < ALIKE_LEVELS),
            ~agree & (ratio > 1 + THROUGH_SHARE),
            (known == 0) & (difference >= ALIKE_LEVELS),
            ~agree & (ratio < 1 - THROUGH_SHARE),
        ]
        expected[inside] += np.stack(rows, 1)
    counts = np.zeros((3000, 5), np.int32)
    count_votes(
        points, colors, 0, others, photos.projections, photos.sizes, photos.depths, photos.images,
        AGREEING_SHARE, counts,
    )  # fmt: skip
    assert expected.sum(0).min() > 20
    assert np.array_equal(counts, expected)


def test_correlation_is_one_for_the_same_texture_and_ignores_what_is_not_plain() -> None:
    photos = packed(depth_maps(), np.random.default_rng(0))
    random = np.random.default_rng(2)
    points = random.uniform((-1, 2.5, 0.5), (1, 3.0, 1.8), (500, 3))
    row, column = np.mgrid[: photos.depths.shape[1], : photos.depths.shape[2]]
    texture = np.sin(0.2 * column + 0.1 * row).astype(np.float32)
    textures = np.stack([texture] * len(cameras()))
    pixels = cameras()[4].project(points)[0] - 0.5
    values = np.sin(0.2 * pixels[:, 0] + 0.1 * pixels[:, 1]).astype(np.float32)
    rest = (photos.projections, photos.sizes)
    total, count = correlate(points, values, np.array([4]), *rest, textures, 4.0)
    assert count > 300
    assert total / count > 0.999
    opposite, _ = correlate(points, -values, np.array([4]), *rest, textures, 4.0)
    assert abs(opposite + total) < 1e-6 * count
    textures[4] = np.nan
    assert correlate(points, values, np.array([4]), *rest, textures, 4.0) == (0.0, 0)


# -- What other photos say about points on a plane ------------------------------------------------


def wall_pixels(view: int) -> tuple[np.ndarray, np.ndarray]:
    depth, part, _ = traced(cameras()[view])
    row, column = np.nonzero(part == WALL)
    return np.stack([column, row], 1).astype(float)[::7], 1.0 / depth[row, column][::7]


def test_the_true_plane_is_not_contradicted_and_others_are() -> None:
    photos = packed(depth_maps(), np.random.default_rng(0))
    for view in range(len(cameras())):
        pixels, inverse = wall_pixels(view)
        true = photos.votes(view, pixels, inverse)
        assert true.like > 0.97
        assert true.through < 0.005
        near = photos.votes(view, pixels, inverse / 0.6)
        assert near.like < true.like - 0.1
        assert near.through > 0.015


def test_planes_behind_the_camera_are_not_voted_for() -> None:
    photos = packed(depth_maps(), np.random.default_rng(0))
    pixels, inverse = wall_pixels(0)
    votes = photos.votes(0, pixels, -inverse)
    assert (votes.like, votes.through) == (0.0, 1.0)


def test_counts_tell_hidden_points_and_other_colours() -> None:
    photos = packed(depth_maps(), np.random.default_rng(0))
    pixels, inverse = wall_pixels(2)
    behind = photos.counts(2, pixels, inverse * 0.5).sum(0)
    assert behind[NEARER] > 0
    near = photos.counts(2, pixels, inverse / 0.5).sum(0)
    assert near[UNLIKE] > 0.05 * near.sum()


def test_a_photo_is_not_asked_about_itself() -> None:
    photos = packed(depth_maps()[:2], np.random.default_rng(0))
    pixels, inverse = wall_pixels(0)
    assert photos.counts(0, pixels, inverse).sum(1).max() <= 1


def test_gains_are_taken_out() -> None:
    gains = np.linspace(0.8, 1.1, len(cameras()))
    changed = [depth_map(camera, gain) for camera, gain in zip(cameras(), gains, strict=True)]
    levels = []
    for maps in (depth_maps(), changed):
        photos = packed(maps, np.random.default_rng(0))
        parts = [traced(camera)[1] for camera in cameras()]
        levels.append([photos.images[v][p == WALL].mean() for v, p in enumerate(parts)])
    assert np.std(levels[1]) < 0.02 * np.mean(levels[1])
    assert np.std([m.color[traced(m.camera)[1] == WALL].mean() for m in changed]) > 10


def test_known_depths_can_be_exchanged() -> None:
    photos = packed(depth_maps(), np.random.default_rng(0))
    nothing = photos.with_depths(np.zeros_like(photos.depths))
    pixels, inverse = wall_pixels(0)
    assert nothing.votes(0, pixels, inverse).through == 0.0
    assert nothing.images is photos.images


# -- Faint texture places a plane, and tells planes that are no surface ---------------------------


def aligner_of(maps) -> Aligner:
    photos = packed(maps, np.random.default_rng(0))
    segments = segments_of(maps, sparse_points())
    return Aligner(photos, segments, np.random.default_rng(0), Progress())


def wall_parts(plain: np.ndarray | None = None) -> list[Part]:
    """Return the pixels of the wall in each photo, or those of them that are plain."""
    parts = []
    for view, camera in enumerate(cameras()):
        part = traced(camera)[1]
        inner = (part == WALL) & ~near(part != WALL, 4)
        row, column = np.nonzero(inner if plain is None else inner & plain[view])
        parts.append(Part(view, np.stack([column, row], 1).astype(float)))
    return parts


def off_the_wall(plane: Plane) -> float:
    """Return the largest distance of a plane to three corners of the wall."""
    corners = np.array([[-1.5, WALL_Y, 0.3], [1.5, WALL_Y, 0.3], [1.5, WALL_Y, 2.0]])
    return float(np.abs(corners @ plane.normal - plane.offset).max())


@pytest.mark.parametrize("away", [0.06, -0.06])
def test_a_plane_is_moved_to_where_the_texture_matches(away: float) -> None:
    turn = np.array([0.0, np.cos(0.008), np.sin(0.008)])
    start = wall_plane().moved(turn, float(turn @ [0.0, WALL_Y + away, 1.2]))
    found = aligner_of(depth_maps()).aligned(start, wall_parts())
    assert found is not None
    assert off_the_wall(found) < 0.55 * off_the_wall(start)


def test_a_plane_far_from_the_surface_is_none() -> None:
    start = wall_plane().moved(np.array([0.0, 1.0, 0.0]), 0.6 * WALL_Y)
    assert aligner_of(depth_maps()).aligned(start, wall_parts()) is None


@pytest.mark.parametrize("noise", [1.5, 3.0, 5.0])
def test_noise_makes_no_true_plane_false(noise: float) -> None:
    """Texture of 1.2 levels correlates hardly at all beneath noise of 3, pixel by pixel."""
    aligner = aligner_of(noisy_maps(noise))
    parts = wall_parts(aligner.plain)
    found = aligner.aligned(wall_plane(), parts)
    assert found is not None
    assert off_the_wall(found) < 0.02 * WALL_Y


@pytest.mark.parametrize("noise", [1.5, 3.0, 5.0])
def test_noise_makes_no_false_plane_true(noise: float) -> None:
    aligner = aligner_of(noisy_maps(noise))
    false = wall_plane().moved(np.array([0.0, 1.0, 0.0]), 0.6 * WALL_Y)
    assert aligner.aligned(false, wall_parts(aligner.plain)) is None


def blotched_maps(level: float) -> list[DepthMap]:
    """Return the maps with noise in blotches, as denoising leaves it: little in single pixels."""
    random, found = np.random.default_rng(12), []
    for clean in depth_maps():
        noise = ndimage.gaussian_filter(random.normal(size=clean.depth.shape), 2.0)
        found.append(with_noise(clean, (level / noise.std() * noise)[..., None]))
    return found


@pytest.mark.parametrize("level", [1.8, 2.0])
def test_a_plane_that_matches_better_than_its_surroundings_stays(level: float) -> None:
    aligner = aligner_of(blotched_maps(level))
    parts = wall_parts(aligner.plain)
    found = aligner.aligned(wall_plane(), parts)
    assert found is not None
    assert off_the_wall(found) < 0.02 * WALL_Y
    assert sum(aligner.contradicts(wall_plane(), part) for part in parts) <= len(parts) // 2
    false = wall_plane().moved(np.array([0.0, 1.0, 0.0]), 0.6 * WALL_Y)
    assert aligner.aligned(false, parts) is None
    assert sum(aligner.contradicts(false, part) for part in parts) >= len(parts) - 1
    assert aligner.aligned(wall_plane(), parts[:2]) is None, "two photos may agree by chance"


def test_parts_on_a_false_plane_are_contradicted() -> None:
    aligner, false = aligner_of(depth_maps()), wall_plane(0.6 * WALL_Y)
    parts = wall_parts()
    assert not any(aligner.contradicts(wall_plane(), part) for part in parts)
    assert sum(aligner.contradicts(false, part) for part in parts) >= len(parts) - 1
    few = Part(0, parts[0].pixels[:50])
    assert not aligner.contradicts(false, few)


def test_a_sky_beside_the_wall_is_not_its_texture() -> None:
    aligner = aligner_of(depth_maps())
    for view, camera in enumerate(cameras()):
        part = traced(camera)[1]
        for texture in aligner.textures:
            values = texture[view][(part == WALL) & aligner.plain[view]]
            assert np.abs(values).max() < 3.0 * FAINT_LEVELS


def without_texture(maps: list[DepthMap], noise: list[float]) -> list[DepthMap]:
    """Return the maps with a wall of one colour and noise, and a saturated sky, in the photos."""
    found = []
    for number, (one, level) in enumerate(zip(maps, noise, strict=True)):
        part, color = traced(one.camera)[1], one.color.copy()
        random = np.random.default_rng(number)
        flat = np.array([140, 136, 130]) + level * random.normal(size=(*part.shape, 3))
        color[part == WALL] = np.rint(flat).astype(np.uint8)[part == WALL]
        color[part == SKY] = 255
        found.append(dataclasses.replace(one, color=color))
    return found


def as_jpeg(photo: np.ndarray) -> np.ndarray:
    into = io.BytesIO()
    Image.fromarray(photo).save(into, "JPEG", quality=90)
    return np.asarray(Image.open(into))


def smoothed(photo: np.ndarray) -> np.ndarray:
    """Return a photo as one of twice the size made smaller has its noise: without the finest."""
    smooth = ndimage.gaussian_filter(photo.astype(np.float32), (0.4, 0.4, 0))
    return np.rint(smooth).astype(np.uint8)


@pytest.mark.parametrize(
    "noise", [[0.0] * COUNT, [1.5] * COUNT, [3.0] * COUNT, [0.7, 3.0] * (COUNT // 2)]
)
def test_without_texture_a_plane_stays(noise: list[float]) -> None:
    start = wall_plane(WALL_Y + 0.05)
    aligner = aligner_of(without_texture(noisy_maps(0.0), noise))
    parts = wall_parts(aligner.plain)
    assert aligner.aligned(start, parts) is start
    assert not any(aligner.contradicts(start, part) for part in parts)


@pytest.mark.parametrize("processed", [as_jpeg, smoothed], ids=["jpeg", "resized"])
def test_without_texture_a_plane_stays_in_processed_photos(processed) -> None:
    """JPEG and resizing leave little noise in single pixels, and most of that in the bands."""
    maps = [
        dataclasses.replace(found, color=processed(found.color))
        for found in without_texture(noisy_maps(0.0), [3.0] * COUNT)
    ]
    start, aligner = wall_plane(WALL_Y + 0.05), aligner_of(maps)
    parts = wall_parts(aligner.plain)
    assert aligner.aligned(start, parts) is start
    assert not any(aligner.contradicts(start, part) for part in parts)


@pytest.mark.parametrize("exposures", [[1.0, 0.4] * (COUNT // 2), [1.0] * (COUNT - 2) + [0.4] * 2])
def test_noise_of_dark_photos_is_that_of_their_brightened_textures(exposures: list[float]) -> None:
    random = np.random.default_rng(5)
    maps = []
    for found, exposure in zip(
        without_texture(noisy_maps(0.0), [0.0] * COUNT), exposures, strict=True
    ):
        color = exposure * found.color + 3.0 * random.normal(size=found.color.shape)
        maps.append(
            dataclasses.replace(found, color=np.clip(np.rint(color), 0, 255).astype(np.uint8))
        )
    start, aligner = wall_plane(WALL_Y + 0.05), aligner_of(maps)
    parts = wall_parts(aligner.plain)
    assert aligner.aligned(start, parts) is start
    assert not any(aligner.contradicts(start, part) for part in parts)


@pytest.mark.parametrize("factor", [0.75, 0.85, 1.2])
def test_shading_makes_no_false_plane_true(factor: float) -> None:
    maps = []
    for found in noisy_maps(3.0):
        part, points = traced(found.camera)[1:]
        ramp = np.where(part == WALL, 6.0 * np.where(part == WALL, points[..., 0], 0.0), 0.0)
        color = np.clip(found.color + np.rint(ramp)[..., None], 0, 255).astype(np.uint8)
        maps.append(dataclasses.replace(found, color=color))
    aligner = aligner_of(maps)
    parts = wall_parts(aligner.plain)
    assert aligner.aligned(wall_plane(), parts) is not None
    false = wall_plane().moved(np.array([0.0, 1.0, 0.0]), factor * WALL_Y)
    assert aligner.aligned(false, parts) is None


def test_small_parts_do_not_move_a_plane() -> None:
    parts = [Part(part.view, part.pixels[:50]) for part in wall_parts()]
    start = wall_plane(WALL_Y + 0.05)
    assert aligner_of(depth_maps()).aligned(start, parts) is start
