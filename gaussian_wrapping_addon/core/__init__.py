# SPDX-License-Identifier: GPL-3.0-or-later
"""The reconstruction pipeline, from photos to textured meshes; independent of Blender.

Never imports bpy, ops or ui. The modules of this folder are used everywhere: errors, limits,
tolerances, progress, files. Each sub-package may import those above it in ``tests/test_layers.py``,
never those below.
"""
