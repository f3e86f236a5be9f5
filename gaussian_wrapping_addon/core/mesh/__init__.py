# SPDX-License-Identifier: GPL-3.0-or-later
"""Triangle meshes by themselves: topology and simplification, without Gaussians or cameras.

In: vertices and faces as numpy arrays. Out: measures, tables, and faces over the same vertices.
"""
