# SPDX-License-Identifier: GPL-3.0-or-later
"""PLY files: a bounded reader of headers, and of the vertices as a table of numbers.

In: a path. Out: the header's elements and properties; a structured array of the vertices.
"""
