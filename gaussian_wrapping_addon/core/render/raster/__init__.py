# SPDX-License-Identifier: GPL-3.0-or-later
"""Blending of tiles, forward and backward: here a Gaussian becomes pixels.

In: screen Gaussians and tile lists. Out: planes of colour, normals, alpha and depth; gradients.
"""
