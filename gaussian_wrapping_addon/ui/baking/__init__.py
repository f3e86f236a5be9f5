# SPDX-License-Identifier: GPL-3.0-or-later
"""The sub-panel "Bake": photos onto meshes of the scene.

In: the active object, a scene's choices. Out: rows and buttons.
"""
