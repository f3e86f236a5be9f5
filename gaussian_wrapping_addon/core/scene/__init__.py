# SPDX-License-Identifier: GPL-3.0-or-later
"""Data of a scene: cameras, views, points, frame, placement in the user's world.

In: numbers. Out: frozen dataclasses. Numpy only, so that Blender can load it.
"""
