# SPDX-License-Identifier: GPL-3.0-or-later
"""Photo cameras as Blender cameras, and looking through them.

In: cameras of a result. Out: camera objects with their photos as backgrounds.
"""
