# SPDX-License-Identifier: GPL-3.0-or-later
"""The reconstruction pipeline, from photos to textured meshes; independent of Blender.

In: a job file, or the arguments of a command. Out: files of a result, reports, typed errors.
Nothing inside core/ imports bpy, ops or ui. The modules of this folder are used everywhere: errors,
limits, tolerances, names, progress, files, machine, export_formats, report_warning. A file imports
its own folder and folders listed earlier in ``FOLDERS`` (``tests/test_layers.py``), never later
ones.
"""
