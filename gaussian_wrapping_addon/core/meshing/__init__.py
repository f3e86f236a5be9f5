# SPDX-License-Identifier: GPL-3.0-or-later
"""Extract a closed mesh of a region: primal adaptive meshing or marching tetrahedra on pivots.

In: fields, Gaussians, cameras, a region. Out: a :class:`~.surface_mesh.SurfaceMesh`.
``primal_adaptive.py`` and ``pivot_meshing.py`` are the two methods; ``tiles`` bounds memory.
"""
