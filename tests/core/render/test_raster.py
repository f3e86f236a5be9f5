# SPDX-License-Identifier: GPL-3.0-or-later
"""Contributor lists, rows cut by the image's edge, explicit vectors."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numba
import numpy as np
import pytest
import torch
from numba.core import cgutils, types
from numba.core.errors import TypingError
from numba.extending import intrinsic

from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.render.projection import RawArrays
from gaussian_wrapping_addon.core.render.raster import (
    Images,
    RenderBuffers,
    ScreenView,
    blend,
    write_intersection_gradients,
)
from gaussian_wrapping_addon.core.render.render import project_view
from gaussian_wrapping_addon.core.render.simd import ROW_VALUES, TILE, Block, State, aligned_zeros
from gaussian_wrapping_addon.core.render.tile_io import (
    CONTRIBUTORS_PADDING,
    active_blocks,
    list_contributors,
)
from gaussian_wrapping_addon.core.render.tile_kernels import mask_kernel
from gaussian_wrapping_addon.core.render.types import RenderOptions
from tests.core.render.scenes import look_at, random_gaussians

BEGIN, SPARE = 37, -5


@numba.njit
def _run(lanes, masks, begin, count, room, contributors, counts):  # type: ignore[no-untyped-def]
    if lanes == 16:
        list_contributors(16, masks, begin, count, room, contributors, counts)
    else:
        list_contributors(8, masks, begin, count, room, contributors, counts)


def _masks(kind: str, total: int, bits: int) -> np.ndarray:
    random = np.random.default_rng(total)
    if kind == "none":
        return np.zeros(total, np.uint32)
    if kind == "all":
        return np.full(total, (1 << bits) - 1, np.uint32)
    return random.integers(0, 1 << bits, total, dtype=np.uint32)


@pytest.mark.parametrize("lanes", [8, 16])
@pytest.mark.parametrize("kind", ["none", "all", "random"])
@pytest.mark.parametrize("count", [0, 1, 15, 16, 17, 100])
def test_lists(lanes: int, kind: str, count: int) -> None:
    blocks, room = 256 // lanes, count + CONTRIBUTORS_PADDING
    # The masks end with the tile's last pair: nothing behind it may be read.
    masks: Any = _masks(kind, BEGIN + count, blocks)
    contributors = np.full(blocks * room + 8, SPARE, np.int32)
    counts = np.full(blocks, SPARE, np.int64)
    _run(lanes, masks, BEGIN, count, room, contributors, counts)
    for block in range(blocks):
        expected = BEGIN + np.flatnonzero((masks[BEGIN:] >> np.uint32(block)) & 1)
        assert counts[block] == len(expected)
        np.testing.assert_array_equal(contributors[block * room :][: len(expected)], expected)
    assert (contributors[blocks * room :] == SPARE).all()


@numba.njit
def _lit(lanes, m, plane):  # type: ignore[no-untyped-def]
    return active_blocks(16, m, plane) if lanes == 16 else active_blocks(8, m, plane)


@pytest.mark.parametrize("lanes", [8, 16])
def test_lit_blocks(lanes: int) -> None:
    random = np.random.default_rng(3)
    threshold = np.float32(limits.TRANSMITTANCE_MIN)
    below = np.nextafter(threshold, np.float32(0))
    for _ in range(20):
        light = np.full((256 // lanes, lanes), below, np.float32)
        chosen = random.uniform(size=len(light)) < 0.4
        light[chosen, random.integers(lanes, size=chosen.sum())] = threshold
        m = np.concatenate([np.ones(11, np.float32), light.ravel(), np.ones(16, np.float32)])
        assert _lit(lanes, m, 11) == sum(1 << int(block) for block in np.flatnonzero(chosen))


SIZES = [(1, 1), (17, 33), (40, 1), (31, 16), (16, 5)]


WIDTH, HEIGHT = 48, 48


BLOCK = 4


UNTOUCHED = 7.0


class DirtyBuffers(RenderBuffers):
    """Scratch that never holds zeros by chance."""

    def take_scratch(self) -> np.ndarray:
        """Return scratch full of NaN."""
        scratch = aligned_zeros(len(super().take_scratch()))
        scratch[:] = np.nan
        return scratch


def whole_view(lanes: int, options: RenderOptions) -> ScreenView:
    gaussians = random_gaussians(150, seed=2, dtype=torch.float32, scale=(0.01, 0.3))
    camera = look_at((2.2, 1.0, 0.8), width=WIDTH, height=HEIGHT, focal=45.0)
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


def room_for_weights(whole: ScreenView) -> np.ndarray:
    return np.zeros((len(whole.lists.gaussian_ids), 2), np.float32)


def dirty_images(view: ScreenView) -> Images:
    images = Images.allocate(view.camera, view.options)
    for item in dataclasses.fields(images):
        getattr(images, item.name).fill(UNTOUCHED)
    return images


def assert_same_bits(found: np.ndarray, expected: np.ndarray) -> None:
    assert found.shape == expected.shape
    one, other = np.ascontiguousarray(found), np.ascontiguousarray(expected)
    np.testing.assert_array_equal(one.view(np.uint32), other.view(np.uint32))


def named(images: Images) -> dict[str, np.ndarray]:
    arrays = {item.name: getattr(images, item.name) for item in dataclasses.fields(images)}
    return {name: array for name, array in arrays.items() if array.size}


@pytest.mark.parametrize("depth", [False, True], ids=["colour", "depth"])
@pytest.mark.parametrize("lanes", [8, 16])
def test_a_cut_image_is_a_part_of_the_whole(lanes: int, depth: bool) -> None:
    options = RenderOptions(threads=1, depth=depth, statistics=True, background=(0.2, 0.5, 0.9))
    view = whole_view(lanes, options)
    whole = dirty_images(view)
    blend(view, whole, DirtyBuffers())
    for image in named(whole).values():
        assert np.isfinite(image).all()
    assert 0.2 < whole.alpha.mean() < 0.99
    for width, height in SIZES:
        smaller = cut_view(view, width, height)
        images = dirty_images(smaller)
        blend(smaller, images, DirtyBuffers(), room_for_weights(view))
        for name, image in named(images).items():
            expected = named(whole)[name][:height, :width]
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
        cut = {name: np.ascontiguousarray(a[:height, :width]) for name, a in _all(images).items()}
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


def _all(images: Images) -> dict[str, np.ndarray]:
    return {item.name: getattr(images, item.name) for item in dataclasses.fields(images)}


@pytest.mark.parametrize("lanes", [8, 16])
def test_nothing_is_written_beyond_a_cut_image(lanes: int) -> None:
    options = RenderOptions(threads=1, depth=True, statistics=True)
    whole = whole_view(lanes, options)
    view = cut_view(whole, 17, 18)
    images, kept = dirty_images(view), {}
    for name, image in named(images).items():
        kept[name] = np.full(image.size + 4096, UNTOUCHED, image.dtype)
        kept[name][: image.size] = 0
    framed = Images(
        **{
            **_all(images),
            **{
                name: kept[name][: image.size].reshape(image.shape)
                for name, image in named(images).items()
            },
        }
    )
    blend(view, framed, DirtyBuffers(), room_for_weights(whole))
    for name, image in named(images).items():
        assert (kept[name][image.size :] == UNTOUCHED).all(), name


def test_images_that_are_not_contiguous_are_refused() -> None:
    view = whole_view(16, RenderOptions(threads=1, depth=False))
    images = Images.allocate(view.camera, view.options)
    turned = np.zeros((3, HEIGHT, WIDTH), np.float32).transpose(1, 2, 0)
    with pytest.raises(TypingError, match="contiguous"):
        blend(view, dataclasses.replace(images, color=turned), RenderBuffers())


def test_no_gradient_without_a_loss() -> None:
    # A tile of which one pixel is in the image: fifteen rows are read with no live column.
    view = cut_view(whole_view(16, RenderOptions(threads=1, depth=True)), 1, 1)
    images = Images.allocate(view.camera, view.options)
    blend(view, images, RenderBuffers())
    grads = [np.zeros_like(image) for image in graded(images)]
    slots = view.lists.intersection_slots
    pairs = np.full((slots.max() + 1, ROW_VALUES), np.nan, np.float32)
    write_intersection_gradients(
        view, images, grads, DirtyBuffers(), pairs, depth=True, absolute=False
    )
    assert len(slots)
    assert not pairs[slots].any()


def _unary(lanes: int, body: Any) -> Any:
    """Compile ``out[:lanes] = body(values[:lanes])``."""

    @intrinsic
    def apply(typingctx, values, out):  # type: ignore[no-untyped-def]
        def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
            block = Block(lanes, context, builder)
            source = block.data(sig.args[0], args[0])
            block.store(
                body(block, block.load(source, block.index(0)), source),
                block.data(sig.args[1], args[1]),
                block.index(0),
            )
            return context.get_dummy_value()

        return types.void(values, out), generate

    @numba.njit
    def run(values, out):  # type: ignore[no-untyped-def]
        apply(values, out)

    def call(values: np.ndarray) -> np.ndarray:
        out = np.zeros(lanes, np.float32)
        run(np.ascontiguousarray(values, np.float32), out)
        return out

    return call


@pytest.mark.parametrize("lanes", [8, 16])
def test_logarithm(lanes: int) -> None:
    log = _unary(lanes, lambda block, x, _: x.log())
    random = np.random.default_rng(0)
    for scale in (1e-30, 1e-3, 1.0, 1e3, 1e30):
        x = (scale * random.uniform(0.5, 2.0, lanes)).astype(np.float32)
        exact = np.log(x.astype(np.float64))
        assert np.abs(log(x) - exact).max() <= 2e-7 * max(1.0, np.abs(exact).max())
    near_one = (1.0 + random.uniform(-1e-3, 1e-3, lanes)).astype(np.float32)
    assert np.abs(log(near_one) - np.log(near_one.astype(np.float64))).max() < 1e-9


@pytest.mark.parametrize("lanes", [8, 16])
def test_arithmetic_and_choices(lanes: int) -> None:
    x = np.random.default_rng(1).normal(size=lanes).astype(np.float32)
    root = _unary(lanes, lambda block, v, _: (v * v + 1.0).sqrt())
    np.testing.assert_allclose(root(x), np.sqrt(x.astype(np.float64) ** 2 + 1), rtol=1e-6)
    np.testing.assert_array_equal(_unary(lanes, lambda b, v, _: v.abs())(x), np.abs(x))
    np.testing.assert_array_equal(
        _unary(lanes, lambda b, v, _: v.max(0.25).min(0.5))(x), x.clip(0.25, 0.5)
    )
    chosen = _unary(lanes, lambda b, v, _: ((v > 0.0) & ~(v >= 1.0)).select(2.0, v))(x)
    np.testing.assert_array_equal(chosen, np.where((x > 0) & (x < 1), np.float32(2), x))
    np.testing.assert_allclose(_unary(lanes, lambda b, v, _: 1.0 / v)(x), 1.0 / x, rtol=1e-6)


@pytest.mark.parametrize("lanes", [8, 16])
def test_totals_of_many_vectors(lanes: int) -> None:
    count = lanes + 3

    def body(block: Block, first: Any, source: Any) -> Any:
        vectors = [block.load(source, block.index(k * lanes)) for k in range(count)]
        sums = block.totals(vectors)
        assert len(sums) == 2
        return sums[1]

    values = np.random.default_rng(2).normal(size=(count, lanes)).astype(np.float32)
    found = _unary(lanes, body)(values.reshape(-1))
    np.testing.assert_allclose(found[:3], values[lanes:].sum(1), rtol=1e-5, atol=1e-6)
    assert not found[3:].any()


@pytest.mark.parametrize("lanes", [8, 16])
def test_loops_keep_their_state(lanes: int) -> None:
    def body(block: Block, x: Any, source: Any) -> Any:
        total, builder = State(block, 0.0), block.builder
        place = cgutils.alloca_once_value(builder, block.index(0))

        def add(index: Any) -> Any:
            total.set(total.get() + x)
            return builder.icmp_signed("<", index, block.index(4))  # five turns: 0 to 4

        always = builder.icmp_signed("==", block.index(0), block.index(0))
        block.walk(place, block.index(100), add, lambda _: always)
        block.walk(place, block.index(7), lambda _: add(_) and always, lambda _: always)
        block.each_bit(block.index(0b1011), lambda bit: add(bit) and None)
        block.repeat(block.index(10), lambda _: total.set(total.get() + 1.0) or total.get() < 1e3)
        return total.get()

    x = np.linspace(1.0, 2.0, lanes).astype(np.float32)
    # Five turns, two more up to 7, three bits, then ten times 1.
    np.testing.assert_allclose(_unary(lanes, body)(x), 10.0 * x + 10.0, rtol=1e-6)
    # Lanes beyond 1000 end the last loop only together.
    np.testing.assert_allclose(_unary(lanes, body)(1e3 * x), 1e4 * x + 1.0, rtol=1e-6)
    assert math.isfinite(float(_unary(lanes, body)(x).sum()))
