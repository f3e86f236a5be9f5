# SPDX-License-Identifier: GPL-3.0-or-later
"""Estimate the memory needed to bake textures."""

from __future__ import annotations

from ...errors import ResourceError
from ...report_warning import ReportWarning
from ..bake.bake import POINTS_PER_BLOCK

BASE_BYTES = 500 * 10**6
"""Photos, depth buffers and everything else that does not grow with the texture."""
FACE_BYTES = 900
"""Per face, with its share of vertices, graphs and helper files."""
TEXEL_BYTES = 30
"""Per texel of the atlas being baked, from the arrays held at once: image, rings, charts, points
and their colours, and indices of some of them. Counted, not measured."""
WAITING_TEXEL_BYTES = 14
"""The same for a baked atlas that waits for the others."""
BLOCK_POINT_BYTES = 105
"""Per point of the block that is held with its views."""
MIN_SIZE_PX = 256


def texture_memory_bytes(size_px: int, atlases: int, faces: int) -> int:
    """Return the approximate additional memory of a process that textures a mesh."""
    texels = size_px * size_px
    waiting = WAITING_TEXEL_BYTES * texels * (atlases - 1)
    block = BLOCK_POINT_BYTES * min(texels, POINTS_PER_BLOCK)
    return BASE_BYTES + block + FACE_BYTES * faces + TEXEL_BYTES * texels + waiting


def fit_into_memory(
    size_px: int,
    atlases: int,
    faces: int,
    free_bytes: int,
    *,
    may_lower: bool,
    may_join: bool = True,
) -> tuple[int, int, ReportWarning | None]:
    """Return side and number of textures that fit, and a warning if that is less than requested.

    Parameters
    ----------
    size_px, atlases : int
        Requested side and number.
    faces : int
        Number of faces of the mesh.
    free_bytes : int
        Available memory; 0 if unknown, then nothing is checked.
    may_lower : bool
        Whether the size may be lowered because it was chosen automatically.
    may_join : bool
        Whether there may be fewer textures; otherwise only the size is lowered.

    Raises
    ------
    ResourceError
        Not even the smallest size fits, or not the requested one.
    """
    needed = texture_memory_bytes(size_px, atlases, faces)
    if free_bytes == 0 or needed <= free_bytes:
        return size_px, atlases, None
    side, number = size_px, atlases
    while may_join and number > 1 and texture_memory_bytes(side, number, faces) > free_bytes:
        number -= 1
    while side // 2 >= MIN_SIZE_PX and texture_memory_bytes(side, number, faces) > free_bytes:
        side //= 2
    fits = texture_memory_bytes(side, number, faces) <= free_bytes
    what = "texture" if atlases == 1 else f"{atlases} textures"
    text = (
        f"A {what} of {size_px} pixels" if atlases == 1 else f"{what} of {size_px} pixels"
    ) + f" may need {needed / 2**30:.1f} GB of memory; {free_bytes / 2**30:.1f} GB are free"
    if not (fits and may_lower):
        hint = "Close other programs or use a machine with more memory."
        if fits:
            hint = f"Choose {number} of {side} pixels, or close other programs."
        raise ResourceError(f"{text}.", hint)
    made = f"{text}. Made instead: {number} of {side} pixels."
    return side, number, ReportWarning("texture-made-smaller", made)
