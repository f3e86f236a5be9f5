# SPDX-License-Identifier: GPL-3.0-or-later
"""Statistics and validation of finished meshes, independent of the code that made them.

In: a mesh. Out: figures for the report, and the defects that were found.
"""
