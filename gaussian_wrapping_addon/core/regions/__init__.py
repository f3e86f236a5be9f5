# SPDX-License-Identifier: GPL-3.0-or-later
"""Regions of interest: convex bodies, their file, the automatic choices.

In: region files, corners of solids, cameras, Gaussians. Out: convex bodies. ``region_file.py``,
``volume.py`` and ``box.py`` need numpy only and serve Blender as well.
"""
