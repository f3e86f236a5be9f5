# SPDX-License-Identifier: GPL-3.0-or-later
"""Meshing of large regions tile by tile, with bounded memory and without seams.

In: fields, Gaussians, cameras, a region. Out: a plan, files of its tiles, and the joined mesh.
"""
