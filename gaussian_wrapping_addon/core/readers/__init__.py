# SPDX-License-Identifier: GPL-3.0-or-later
"""Cameras and points from files: COLMAP, transforms.json, other programs, point clouds, lenses.

In: files. Out: a :class:`~.source_model.SourceModel`; damage is a typed error with file and place.
"""
