# SPDX-License-Identifier: GPL-3.0-or-later
"""Regions of interest: convex bodies, their files, the regions of a job.

In: region files, corners of solids, cameras, Gaussians. Out: convex bodies, and boxes that
partition space. ``box.py`` and ``files.py`` need only numpy and are also used in Blender.
"""
