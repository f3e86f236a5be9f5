# SPDX-License-Identifier: GPL-3.0-or-later
"""Fields of trained Gaussians: vacancy, vector field, isosurface projection, depth-map samples.

In: points and Gaussians. Out: values, and points moved onto the isosurface vacancy = 0.5.
"""
