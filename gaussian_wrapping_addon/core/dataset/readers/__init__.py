# SPDX-License-Identifier: GPL-3.0-or-later
"""Readers of inputs: COLMAP, transforms.json, point clouds, headers of splats.

In: files that nobody has checked. Out: a :class:`.source_model.SourceModel`, or a typed error.
"""
