# SPDX-License-Identifier: GPL-3.0-or-later
"""Rasterisation of an atlas: the face of each texel and its position on the mesh."""
