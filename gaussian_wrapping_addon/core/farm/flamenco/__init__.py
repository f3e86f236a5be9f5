# SPDX-License-Identifier: GPL-3.0-or-later
"""Flamenco, Blender's render farm, as a front for the parts of a job.

In: a job folder with its parts, the address of a Manager. Out: a Flamenco job whose tasks are the
parts, its state, its last log lines. ``gaussian-wrapping.js`` is the job type that the Manager
runs; the rest is a client of the Manager's HTTP interface, version 3. Standard library only.
"""
