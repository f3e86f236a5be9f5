# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos baked onto meshes of the scene: what is handed over to the worker, and what comes back.

In: mesh objects, files of a finished bake. Out: arrays in world coordinates; UVs and materials.
"""
