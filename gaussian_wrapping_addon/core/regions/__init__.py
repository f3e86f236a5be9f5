# SPDX-License-Identifier: GPL-3.0-or-later
"""Regions of interest: convex bodies, their file format, and automatic regions.

In: region files, corners of solids, cameras, Gaussians. Out: convex bodies, and boxes that
partition space (``shapes.py``). ``files.py``, ``box.py`` and ``box.py`` need only numpy
and are also used in Blender.
"""
