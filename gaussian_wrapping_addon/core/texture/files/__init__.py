# SPDX-License-Identifier: GPL-3.0-or-later
"""Textured meshes as files: GLB, OBJ, PLY, and what no file may hold.

In: a textured mesh. Out: files in the frame that was asked for.
"""
