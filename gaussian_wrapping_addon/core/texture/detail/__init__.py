# SPDX-License-Identifier: GPL-3.0-or-later
"""Detail of a dense mesh on a lighter one: normal map, ambient occlusion, levels of detail.

In: a textured mesh and its dense version. Out: images, and coarser textured meshes.
"""
