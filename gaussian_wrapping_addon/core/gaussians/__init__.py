# SPDX-License-Identifier: GPL-3.0-or-later
"""The model: parameters, activations, spherical harmonics, mip filter, PLY.

In: sparse points or splats. Out: oriented Gaussians as plain arrays.
"""
