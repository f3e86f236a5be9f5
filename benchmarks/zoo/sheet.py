# SPDX-License-Identifier: GPL-3.0-or-later
"""One picture of many scenes, two small photos each, rendered for it alone."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

from PIL import Image, ImageDraw

from .catalogue import draw_content, zoo_scene
from .rendering import render_photos

_CELL = (240, 180)
_CAPTION_PX = 14
_SCENES_A_ROW = 3
_SHARES = (0.1, 0.6)
"""Which two of a scene's photos are shown: these shares of the way through them."""


def draw_sheet(names: Sequence[str], path: Path, threads: int) -> None:
    """Write a PNG of the scenes, captioned by name, surroundings, path and size.

    Raises
    ------
    ResourceError
        bpy is missing.
    """
    width, height = 2 * _CELL[0] + 4, _CELL[1] + _CAPTION_PX
    rows = -(-len(names) // _SCENES_A_ROW)
    sheet = Image.new("RGB", (_SCENES_A_ROW * width, rows * height), "white")
    pen = ImageDraw.Draw(sheet)
    for index, name in enumerate(names):
        row, column = divmod(index, _SCENES_A_ROW)
        x, y = column * width, row * height
        content = draw_content(zoo_scene(name))
        shot = content.photography
        words = (
            f"{name}  {shot.surroundings} {shot.path}  {shot.photos} x {shot.width}x{shot.height}"
        )
        pen.text((x + 4, y + 1), words, fill="black")
        scale = min(_CELL[0] / shot.width, _CELL[1] / shot.height)
        size = (round(shot.width * scale), round(shot.height * scale))
        cameras = [content.cameras[int(share * shot.photos)].resized(*size) for share in _SHARES]
        with tempfile.TemporaryDirectory(prefix="zoo-sheet-") as folder:
            paths = [Path(folder) / camera.name for camera in cameras]
            render_photos(content, cameras, paths, threads)
            for k, photo in enumerate(paths):
                with Image.open(photo) as image:
                    sheet.paste(image, (x + k * _CELL[0], y + _CAPTION_PX))
    path.parent.mkdir(parents=True, exist_ok=True)
    sheet.save(path)
