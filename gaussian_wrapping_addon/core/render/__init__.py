# SPDX-License-Identifier: GPL-3.0-or-later
"""Gaussians and a camera in, images out: projection, tiles, kernels, isosurface depth."""
