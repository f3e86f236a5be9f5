# SPDX-License-Identifier: GPL-3.0-or-later
"""What baking textures takes of memory, told before it begins."""

from __future__ import annotations

from ...errors import ResourceError
from ...report_warning import ReportWarning
from ..bake.bake import POINTS_PER_BLOCK

BASE_BYTES = 500 * 10**6
"""Photos, depth buffers and whatever else does not grow with the texture."""
FACE_BYTES = 900
"""A face with its share of vertices, graphs and helper files."""
TEXEL_BYTES = 30
"""A texel of the atlas that is being baked, by the arrays that are held at once: image, rings,
charts, points and their colours, and indices of some of them. Counted, not measured."""
WAITING_TEXEL_BYTES = 14
"""The same of a finished atlas, which waits for the others."""
BLOCK_POINT_BYTES = 105
"""A point of the block that is held with its views."""
MIN_SIZE_PX = 256


def texture_memory_bytes(size_px: int, atlases: int, faces: int) -> int:
    """Return about how much more memory a process needs while it textures a mesh."""
    texels = size_px * size_px
    waiting = WAITING_TEXEL_BYTES * texels * (atlases - 1)
    block = BLOCK_POINT_BYTES * min(texels, POINTS_PER_BLOCK)
    return BASE_BYTES + block + FACE_BYTES * faces + TEXEL_BYTES * texels + waiting


def fit_into_memory(
    size_px: int, atlases: int, faces: int, free_bytes: int, *, may_lower: bool
) -> tuple[int, int, ReportWarning | None]:
    """Return side and number of textures that fit, and a warning where they are less than asked.

    Parameters
    ----------
    size_px, atlases : int
        What is wanted.
    faces : int
        Of the mesh.
    free_bytes : int
        What may be taken; 0 where it is not known: then nothing is judged.
    may_lower : bool
        Whether the size was chosen here, not asked for.

    Raises
    ------
    ResourceError
        Not even the smallest fits, or less than what was asked for.
    """
    needed = texture_memory_bytes(size_px, atlases, faces)
    if free_bytes == 0 or needed <= free_bytes:
        return size_px, atlases, None
    side, number = size_px, atlases
    while number > 1 and texture_memory_bytes(side, number, faces) > free_bytes:
        number -= 1
    while side // 2 >= MIN_SIZE_PX and texture_memory_bytes(side, number, faces) > free_bytes:
        side //= 2
    fits = texture_memory_bytes(side, number, faces) <= free_bytes
    what = "texture" if atlases == 1 else f"{atlases} textures"
    text = (
        f"A {what} of {size_px} pixels" if atlases == 1 else f"{what} of {size_px} pixels"
    ) + f" may take {needed / 2**30:.1f} GB, {free_bytes / 2**30:.1f} GB are free"
    if not (fits and may_lower):
        hint = "Close other programs or use a machine with more memory."
        if fits:
            hint = f"Ask for {number} of {side} pixels, or close other programs."
        raise ResourceError(f"{text}.", hint)
    made = f"{text}: {number} of {side} pixels was made."
    return side, number, ReportWarning("texture-made-smaller", made)
