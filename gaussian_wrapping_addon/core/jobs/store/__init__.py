# SPDX-License-Identifier: GPL-3.0-or-later
"""The files of a job: folder, job file, stage folders, claims, results and their names.

Needs neither torch nor bpy.
"""
