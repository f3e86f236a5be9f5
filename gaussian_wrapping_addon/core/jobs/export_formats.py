# SPDX-License-Identifier: GPL-3.0-or-later
"""Names that ``export`` takes; apart, so that the command line's help needs no numpy."""

from __future__ import annotations

OWN_FORMATS = ("glb", "obj", "ply", "splat")
"""Written here; the others need Blender."""
BLENDER_FORMATS = ("usd", "fbx")
SHADINGS = ("auto", "lit", "unlit")
