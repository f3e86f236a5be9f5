# SPDX-License-Identifier: GPL-3.0-or-later
"""Plots and pictures of the report."""

from __future__ import annotations

import html
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ...files import write_bytes
from ...gaussians.model import OrientedGaussians
from ...render.projection import RawArrays
from ...render.types import Renderer, RenderOptions
from ...render.view_renderer import ViewRenderer
from ...scene.scene import PhotoSource, evenly_spaced
from .figures import items, measured, part

# -- The learning curve as SVG, without a plotting library ----------------------------------------


COLORS = ("#0072b2", "#d55e00")  # distinguishable by colour-blind readers (Okabe and Ito)
PLOT_WIDTH, PLOT_HEIGHT = 460, 360
PLOT_LEFT, PLOT_RIGHT, PLOT_TOP, PLOT_BOTTOM = 62, 14, 34, 46
PLOT_INNER = (PLOT_WIDTH - PLOT_LEFT - PLOT_RIGHT, PLOT_HEIGHT - PLOT_TOP - PLOT_BOTTOM)
_TICKS = 6
_MARGIN = 0.06  # margin around the points of an axis, as a share of their spread
MAX_DOTS = 20  # curves with more points are drawn as a line without dots

_Points = list[tuple[float, float]]


def linear_axis(values: Sequence[float]) -> tuple[float, float, list[float]]:
    """Return the ends of an axis and its ticks."""
    spread = max(values) - min(values) or abs(values[0]) or 1.0
    begin, end = min(values) - _MARGIN * spread, max(values) + _MARGIN * spread
    rough = (end - begin) / _TICKS
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(power * k for k in (1, 2, 5, 10) if power * k >= rough)
    first, last = math.ceil(begin / step), math.floor(end / step)
    return begin, end, [step * k for k in range(first, last + 1)]


def svg_text(x: float, y: float, content: str, anchor: str = "middle", extra: str = "") -> str:
    """Return an SVG text; ``extra`` are further attributes."""
    attributes = f'x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"{extra}'
    return f"<text {attributes}>{html.escape(content)}</text>"


def svg_dot(x: float, y: float, color: str) -> str:
    """Return the dot of a point in SVG."""
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.2" fill="{color}"/>'


def svg_line(places: Sequence[tuple[float, float]], color: str) -> str:
    """Return a line through points (pixels) in SVG."""
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
    return f'<polyline points="{path}" fill="none" stroke="{color}" stroke-width="1.5"/>'


def svg_frame(title: str, x_label: str, y_label: str, left: int, top: int) -> list[str]:
    """Return the frame and the titles of a diagram whose corner is there (pixels), as SVG."""
    width, height = PLOT_INNER
    middle_x, middle_y = left + PLOT_LEFT + width / 2, top + PLOT_TOP + height / 2
    turned = f' transform="rotate(-90 {left + 14} {middle_y:.1f})"'
    corner = f'x="{left + PLOT_LEFT}" y="{top + PLOT_TOP}"'
    return [
        f'<rect {corner} width="{width}" height="{height}" fill="none" stroke="#888"/>',
        svg_text(middle_x, top + 20, title, extra=' font-weight="bold"'),
        svg_text(middle_x, top + PLOT_HEIGHT - 8, x_label),
        svg_text(left + 14, middle_y, y_label, extra=turned),
    ]


def svg_ticks(
    x_ticks: Sequence[tuple[float, str]], y_ticks: Sequence[tuple[float, str]], left: int, top: int
) -> list[str]:
    """Return the grid lines of a diagram: pixels and labels of its ticks, as SVG."""
    x0, y0 = left + PLOT_LEFT, top + PLOT_TOP
    width, height = PLOT_INNER
    parts = []
    for x, label in x_ticks:
        parts.append(f'<path d="M{x:.1f} {y0}V{y0 + height}" stroke="#ddd" stroke-width="0.7"/>')
        parts.append(svg_text(x, y0 + height + 15, label))
    for y, label in y_ticks:
        parts.append(f'<path d="M{x0} {y:.1f}h{width}" stroke="#ddd" stroke-width="0.7"/>')
        parts.append(svg_text(x0 - 5, y + 4, label, "end"))
    return parts


def svg_document(parts: Sequence[str], width: int, height: int) -> bytes:
    """Return the file of a drawing of that size (pixels) on white."""
    size = f'width="{width}" height="{height}"'
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} viewBox="0 0 {width} {height}" '
        'font-family="sans-serif" font-size="11">'
    )
    lines = [head, f'<rect {size} fill="white"/>', *parts, "</svg>"]
    return ("\n".join(lines) + "\n").encode()


