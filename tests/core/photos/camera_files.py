# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos as cameras write them: a DNG of raw Bayer values, TIFFs of 16 bits, EXIF blocks."""

from __future__ import annotations

import struct
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

SRGB_FROM_XYZ = (
    (3.2404542, -1.5371385, -0.4985314),
    (-0.9692660, 1.8760108, 0.0415560),
    (0.0556434, -0.2040259, 1.0572252),
)
_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 10: 8}
_BYTE, _TEXT, _SHORT, _LONG, _RATIO, _SIGNED_RATIO = 1, 2, 3, 4, 5, 10


def _packed(kind: int, values: Any) -> bytes:
    if kind == _TEXT:
        return str(values).encode() + b"\0"
    values = values if isinstance(values, (list, tuple)) else [values]
    if kind in (_RATIO, _SIGNED_RATIO):
        parts = [Fraction(v).limit_denominator(10**6) for v in values]
        code = "I" if kind == _RATIO else "i"
        return b"".join(struct.pack(f"<2{code}", p.numerator, p.denominator) for p in parts)
    return struct.pack(f"<{len(values)}{ {_BYTE: 'B', _SHORT: 'H', _LONG: 'I'}[kind] }", *values)


def _folder(entries: dict[int, tuple[int, Any]], at: int) -> bytes:
    """Return a TIFF directory that begins at a byte offset, with its values behind it."""
    head, tail = struct.pack("<H", len(entries)), b""
    values_at = at + 2 + 12 * len(entries) + 4
    for tag, (kind, values) in sorted(entries.items()):
        body = _packed(kind, values)
        count = len(body) // _SIZES[kind]
        if len(body) <= 4:
            stored = body.ljust(4, b"\0")
        else:
            stored = struct.pack("<I", values_at + len(tail))
            tail += body + b"\0" * (len(body) % 2)
        head += struct.pack("<HHI", tag, kind, count) + stored
    return head + struct.pack("<I", 0) + tail


def exif_entries(focal_mm: float = 24.0, focal_35mm: int = 36) -> dict[int, tuple[int, Any]]:
    """Return the EXIF directory of a lens."""
    return {0x920A: (_RATIO, focal_mm), 0xA405: (_SHORT, focal_35mm), 0xA434: (_TEXT, "Lens 24")}


def tiff(
    pixels: np.ndarray,
    more: dict[int, tuple[int, Any]] | None = None,
    exif: dict[int, tuple[int, Any]] | None = None,
) -> bytes:
    """Return a TIFF in little endian, one strip.

    Parameters
    ----------
    pixels : (h, w) or (h, w, c) uint16
    more : dict
        Entries: number and kind of a tag, and its values.
    exif : dict
        Entries of the EXIF directory.
    """
    height, width = pixels.shape[:2]
    channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    body = pixels.astype("<u2").tobytes()
    exif_at = 8 + len(body)
    inner = _folder(exif, exif_at) if exif else b""
    entries: dict[int, tuple[int, Any]] = {
        256: (_LONG, width), 257: (_LONG, height), 258: (_SHORT, [16] * channels),
        259: (_SHORT, 1), 262: (_SHORT, 1 if channels == 1 else 2), 273: (_LONG, 8),
        277: (_SHORT, channels), 278: (_LONG, height), 279: (_LONG, len(body)),
        284: (_SHORT, 1),
    }  # fmt: skip
    entries |= more or {}
    if exif:
        entries[34665] = (_LONG, exif_at)
    at = exif_at + len(inner)
    return struct.pack("<2sHI", b"II", 42, at) + body + inner + _folder(entries, at)


def dng(
    linear: np.ndarray,
    *,
    neutral: tuple[float, float, float] = (1.0, 1.0, 1.0),
    white: int = 16383,
    black: int = 512,
    orientation: int = 1,
) -> bytes:
    """Return a DNG of an RGGB sensor whose own colours are linear sRGB.

    Parameters
    ----------
    linear : (h, w, 3) float
        Linear light from 0 to 1, neutral where red, green and blue agree; before the white
        balance: a channel is stored times ``neutral``.
    neutral : (3,) float
        What the camera sees of grey ("as shot").
    """
    seen = np.clip(linear * np.array(neutral), 0, 1)
    bayer = np.empty(linear.shape[:2])
    for row, column, channel in ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 2)):
        bayer[row::2, column::2] = seen[row::2, column::2, channel]
    values = np.rint(black + bayer * (white - black)).astype(np.uint16)
    more: dict[int, tuple[int, Any]] = {
        254: (_LONG, 0), 262: (_SHORT, 32803), 271: (_TEXT, "Maker"), 272: (_TEXT, "Model 1"),
        274: (_SHORT, orientation), 33421: (_SHORT, [2, 2]), 33422: (_BYTE, [0, 1, 1, 2]),
        50706: (_BYTE, [1, 4, 0, 0]), 50708: (_TEXT, "Maker Model 1"), 50714: (_SHORT, black),
        50717: (_LONG, white), 50728: (_RATIO, list(neutral)), 50778: (_SHORT, 21),
        50721: (_SIGNED_RATIO, [v for row in SRGB_FROM_XYZ for v in row]),
    }  # fmt: skip
    return tiff(values, more, exif_entries())


def write_dng(path: Path, linear: np.ndarray, **options: Any) -> Path:
    """Write :func:`dng` and return its path."""
    path.write_bytes(dng(linear, **options))
    return path
