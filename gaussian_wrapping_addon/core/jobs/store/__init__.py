# SPDX-License-Identifier: GPL-3.0-or-later
"""The files of a job: folder, job file, stage folders, results and their names.

In: settings, regions, results of stages. Out: files in the job folder, read and checked again.
Needs neither torch nor bpy.
"""
