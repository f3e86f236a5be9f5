# SPDX-License-Identifier: GPL-3.0-or-later
"""PLY files: one bounded reader of headers and vertex tables.

In: a file that nobody has checked. Out: columns of numbers, or a typed error.
"""
