# SPDX-License-Identifier: GPL-3.0-or-later
"""Small videos of a camera that moves along a picture, with blur, pauses and uneven times."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from scipy.ndimage import gaussian_filter

WIDTH, HEIGHT = 320, 240
FPS = 30
BLUR_PX = 9


def mural(seed: int = 0, length: int = 1600) -> np.ndarray:
    """Return a long picture with detail at all scales, (300, length, 3) uint8."""
    random = np.random.default_rng(seed)
    total = np.zeros((300, length, 3))
    for sigma, amplitude in ((0.7, 30.0), (3.0, 90.0), (12.0, 300.0)):
        noise = random.normal(size=total.shape)
        total += amplitude * gaussian_filter(noise, (sigma, sigma, 0), mode="wrap")
    return np.clip(128 + total, 0, 255).astype(np.uint8)


def shot(picture: np.ndarray, x: int, *, blur: int = 0, random: Any = None) -> np.ndarray:
    """Return the frame at ``x``, blurred along the motion by ``blur`` pixels, with noise."""
    parts = [picture[20 : 20 + HEIGHT, x + k : x + k + WIDTH] for k in range(max(blur, 1))]
    frame = np.mean(np.array(parts, np.float64), 0)
    if random is not None:
        frame += random.normal(scale=1.5, size=frame.shape)
    return np.clip(np.rint(frame), 0, 255).astype(np.uint8)


def pan(places: Sequence[int], blurred: Sequence[bool] | None = None) -> list[np.ndarray]:
    """Return frames at the places, some of them blurred."""
    picture, random = mural(), np.random.default_rng(1)
    blurs = [False] * len(places) if blurred is None else blurred
    return [
        shot(picture, int(x), blur=BLUR_PX if b else 0, random=random)
        for x, b in zip(places, blurs, strict=True)
    ]


def write(
    path: Path,
    frames: Sequence[np.ndarray],
    *,
    times: Sequence[int] | None = None,
    codec: str = "libx264",
    rotation: int = 0,
    mirrored: bool = False,
    trc: int = 0,
    options: dict[str, str] | None = None,
) -> Path:
    """Write frames with times in units of 1 / FPS, one after the other where none are given."""
    with av.open(str(path), "w", options=options or {}) as container:
        stream: Any = container.add_stream(codec, rate=FPS)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = {"mjpeg": "yuvj420p"}.get(codec, "yuv420p")
        stream.thread_count = 1
        stream.time_base = Fraction(1, FPS)
        if codec == "libx264":
            stream.options = {"crf": "12", "preset": "veryfast"}
        if trc:
            stream.codec_context.color_trc = trc
        if rotation or mirrored:
            stream.set_display_rotation(rotation, hflip=mirrored)
        for number, pixels in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
            frame.pts = number if times is None else times[number]
            frame.time_base = Fraction(1, FPS)
            for packet in stream.encode(frame):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
    return path
