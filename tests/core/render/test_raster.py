# SPDX-License-Identifier: GPL-3.0-or-later
"""Contributor lists, rows cut by the image's edge, explicit vectors."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from numba.core.errors import TypingError

from gaussian_wrapping_addon.core.render.projection import RawArrays
from gaussian_wrapping_addon.core.render.raster import (
    Images,
    RenderBuffers,
    ScreenView,
    blend,
    write_intersection_gradients,
)
from gaussian_wrapping_addon.core.render.render import project_view
from gaussian_wrapping_addon.core.render.simd import ROW_VALUES, TILE, aligned_zeros
from gaussian_wrapping_addon.core.render.tile_kernels import mask_kernel
from gaussian_wrapping_addon.core.render.types import RenderOptions
from tests.core.render.scenes import look_at, random_gaussians

SIZE, BLOCK, UNTOUCHED = 48, 4, 7.0
SIZES = [(1, 1), (17, 33), (40, 1), (31, 16)]


class DirtyBuffers(RenderBuffers):
    """Scratch that never holds zeros by chance."""

    def take_scratch(self) -> np.ndarray:
        """Return scratch full of NaN."""
        scratch = aligned_zeros(len(super().take_scratch()))
        scratch[:] = np.nan
        return scratch


def whole_view(lanes: int, options: RenderOptions) -> ScreenView:
    gaussians = random_gaussians(150, seed=2, dtype=torch.float32, scale=(0.01, 0.3))
    camera = look_at((2.2, 1.0, 0.8), width=SIZE, height=SIZE, focal=45.0)
    view = project_view(RawArrays.from_gaussians(gaussians), camera, options)
    lists, screen, masks = view.lists, view.screen, np.zeros_like(view.masks)
    mask_kernel(lanes)(
        0, len(lists.start) - 1, lists.start, lists.gaussian_ids, screen.boxes, screen.skews,
        lists.tiles_x, masks,
    )  # fmt: skip
    return dataclasses.replace(view, lanes=lanes, masks=masks)


def cut_view(view: ScreenView, width: int, height: int) -> ScreenView:
    """Return the view through the same pixels of a smaller image: some tiles, cut by its edge."""
    lists = view.lists
    tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
    tiles = [y * lists.tiles_x + x for y in range(tiles_y) for x in range(tiles_x)]
    runs = [np.arange(lists.start[tile], lists.start[tile + 1]) for tile in tiles]
    chosen = np.concatenate(runs)
    # Slots stay those of the whole, so that gradients of pairs can be compared.
    smaller = dataclasses.replace(
        lists,
        start=np.cumsum([0, *(len(run) for run in runs)]),
        gaussian_ids=lists.gaussian_ids[chosen],
        intersection_slots=lists.intersection_slots[chosen],
        tiles_x=tiles_x,
        tiles_y=tiles_y,
    )
    return dataclasses.replace(
        view,
        camera=dataclasses.replace(view.camera, width=width, height=height),
        lists=smaller,
        masks=view.masks[chosen],
        bounds=np.array([0, len(tiles)]),
    )


def named(images: Images) -> dict[str, np.ndarray]:
    return {item.name: getattr(images, item.name) for item in dataclasses.fields(images)}


def blended(view: ScreenView, pairs: int) -> dict[str, np.ndarray]:
    """Blend into memory that held something, and write nothing behind any image."""
    whole, images = {}, {}
    for name, image in named(Images.allocate(view.camera, view.options)).items():
        whole[name] = np.full(image.size + 4096, UNTOUCHED, image.dtype)
        images[name] = whole[name][: image.size].reshape(image.shape)
    blend(view, Images(**images), DirtyBuffers(), np.zeros((pairs, 2), np.float32))
    for name, image in images.items():
        assert (whole[name][image.size :] == UNTOUCHED).all(), name
    return {name: image for name, image in images.items() if image.size}


def assert_same_bits(found: np.ndarray, expected: np.ndarray) -> None:
    one, other = np.ascontiguousarray(found), np.ascontiguousarray(expected)
    np.testing.assert_array_equal(one.view(np.uint32), other.view(np.uint32))


@pytest.mark.parametrize("depth", [False, True], ids=["colour", "depth"])
@pytest.mark.parametrize("lanes", [8, 16])
def test_a_cut_image_is_a_part_of_the_whole(lanes: int, depth: bool) -> None:
    options = RenderOptions(threads=1, depth=depth, statistics=True, background=(0.2, 0.5, 0.9))
    view = whole_view(lanes, options)
    pairs = len(view.lists.gaussian_ids)
    whole = blended(view, pairs)
    for image in whole.values():
        assert np.isfinite(image).all()
    assert 0.2 < whole["alpha"].mean() < 0.99
    for width, height in SIZES:
        for name, image in blended(cut_view(view, width, height), pairs).items():
            expected = whole[name][:height, :width]
            if name not in ("depth", "slope"):
                assert_same_bits(image, expected)
            elif depth:
                # The pixels of a block are solved together, so only whole blocks have equal bits.
                rows, columns = height // BLOCK * BLOCK, width // BLOCK * BLOCK
                assert_same_bits(image[:rows, :columns], expected[:rows, :columns])
                np.testing.assert_allclose(image, expected, rtol=2e-6 if name == "depth" else 2e-5)


@pytest.mark.parametrize("depth", [False, True], ids=["colour", "depth"])
@pytest.mark.parametrize("lanes", [8, 16])
def test_gradients_of_a_cut_image_are_those_of_a_part(lanes: int, depth: bool) -> None:
    view = whole_view(lanes, RenderOptions(threads=1, depth=depth))
    images = Images.allocate(view.camera, view.options)
    blend(view, images, RenderBuffers())
    random = np.random.default_rng(5)
    shape = len(view.lists.gaussian_ids), ROW_VALUES
    for width, height in SIZES:
        grads = [np.zeros_like(image) for image in graded(images)]
        for grad in grads:
            part = grad[:height, :width]
            part[:] = random.normal(size=part.shape)
        smaller, expected = cut_view(view, width, height), np.zeros(shape, np.float32)
        write_intersection_gradients(
            view, images, grads, DirtyBuffers(), expected, depth=depth, absolute=True
        )
        cut = {name: np.ascontiguousarray(a[:height, :width]) for name, a in named(images).items()}
        parts = [np.ascontiguousarray(grad[:height, :width]) for grad in grads]
        found = np.full(shape, np.nan, np.float32)
        write_intersection_gradients(
            smaller, Images(**cut), parts, DirtyBuffers(), found, depth=depth, absolute=True
        )
        slots = smaller.lists.intersection_slots
        assert width * height < 100 or np.abs(expected[slots]).max() > 0.1
        np.testing.assert_array_equal(found[slots], expected[slots])
        found[slots] = np.nan
        assert np.isnan(found).all()


def graded(images: Images) -> list[np.ndarray]:
    """Return the images that have loss gradients."""
    return [images.color, images.normal, images.geometric, images.alpha, images.depth]


def test_images_that_are_not_contiguous_are_refused() -> None:
    view = whole_view(16, RenderOptions(threads=1, depth=False))
    images = Images.allocate(view.camera, view.options)
    turned = np.zeros((3, SIZE, SIZE), np.float32).transpose(1, 2, 0)
    with pytest.raises(TypingError, match="contiguous"):
        blend(view, dataclasses.replace(images, color=turned), RenderBuffers())
