# SPDX-License-Identifier: GPL-3.0-or-later
"""Results as Blender objects: reading a result folder, materials, levels, report, .blend files.

In: a result folder. Out: objects, materials, figures of the report; .blend and USD files.
"""
