# SPDX-License-Identifier: GPL-3.0-or-later
"""Coordinate frames: normalisation of the scene, up direction, ground, placement, export.

In: camera poses and points. Out: similarity transforms in float64.
"""
