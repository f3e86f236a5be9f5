# SPDX-License-Identifier: GPL-3.0-or-later
"""Coordinate frames: scene normalisation, up direction, ground plane, placement, export.

In: camera poses and points. Out: similarity transforms in float64.
"""
