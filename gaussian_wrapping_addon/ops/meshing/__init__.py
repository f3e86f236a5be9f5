# SPDX-License-Identifier: GPL-3.0-or-later
"""Estimates and the list of regions to be meshed.

In: regions of the scene. Out: estimates of triangles, time and memory, ready to draw.
"""
