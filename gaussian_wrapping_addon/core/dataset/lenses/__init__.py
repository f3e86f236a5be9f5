# SPDX-License-Identifier: GPL-3.0-or-later
"""Lenses: which one a photo has, and the pinhole camera that its pixels are moved to.

In: lenses as inputs write them, sizes of photos. Out: sampling maps, pixels of points.
"""
