# SPDX-License-Identifier: GPL-3.0-or-later
"""Jobs on several computers, seen from outside: the parts of a job and their states.

In: ``parts.json`` and ``parts/*.json`` of a job folder. Out: lists and counts for panel and command
line. Fronts to farms are in folders of their own. Standard library only, so that Blender can load
it.
"""
