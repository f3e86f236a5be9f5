# SPDX-License-Identifier: GPL-3.0-or-later
"""Readers of inputs: COLMAP, transforms.json, point clouds, headers of splats.

In: untrusted files. Out: a :class:`.source_model.SourceModel`, or a typed error.
"""
