# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos on disk: find them, read their headers and EXIF, decode, cache resolution levels.

In: folders and files. Out: 8-bit arrays.
"""
