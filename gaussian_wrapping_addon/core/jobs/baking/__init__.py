# SPDX-License-Identifier: GPL-3.0-or-later
"""Baking the photos of a finished training onto a mesh from elsewhere.

In: a mesh file, or what Blender hands over. Out: a textured mesh in ``baked/NAME``.
"""
