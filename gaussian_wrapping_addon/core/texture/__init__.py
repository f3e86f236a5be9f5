# SPDX-License-Identifier: GPL-3.0-or-later
"""A textured mesh from a mesh and photos; ``texture_mesh.py`` runs the steps in the folders.

In: a mesh, a scene, photos. Out: a :class:`~..mesh.textured_mesh.TexturedMesh`.
"""
