# SPDX-License-Identifier: GPL-3.0-or-later
"""Regions, Delaunay, pivots, marching tetrahedra, primal adaptive meshing, repair."""
