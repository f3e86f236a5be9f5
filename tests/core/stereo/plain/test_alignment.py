# SPDX-License-Identifier: GPL-3.0-or-later
"""Faint texture places a plane, and tells planes that are no surface."""

from __future__ import annotations

import dataclasses
import io

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.stereo.depth_maps import DepthMap
from gaussian_wrapping_addon.core.stereo.plane_evidence import Aligner, Part, packed
from gaussian_wrapping_addon.core.stereo.plane_fitting import segments_of
from tests.core.stereo.plain.plain_room import (
    COUNT,
    FAINT_LEVELS,
    SKY,
    WALL,
    WALL_Y,
    cameras,
    depth_maps,
    near,
    noisy_maps,
    sparse_points,
    traced,
)
from tests.core.stereo.plain.test_planes import wall_plane


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


@pytest.mark.parametrize("away", [0.06, -0.06])
def test_a_plane_is_moved_to_where_the_texture_matches(away: float) -> None:
    turn = np.array([0.0, np.cos(0.008), np.sin(0.008)])
    start = wall_plane().moved(turn, float(turn @ [0.0, WALL_Y + away, 1.2]))
    found = aligner_of(depth_maps()).aligned(start, wall_parts())
    assert found is not None
    corners = np.array([[-1.5, WALL_Y, 0.3], [1.5, WALL_Y, 0.3], [1.5, WALL_Y, 2.0]])
    before = np.abs(corners @ start.normal - start.offset).max()
    after = np.abs(corners @ found.normal - found.offset).max()
    assert after < 0.55 * before


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
    corners = np.array([[-1.5, WALL_Y, 0.3], [1.5, WALL_Y, 0.3], [1.5, WALL_Y, 2.0]])
    assert np.abs(corners @ found.normal - found.offset).max() < 0.02 * WALL_Y


@pytest.mark.parametrize("noise", [1.5, 3.0, 5.0])
def test_noise_makes_no_false_plane_true(noise: float) -> None:
    aligner = aligner_of(noisy_maps(noise))
    false = wall_plane().moved(np.array([0.0, 1.0, 0.0]), 0.6 * WALL_Y)
    assert aligner.aligned(false, wall_parts(aligner.plain)) is None


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
