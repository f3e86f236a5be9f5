# SPDX-License-Identifier: GPL-3.0-or-later
"""One picture of all scenes, two photos each."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from PIL import Image, ImageDraw

_CELL = (320, 240)
_CAPTION_PX = 16
_SHARES = (0.26, 0.34)
"""Which two of a scene's photos are shown: these shares of the way through them."""


def write_contact_sheet(folders: Sequence[Path], path: Path) -> None:
    """Write a JPEG with two scenes a row, captioned by the folders' scene names."""
    width, height = _CELL[0], _CELL[1] + _CAPTION_PX
    rows = -(-len(folders) // 2)
    sheet = Image.new("RGB", (4 * width, rows * height), "white")
    draw = ImageDraw.Draw(sheet)
    for index, folder in enumerate(folders):
        photos = sorted((folder / "images").iterdir())
        x, y = (index % 2) * 2 * width, (index // 2) * height
        draw.text((x + 4, y + 2), folder.name.rsplit("-", 1)[0], fill="black")
        for k, share in enumerate(_SHARES):
            with Image.open(photos[int(share * len(photos))]) as photo:
                small = photo.convert("RGB").resize(_CELL, Image.Resampling.LANCZOS)
            sheet.paste(small, (x + k * width, y + _CAPTION_PX))
    path.parent.mkdir(parents=True, exist_ok=True)
    sheet.save(path, quality=82, optimize=True)
