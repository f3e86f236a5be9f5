# SPDX-License-Identifier: GPL-3.0-or-later
"""Write textured meshes as files (GLB, OBJ, PLY), and validate them before export.

In: a textured mesh. Out: files in the requested frame.
"""
