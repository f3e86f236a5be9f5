# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures of a report: held-out photos beside their renderings, and the learning curve."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ...dataset.photo_source import PhotoSource
from ...dataset.view_split import evenly_spaced
from ...files import write_bytes
from ...gaussians.model import OrientedGaussians
from ...render.projection.projection import RawArrays
from ...render.types.options import RenderOptions
from ...render.types.renderer import Renderer
from ...render.view_renderer import ViewRenderer
from .plot import Panel, Series, write_svg
from .text import items, measured, part

MAX_PICTURES = 4
"""Number of held-out photos shown: the worst, the best, and some between."""

STRIP_PX = 1500
"""Maximum width of a strip of three images."""

ERROR_GAIN = 4.0
"""Factor applied to the errors: the scale ends at a quarter of full brightness."""

GAP_PX = 6
CAPTION_PX = 24
MAX_DOTS = 20
"""Curves with more points are drawn as a line without dots."""
JPEG_QUALITY = 88
_PAPER = (32, 32, 34)
_INK = (232, 232, 232)

# Monotonic in brightness, so that it reads in greyscale: black, violet, red, orange, ivory.
_HEAT = np.array([(0, 0, 0), (74, 20, 120), (196, 42, 80), (250, 150, 30), (255, 250, 210)])


def heat_colors(values: np.ndarray) -> np.ndarray:
    """Return (h, w, 3) uint8 colours of values clipped to 0 (black) to 1 (ivory)."""
    stops = np.linspace(0.0, 1.0, len(_HEAT))
    clipped = np.clip(values, 0.0, 1.0)
    channels = [np.interp(clipped, stops, _HEAT[:, c]) for c in range(3)]
    return np.rint(np.stack(channels, -1)).astype(np.uint8)


def error_map(
    photo: np.ndarray, rendering: np.ndarray, mask: np.ndarray | None = None
) -> np.ndarray:
    """Return the absolute error (mean of the channels, times :data:`ERROR_GAIN`) as heat colours.

    Parameters
    ----------
    photo : (h, w, 3) uint8
    rendering : (h, w, 3)
        Floats, white is 1; clipped to [0, 1].
    mask : (h, w) bool, optional
        Pixels that count; others are black.
    """
    error = np.abs(np.clip(rendering, 0.0, 1.0) - photo / 255.0).mean(-1)  # (h, w)
    if mask is not None:
        error = np.where(mask, error, 0.0)
    return heat_colors(ERROR_GAIN * error)


def strip(images: Sequence[tuple[str, np.ndarray]], *, width_px: int = STRIP_PX) -> bytes:
    """Return images of one size side by side, each under its caption, as JPEG.

    Parameters
    ----------
    images : sequence of (caption, (h, w, 3) uint8)
    width_px : int
        Maximum width; a wider strip is scaled down.
    """
    height, width = images[0][1].shape[:2]
    room = (width_px - GAP_PX * (len(images) - 1)) // len(images)
    scale = min(1.0, room / width)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    total = size[0] * len(images) + GAP_PX * (len(images) - 1)
    canvas = Image.new("RGB", (total, size[1] + CAPTION_PX), _PAPER)
    font = ImageFont.load_default(14)
    for index, (caption, pixels) in enumerate(images):
        left = index * (size[0] + GAP_PX)
        image = Image.fromarray(np.ascontiguousarray(pixels))
        canvas.paste(image.resize(size, Image.Resampling.LANCZOS), (left, CAPTION_PX))
        head = Image.new("RGB", (size[0], CAPTION_PX), _PAPER)  # clips long captions
        ImageDraw.Draw(head).text((4, 3), caption, fill=_INK, font=font)
        canvas.paste(head, (left, 0))
    stream = io.BytesIO()
    canvas.save(stream, format="JPEG", quality=JPEG_QUALITY, subsampling=0)
    return stream.getvalue()


def worst_to_best(figures: Sequence[float], count: int = MAX_PICTURES) -> list[int]:
    """Return indices of figures to show: the lowest, the highest, evenly spaced ones between."""
    ranked = sorted(range(len(figures)), key=lambda i: (figures[i], i))
    return evenly_spaced(ranked, count)


def write_held_out(
    gaussians: OrientedGaussians,
    photos: PhotoSource,
    views: Sequence[tuple[int, str, float]],
    folder: Path,
    *,
    threads: int,
    renderer: Renderer | None = None,
) -> list[dict[str, Any]]:
    """Render held-out views as the trainer does, and write photo, rendering and error.

    Parameters
    ----------
    gaussians : OrientedGaussians
        Trained.
    photos : PhotoStore
        The photos used for training; their finest size is shown.
    views : sequence of (index, name, psnr)
        All measured views; the pictures are chosen by :func:`worst_to_best`.
    folder : Path
        Where ``held-out-0.jpg`` and so on are written.
    threads : int
    renderer : Renderer, optional
        By default that of the processor.

    Returns
    -------
    list of dict
        ``file``, ``name`` and ``psnr`` (dB) of each picture, the worst first.
    """
    renderer, raw = renderer or ViewRenderer(), RawArrays.from_gaussians(gaussians)
    options = RenderOptions(depth=False, threads=threads)
    written = []
    for number, chosen in enumerate(worst_to_best([psnr for _, _, psnr in views])):
        index, name, psnr = views[chosen]
        image = renderer.render(raw, photos.camera(index, 1), options).color
        rendering = np.clip(image, 0.0, 1.0)
        photo, mask = photos.photo(index, 1), photos.mask(index, 1)
        columns = [
            ("Photo", photo),
            (f"Gaussians, {psnr:.1f} dB", np.rint(255.0 * rendering).astype(np.uint8)),
            (
                f"Error x {ERROR_GAIN:g} (white: {1 / ERROR_GAIN:.0%} or more)",
                error_map(photo, rendering, mask),
            ),
        ]
        file = f"held-out-{number}.jpg"
        write_bytes(folder / file, strip(columns))
        written.append({"file": file, "name": name, "psnr": psnr})
    return written


def write_learning_curve(training: dict[str, Any], path: Path) -> bool:
    """Plot PSNR and number of Gaussians over the iterations; return ``False`` if there is no curve.

    Parameters
    ----------
    training : dict
        Of a report: ``history`` (a list of ``iteration``, ``psnr`` of the photos trained on, dB,
        and ``gaussians``), and ``iterations`` and ``held_out_psnr`` if measured.
    path : Path
        An SVG file.
    """
    quality, count = [], []
    for entry in map(part, items(training.get("history"))):
        iteration = measured(entry.get("iteration"))
        psnr, gaussians = measured(entry.get("psnr")), measured(entry.get("gaussians"))
        if iteration is not None and psnr is not None and gaussians is not None:
            quality.append((iteration, psnr))
            count.append((iteration, gaussians / 1000.0))
    if len(quality) < 2:
        return False
    dots = len(quality) <= MAX_DOTS
    curves = [Series("training photos (running mean)", quality, dots=dots)]
    end, held_out = measured(training.get("iterations")), measured(training.get("held_out_psnr"))
    if end is not None and held_out is not None:
        curves.append(Series("held-out photos (mean, at the end)", [(end, held_out)], line=False))
    growth = [Series("Gaussians", count, dots=dots)]
    panels = [
        Panel("Image quality", "iteration", "PSNR (dB)", curves, False, False, False),
        Panel("Model size", "iteration", "Gaussians (thousands)", growth, False, False, False),
    ]
    write_svg(panels, path)
    return True
