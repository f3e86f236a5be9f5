# SPDX-License-Identifier: GPL-3.0-or-later
"""From an input path to a scene: kind of the input, check, undistorted views, start points.

In: a path and settings. Out: findings before a job starts, then a scene.
"""
