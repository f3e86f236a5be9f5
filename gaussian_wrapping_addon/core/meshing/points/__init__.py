# SPDX-License-Identifier: GPL-3.0-or-later
"""Where the points of a mesh lie: pivots, candidate surface, spacing, caps of the region.

In: Gaussians, fields, a region. Out: points on the isosurface.
"""
