# SPDX-License-Identifier: GPL-3.0-or-later
"""PLY files: bounded readers of headers and vertex tables.

In: an untrusted file. Out: columns of numbers, or a typed error.
"""
