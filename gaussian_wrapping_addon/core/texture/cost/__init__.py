# SPDX-License-Identifier: GPL-3.0-or-later
"""Size of a texture, and the memory needed to bake it.

In: a mesh, photos, settings, free memory. Out: side and number of textures, bytes.
"""
