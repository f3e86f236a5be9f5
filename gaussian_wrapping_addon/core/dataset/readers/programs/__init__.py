# SPDX-License-Identifier: GPL-3.0-or-later
"""Cameras written by other photogrammetry programs, as :class:`~..source_model.SourceModel`.

In: a camera file, or the folder that holds it. Out: poses, lens models and points in the world of
the file, in COLMAP's axes and pixel coordinates. Standard library and numpy only.
"""
