# SPDX-License-Identifier: GPL-3.0-or-later
"""Region files and boxes, for Blender and the worker alike: standard library and numpy only.

In: bounding-volume JSON, or corners of a solid.
Out: checked corners in world coordinates, boxes as matrices, JSON.
"""
