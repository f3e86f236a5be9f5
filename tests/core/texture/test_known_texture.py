# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos of spot with a known texture, rendered by rays: the bake must bring the texture back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("embreex")

from benchmarks.known_texture import (
    RenderedPhotos,
    SolidTexture,
    all_steps,
    cameras_around,
    photograph,
    photos_that_see,
    psnr,
    seams,
    spot,
    steps_between_texels,
    true_albedo,
    uneven,
)
from gaussian_wrapping_addon.core.mesh.textured_mesh import TexturedMesh
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.settings import TextureSettings
from gaussian_wrapping_addon.core.texture import bake
from gaussian_wrapping_addon.core.texture.atlas import raster_atlas
from gaussian_wrapping_addon.core.texture.texture_mesh import texture_mesh

SIZE_PX = 512


def textured_spot(photos: RenderedPhotos, folder: Path) -> TexturedMesh:
    settings = TextureSettings(size_px=SIZE_PX)
    return texture_mesh(spot(), photos.scene(), photos, settings, folder, Progress(), threads=2)


@pytest.fixture(scope="module")
def pattern() -> SolidTexture:
    return SolidTexture()


@pytest.fixture(scope="module")
def photos(pattern: SolidTexture) -> RenderedPhotos:
    return photograph(spot(), pattern, cameras_around(16, 400, 300), 2)


@pytest.fixture(scope="module")
def baked(photos: RenderedPhotos, tmp_path_factory: pytest.TempPathFactory) -> TexturedMesh:
    return textured_spot(photos, tmp_path_factory.mktemp("known"))


def mean_of_largest_steps(textured: TexturedMesh, texels_apart: int, share: float) -> float:
    """Return the mean of the largest steps; finer than a percentile, a whole number of 255."""
    steps = np.sort(all_steps(textured, texels_apart))
    return float(steps[-max(1, int(share * len(steps))) :].mean())


def test_the_texture_comes_back(
    baked: TexturedMesh, photos: RenderedPhotos, pattern: SolidTexture
) -> None:
    truth, known = true_albedo(baked, pattern)
    seen = known & (baked.views > 0)
    assert psnr(baked.albedo[seen] - truth[seen]) > 31.0
    places = np.flatnonzero(known)
    often = photos_that_see(baked, photos.cameras, places) >= 2
    assert often.mean() > 0.9
    # Every texel that two photos show has colours of photos.
    assert (baked.views.ravel()[places[often]] > 0).all()
    twice = places[often]
    assert psnr(baked.albedo.reshape(-1, 3)[twice] - truth.reshape(-1, 3)[twice]) > 33.0
    assert baked.statistics["texels_overlapping"] == 0


def test_borders_of_charts_do_not_show(
    baked: TexturedMesh, photos: RenderedPhotos, pattern: SolidTexture
) -> None:
    owner = raster_atlas(baked.corner_uvs, SIZE_PX, 2).face.ravel()
    texels = np.flatnonzero(owner >= 0)
    seldom = photos_that_see(baked, photos.cameras, texels) < 3
    seen = np.ones(len(baked.mesh.faces), bool)
    seen[owner[texels[seldom]]] = False
    assert seen.mean() > 0.6
    found = seams(baked, pattern, seen)
    # The texture itself changes as much over half a texel here as there.
    assert abs(found.across_true / found.inside_true - 1.0) < 0.1
    assert found.across < 1.1 * found.inside
    assert found.error_across < 1.1 * found.error_inside
    # Where the two look-ups at a border differ, it is by less than what is blurred anywhere.
    assert found.gap < 0.6 * found.error_inside


@pytest.mark.proof
def test_leading_views_leave_no_borders_where_brightness_is_uneven(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def grey(points: np.ndarray) -> np.ndarray:
        return np.full((len(points), 3), 140.0)

    photos = photograph(spot(), grey, cameras_around(16, 320, 240), 1, uneven)
    after = textured_spot(photos, tmp_path)
    assert after.statistics["brightness_evened_within_photos"]
    monkeypatch.setattr(
        bake, "solve_low_frequency_correction", lambda c, v, p, g: (np.ones((16, 1, 1, 3)), 0.0)
    )
    before = textured_spot(photos, tmp_path)
    # Farther apart than one texel: there rounding to 8 bits is as large.
    assert steps_between_texels(after, 4) <= 4.0
    assert steps_between_texels(after, 4) <= 0.5 * steps_between_texels(before, 4)
    largest = [mean_of_largest_steps(textured, 4, 0.01) for textured in (after, before)]
    assert largest[0] < 0.5 * largest[1]
