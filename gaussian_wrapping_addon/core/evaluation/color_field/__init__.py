# SPDX-License-Identifier: GPL-3.0-or-later
"""A field of colours in space, independent of any mesh's faces, fitted by least squares.

In: points with directions and colours. Out: the colour at any point, seen from any direction.
"""
