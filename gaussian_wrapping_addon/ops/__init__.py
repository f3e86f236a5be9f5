# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators of Blender, one or two modules a feature; they read properties and call ``core``.

In: clicks, properties, selected objects. Out: jobs, objects in the scene, files, messages.
"""
