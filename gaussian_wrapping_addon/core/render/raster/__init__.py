# SPDX-License-Identifier: GPL-3.0-or-later
"""Rasterisation of tiles: alpha blending and isosurface depth, forward and backward.

In: screen Gaussians and tile lists. Out: images of colour, normals, alpha and depth; gradients.
"""
