# SPDX-License-Identifier: GPL-3.0-or-later
"""UV unwrapping: charts and packing by xatlas in helper processes, with validation.

In: a mesh. Out: UVs per face corner without overlaps.
"""
