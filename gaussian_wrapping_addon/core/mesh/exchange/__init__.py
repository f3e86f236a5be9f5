# SPDX-License-Identifier: GPL-3.0-or-later
"""Meshes of other programs: their files, their frame, their UVs.

In: OBJ, PLY, GLB, STL, OFF, or arrays handed over by Blender. Out: checked vertices, faces and UVs.
"""
