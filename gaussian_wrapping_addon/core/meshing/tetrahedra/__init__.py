# SPDX-License-Identifier: GPL-3.0-or-later
"""Tetrahedra: Delaunay triangulation, inside/outside labels by minimum cut, boundary faces.

In: points and vacancy. Out: labelled tetrahedra and their boundary faces.
"""
