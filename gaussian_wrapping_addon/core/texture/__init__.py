# SPDX-License-Identifier: GPL-3.0-or-later
"""Texturing: a textured mesh from a mesh and photos; entry point ``texture_mesh.py``.

In: a mesh, a scene, photos. Out: a :class:`~.textured_mesh.TexturedMesh`.
"""
