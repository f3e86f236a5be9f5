# SPDX-License-Identifier: GPL-3.0-or-later
"""Regions as Blender objects: create, edit, import, export, track their changes.

In: boxes, meshes, region files. Out: region objects and region files.
"""
