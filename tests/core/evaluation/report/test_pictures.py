# SPDX-License-Identifier: GPL-3.0-or-later
"""Strips of photo, rendering and error; plots; sizes in world units."""

from __future__ import annotations

import io
import math
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gaussian_wrapping_addon.core.evaluation.report.pictures import (
    CAPTION_PX,
    ERROR_GAIN,
    GAP_PX,
    error_map,
    heat_colors,
    strip,
    worst_to_best,
    write_held_out,
    write_learning_curve,
)
from gaussian_wrapping_addon.core.evaluation.report.region_section import sizes_in_world
from gaussian_wrapping_addon.core.image_metrics import psnr
from gaussian_wrapping_addon.core.render.projection import RawArrays
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.render.view_renderer import ViewRenderer
from gaussian_wrapping_addon.core.scene.camera import Similarity
from tests.core.training.small_scene import sphere_gaussians, sphere_scene

SVG = "{http://www.w3.org/2000/svg}"


def test_error_map_is_black_without_error_and_outside_of_the_mask() -> None:
    photo = np.full((4, 6, 3), 128, np.uint8)
    rendering = photo / 255.0
    rendering[1, 2] += 1.0 / ERROR_GAIN  # the end of the scale
    rendering[2, 3, 0] += 0.375 / ERROR_GAIN * 3  # one channel: a third of it counts
    rendering[3, 3] += 1.0
    mask = np.ones((4, 6), bool)
    mask[3, 3] = False
    shown = error_map(photo, rendering, mask)
    assert np.array_equal(shown[1, 2], heat_colors(np.ones((1, 1)))[0, 0])
    assert np.array_equal(shown[2, 3], heat_colors(np.full((1, 1), 0.375))[0, 0])
    shown[1, 2] = shown[2, 3] = 0
    assert (shown == 0).all()
    brightness = heat_colors(np.linspace(-0.5, 1.5, 201)[None])[0] @ [0.299, 0.587, 0.114]
    assert (np.diff(brightness) >= -0.5).all()


@pytest.mark.parametrize(("width", "shown"), [(100, 100), (1000, 496)])
def test_strip_puts_the_images_side_by_side(width: int, shown: int) -> None:
    tones = (40, 120, 220)
    images = [(str(t), np.full((80, width, 3), t, np.uint8)) for t in tones]
    picture = np.asarray(Image.open(io.BytesIO(strip(images)))).astype(int)
    size = CAPTION_PX + round(80 * shown / width), 3 * shown + 2 * GAP_PX, 3
    assert picture.shape == size
    for index, tone in enumerate(tones):
        left = index * (shown + GAP_PX)
        inside = picture[CAPTION_PX + 4 : -4, left + 4 : left + shown - 4]
        assert np.abs(inside - tone).max() <= 4


def test_worst_comes_first_and_best_last() -> None:
    assert worst_to_best([5.0, 1.0, 9.0, 3.0, 7.0, 2.0]) == [1, 3, 0, 2]
    assert worst_to_best([5.0, 1.0]) == [1, 0]
    assert worst_to_best([]) == []


def test_held_out_strips_show_what_was_measured(tmp_path: Path) -> None:
    size_px, indices = 96, [1, 4, 6]
    scene, photos = sphere_scene(views=8, size_px=size_px)
    gaussians = sphere_gaussians(opacity=0.4)  # paler than what the photos show
    renderer, raw = ViewRenderer(), RawArrays.from_gaussians(gaussians)
    options = RenderOptions(depth=False, threads=1)
    images = {  # copied: the renderer uses its memory again
        i: np.clip(renderer.render(raw, photos.camera(i, 1), options).color, 0.0, 1.0)
        for i in indices
    }
    views = [(i, scene.views[i].camera.name, psnr(images[i], photos.photo(i))) for i in indices]
    written = write_held_out(gaussians, photos, views, tmp_path, threads=1)
    assert [w["file"] for w in written] == sorted(p.name for p in tmp_path.iterdir())
    assert [w["psnr"] for w in written] == sorted(p for _, _, p in views)
    by_name = {name: i for i, name, _ in views}
    for entry in written:
        index = by_name[entry["name"]]
        strip_px = np.asarray(Image.open(tmp_path / entry["file"])).astype(float)[CAPTION_PX:]
        assert strip_px.shape == (size_px, 3 * size_px + 2 * GAP_PX, 3)
        photo = photos.photo(index)
        for column, wanted in enumerate((
            photo, 255.0 * images[index], error_map(photo, images[index]),
        )):  # fmt: skip
            left = column * (size_px + GAP_PX)
            away = np.abs(strip_px[:, left : left + size_px] - wanted)
            assert away.mean() < 4.0  # JPEG
        assert np.abs(255.0 * images[index] - photo).mean() > 10.0  # or the columns look alike


def test_learning_curve_shows_every_entry(tmp_path: Path) -> None:
    path = tmp_path / "curve.svg"
    history: list[Any] = [
        {"iteration": 100.0 * k, "psnr": 20.0 + k, "gaussians": 1000.0 * k} for k in range(1, 6)
    ]
    training = {"history": history, "iterations": 500, "held_out_psnr": 22.0}
    assert write_learning_curve(training, path)
    root = ElementTree.parse(path).getroot()
    lines = [e.attrib["points"].split() for e in root.iter(f"{SVG}polyline")]
    assert [len(points) for points in lines] == [5, 5]
    texts = " ".join(e.text or "" for e in root.iter(f"{SVG}text"))
    assert "PSNR (dB)" in texts
    assert "held-out photos" in texts
    history[2]["psnr"] = None
    assert write_learning_curve(training, path)
    first = next(ElementTree.parse(path).getroot().iter(f"{SVG}polyline"))
    assert len(first.attrib["points"].split()) == 4


def test_no_curve_without_measurements(tmp_path: Path) -> None:
    for history in (None, [], [{"iteration": 1.0}], "x", [3, {}]):
        assert not write_learning_curve({"history": history}, tmp_path / "curve.svg")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("texels", [0, 600])
def test_sizes_in_world_units_of_a_box(texels: int) -> None:
    """A box of 1 x 2 x 3, turned and moved far away by a frame of scale 10."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 2) for z in (0, 3)], float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    frame = Similarity(10.0, turn, np.array([5e5, 4e6, 0.0]))
    unused = np.vstack([corners, [[99.0, 99.0, 99.0]]])
    sizes = sizes_in_world(unused, faces, frame, texels)
    np.testing.assert_allclose(sizes["size"], [20.0, 10.0, 30.0], rtol=1e-12)
    assert sizes["diagonal"] == pytest.approx(10.0 * math.sqrt(14.0), rel=1e-12)
    assert sizes["area"] == pytest.approx(2200.0, rel=1e-12)
    # Each quad gives its four sides once and its diagonal twice.
    sides = [(1, 2), (1, 2), (1, 3), (1, 3), (2, 3), (2, 3)]
    edges = [e for a, b in sides for e in (a, a, b, b, math.hypot(a, b), math.hypot(a, b))]
    assert sizes["edge_mean"] == pytest.approx(10.0 * np.mean(edges), rel=1e-12)
    assert sizes["edge_median"] == pytest.approx(10.0 * np.median(edges), rel=1e-12)
    assert ("texel_size" in sizes) == (texels > 0)
    if texels:
        assert sizes["texel_size"] ** 2 * texels == pytest.approx(sizes["area"], rel=1e-12)
        assert sizes["texels_per_unit"] * sizes["texel_size"] == pytest.approx(1.0, rel=1e-12)
    assert sizes_in_world(corners, faces[:0], frame, texels) == {}