def _diagram(title: str, y_label: str, curves: dict[str, _Points], left: int) -> list[str]:
    """Return a diagram over the iterations, of curves by their names."""
    width, height = PLOT_INNER
    x0, y0 = left + PLOT_LEFT, PLOT_TOP
    points = [point for curve in curves.values() for point in curve]
    (x_low, x_high, x_ticks), (y_low, y_high, y_ticks) = (
        linear_axis([p[k] for p in points]) for k in (0, 1)
    )

    def across(value: float) -> float:
        return x0 + width * ((value - x_low) / (x_high - x_low))

    def up(value: float) -> float:
        return y0 + height * (1.0 - (value - y_low) / (y_high - y_low))

    ticks = (
        [(across(value), f"{value:.6g}") for value in x_ticks],
        [(up(value), f"{value:.6g}") for value in y_ticks],
    )
    parts = [*svg_frame(title, "iteration", y_label, left, 0), *svg_ticks(*ticks, left, 0)]
    for number, (name, curve) in enumerate(curves.items()):
        color, places = COLORS[number], [(across(x), up(y)) for x, y in curve]
        if len(places) > 1:
            parts.append(svg_line(places, color))
        if len(places) <= MAX_DOTS:
            parts += [svg_dot(x, y, color) for x, y in places]
        y = y0 + 14 + 15 * number
        parts += [svg_dot(x0 + 10, y - 4, color), svg_text(x0 + 18, y, name, "start")]
    return parts


# -- Pictures of a report: held-out photos beside their renderings, and the learning curve --------


MAX_PICTURES = 4  # number of held-out photos shown: the worst, the best, and some between
STRIP_PX = 1500  # Maximum width of a strip of three images; a wider one is scaled down.
ERROR_GAIN = 4.0  # factor applied to the errors: the scale ends at a quarter of full brightness
GAP_PX = 6
CAPTION_PX = 24
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

    The photo is (h, w, 3) uint8, the rendering floats whose white is 1, clipped to [0, 1]; pixels
    outside of the mask (h, w) bool are black.
    """
    error = np.abs(np.clip(rendering, 0.0, 1.0) - photo / 255.0).mean(-1)  # (h, w)
    if mask is not None:
        error = np.where(mask, error, 0.0)
    return heat_colors(ERROR_GAIN * error)


def strip(images: Sequence[tuple[str, np.ndarray]]) -> bytes:
    """Return (h, w, 3) uint8 images of one size side by side, each under its caption, as JPEG."""
    height, width = images[0][1].shape[:2]
    room = (STRIP_PX - GAP_PX * (len(images) - 1)) // len(images)
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


def worst_to_best(figures: Sequence[float]) -> list[int]:
    """Return indices of figures to show: the lowest, the highest, evenly spaced ones between."""
    ranked = sorted(range(len(figures)), key=lambda i: (figures[i], i))
    return evenly_spaced(ranked, MAX_PICTURES)


def write_held_out(
    gaussians: OrientedGaussians, photos: PhotoSource, views: Sequence[tuple[int, str, float]],
    folder: Path, *, threads: int, renderer: Renderer | None = None,
) -> list[dict[str, Any]]:  # fmt: skip
    """Render held-out views as the trainer does, and write photo, rendering and error.

    Parameters
    ----------
    photos : PhotoStore
        Their finest size is shown.
    views : sequence of (index, name, psnr)
        All measured views; the pictures are chosen by :func:`worst_to_best`.
    folder : Path
        Where ``held-out-0.jpg`` and so on are written.
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
        error = f"Error x {ERROR_GAIN:g} (white: {1 / ERROR_GAIN:.0%} or more)"
        columns = [
            ("Photo", photo),
            (f"Gaussians, {psnr:.1f} dB", np.rint(255.0 * rendering).astype(np.uint8)),
            (error, error_map(photo, rendering, mask)),
        ]
        file = f"held-out-{number}.jpg"
        write_bytes(folder / file, strip(columns))
        written.append({"file": file, "name": name, "psnr": psnr})
    return written


def write_learning_curve(training: dict[str, Any], path: Path) -> bool:
    """Plot PSNR and number of Gaussians over the iterations; return ``False`` if there is no curve.

    The training's figures are those of a report: ``history`` (a list of ``iteration``, ``psnr`` of
    the photos trained on, dB, and ``gaussians``), and ``iterations`` and ``held_out_psnr`` if
    measured. The file is an SVG.
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
    curves = {"training photos (running mean)": quality}
    end, held_out = measured(training.get("iterations")), measured(training.get("held_out_psnr"))
    if end is not None and held_out is not None:
        curves["held-out photos (mean, at the end)"] = [(end, held_out)]
    parts = [
        *_diagram("Image quality", "PSNR (dB)", curves, 0),
        *_diagram("Model size", "Gaussians (thousands)", {"Gaussians": count}, PLOT_WIDTH),
    ]
    write_bytes(path, svg_document(parts, 2 * PLOT_WIDTH, PLOT_HEIGHT))
    return True
