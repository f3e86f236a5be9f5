# SPDX-License-Identifier: GPL-3.0-or-later
"""Data sets: cameras, the scene with its views and points, and readers of inputs.

In: photos, camera poses, point clouds. Out: a :class:`.scene.Scene`. The modules here are the data
classes, the file of a scene and the choice of held-out views; the folders read inputs and make a
scene of them.
"""
