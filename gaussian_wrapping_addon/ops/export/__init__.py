# SPDX-License-Identifier: GPL-3.0-or-later
"""Export of meshes to the formats of other programs, by Blender's exporters.

In: mesh objects, or a result folder. Out: files with sidecars.
"""
