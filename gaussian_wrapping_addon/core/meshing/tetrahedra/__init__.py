# SPDX-License-Identifier: GPL-3.0-or-later
"""Tetrahedra: Delaunay, labels inside or outside, minimum cut, the faces between.

In: points and vacancy. Out: labelled tetrahedra and their boundary faces.
"""
