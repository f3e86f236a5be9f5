# SPDX-License-Identifier: GPL-3.0-or-later
"""Load an input as a scene: check, solve poses, undistort, mask, choose start points.

In: a path. Out: a :class:`~..scene.Scene` in its own frame.
"""
