# SPDX-License-Identifier: GPL-3.0-or-later
"""From an input path to a scene: check, solve, undistort, mask, choose the start points.

In: a path. Out: a :class:`~..scene.Scene` in its own frame.
"""
