# SPDX-License-Identifier: GPL-3.0-or-later
"""Rasterisation of an atlas: the face of each texel and its position on the mesh.

In: a mesh with UVs per face corner. Out: face indices, barycentric coordinates, surface points.
"""
