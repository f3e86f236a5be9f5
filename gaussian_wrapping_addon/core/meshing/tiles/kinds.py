# SPDX-License-Identifier: GPL-3.0-or-later
"""The kinds of parts that a mesh in tiles is made of; standard library only."""

from __future__ import annotations

POINTS, GATHER, FACES = "points", "gather", "faces"
TILE_KINDS = (POINTS, GATHER, FACES)
"""In the order in which they are made."""
