# SPDX-License-Identifier: GPL-3.0-or-later
"""UV coordinates: charts and packing by xatlas in helper processes, checked.

In: a mesh. Out: UVs per face corner, no texel used twice.
"""
