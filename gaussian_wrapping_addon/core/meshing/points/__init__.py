# SPDX-License-Identifier: GPL-3.0-or-later
"""Point placement for meshing: pivots, candidate surface, spacing, caps of the region.

In: Gaussians, fields, a region. Out: points on the isosurface.
"""
