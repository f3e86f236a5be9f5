# SPDX-License-Identifier: GPL-3.0-or-later
"""Everything that is not Blender: photos in, textured meshes out. Never imports bpy, ops or ui.

The plain files here are used everywhere: errors, limits, tolerances, progress, files. Each folder
may import those above it in ``tests/test_layers.py``, never those below.
"""
